from pathlib import Path

import pytest

from nerfgrasp import cli
from nerfgrasp.evaluation.results import Row, write_results


def results(path: Path, method: str, outcomes: str, physics: str = "0123456789abcdef") -> Path:
    """Writes a simple run; an outcome is a letter, `s` for success."""
    rows = [
        Row(
            set="simple-7", task="simple", seed=7, scene=scene, attempt=0, method=method, model=None,
            scene_sha256=str(scene), physics=physics, objects=("box",), grasp=None, value=None,
            outcome="success" if letter == "s" else "no_grasp", object=None, lifted_mm=0.0, dropped=(), errors=None,
            versions={"nerfgrasp": "0.1.0"},
        )
        for scene, letter in enumerate(outcomes)
    ]  # fmt: skip
    write_results(path, rows)
    return path


@pytest.fixture
def files(tmp_path: Path) -> list[str]:
    paths = [results(tmp_path / "a.jsonl", "oracle", "sss-"), results(tmp_path / "b.jsonl", "random", "s---")]
    return [str(path) for path in paths]


def refusal(capsys: pytest.CaptureFixture[str], args: list[str]) -> str:
    assert cli.main(["report", *args]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    return err


def test_the_table_is_printed(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["report", *files]) == 0
    out = capsys.readouterr().out
    assert "  oracle  0.75 [0.30, 0.95]\n" in out
    assert "  random  0.25 [0.05, 0.70]\n" in out
    assert "oracle - random" in out


def test_results_are_called_as_they_are_given(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["report", f"Best={files[0]}", files[1]]) == 0
    out = capsys.readouterr().out
    assert "  Best    0.75 [0.30, 0.95]\n" in out
    assert "Best: method oracle, model none." in out
    assert "Best - random" in out
    assert "are both called Best: a name stands for one method" in refusal(capsys, [f"Best={file}" for file in files])


def test_the_report_is_the_same_every_time(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    printed = []
    for _ in range(2):
        cli.main(["report", *files])
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1]


def test_markdown_goes_to_a_file(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "table.md"
    assert cli.main(["report", *files, "--format", "markdown", "--out", str(out)]) == 0
    assert capsys.readouterr().out == ""
    assert "| oracle | 0.75 [0.30, 0.95] |\n" in out.read_text(encoding="utf-8")


def test_a_report_does_not_overwrite_results(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    before = Path(files[0]).read_bytes()
    assert "would be overwritten" in refusal(capsys, [*files, "--out", files[0]])
    assert Path(files[0]).read_bytes() == before


def test_mistakes_are_told_in_one_line(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damaged = tmp_path / "damaged.jsonl"
    damaged.write_text(Path(files[0]).read_text() + '{"format": 1\n')
    other = str(results(tmp_path / "other.jsonl", "psi", "ss", physics="f" * 16))
    assert "damaged.jsonl, line 5" in refusal(capsys, [str(damaged)])
    assert f"{other} is of physics {'f' * 16}" in refusal(capsys, [*files, other])
    assert "no such file" in refusal(capsys, [str(tmp_path / "none.jsonl")])
    assert "are both of oracle on simple" in refusal(
        capsys, [files[0], str(results(tmp_path / "c.jsonl", "oracle", "s"))]
    )
    assert "html" in refusal(capsys, [*files, "--format", "html"])
    assert "files" in refusal(capsys, [])
