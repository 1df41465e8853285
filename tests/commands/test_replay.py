import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from nerfgrasp import cli
from nerfgrasp.search.strategies import STRATEGIES

pytest.importorskip("pybullet")

from nerfgrasp.commands.evaluate import evaluate
from nerfgrasp.commands.replay import heading
from nerfgrasp.evaluation.results import Row, read_results, write_results


@pytest.fixture(scope="module")
def results(model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Failures of a model in three scenes; in the third nothing was proposed."""
    out = tmp_path_factory.mktemp("results") / "psi.jsonl"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(STRATEGIES, "joint", replace(STRATEGIES["joint"], candidates=2))
        arguments: dict[str, Any] = {"task": "simple", "seed": 11, "size": 32}
        evaluate(method=str(model), scenes=3, strategy="joint", out=out, workers=1, **arguments)
    rows = read_results(out)
    assert all(row.outcome != "success" for row in rows)
    write_results(out, [*rows[:2], replace(rows[2], grasp=None, value=None, errors=None, outcome="no_grasp")])
    return out


def run(results: Path, out: Path, *more: str) -> int:
    return cli.main(["replay", f"--results={results}", f"--out={out}", "--size=32", *more])


def test_failures_are_shown(results: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(results, tmp_path / "out", f"--model={model}", "--count=2") == 0
    files = sorted((tmp_path / "out").iterdir())
    assert [file.name for file in files] == ["scene-000000-attempt-0.png", "scene-000001-attempt-0.png"]
    printed = capsys.readouterr().out
    for row in read_results(results)[:2]:
        assert heading(row) in printed
    assert run(results, tmp_path / "plain", "--count=1") == 0
    with Image.open(files[0]) as imagined, Image.open(tmp_path / "plain" / files[0].name) as plain:
        assert imagined.size == plain.size  # the model's panels stand beside the truth's
        assert imagined.tobytes() != plain.tobytes()


def test_a_scene_is_shown_even_if_nothing_was_proposed(results: Path, tmp_path: Path) -> None:
    assert run(results, tmp_path / "out", "--scene=2") == 0
    with Image.open(tmp_path / "out" / "scene-000002-attempt-0.png") as shown:
        assert shown.width > 3 * 32


def test_an_attempt_has_its_line(results: Path) -> None:
    row: Row = replace(
        read_results(results)[0],
        outcome="slipped",
        value=1.234,
        errors={"distance_mm": 12.34, "angle_deg": 5.67},
    )
    assert heading(row) == "scene 0, attempt 0: slipped; value 1.23; 12.3 mm and 5.7° from the nearest valid grasp"


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--scene=3"], "holds no scene 3: its scenes are 0 to 2"),
        (["--scene=-1"], "scene is -1: it must be from 0"),
        (["--count=0"], "count is 0: it must be from 1"),
        (["--model=tn-laptop"], "model tn-laptop renders nothing: leave --model out"),
        (["--model=mv1-laptop"], "model mv1-laptop is [0-9a-f]{16}, the results are of [0-9a-f]{16}"),
        (["--size=48"], "scene 0, attempt 0 had other objects, or pictures of another size than 48"),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(
    more: list[str], message: str, results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(results, tmp_path / "out", *more) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    assert re.search(message, error)
    assert not (tmp_path / "out").exists()


def test_where_all_succeeded_there_is_nothing_to_show(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_results(tmp_path / "won.jsonl", [replace(row, outcome="success") for row in read_results(results)])
    assert run(tmp_path / "won.jsonl", tmp_path / "out") == 2
    assert "every attempt succeeded; --scene shows one" in capsys.readouterr().err
