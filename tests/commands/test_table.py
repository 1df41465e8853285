"""The table with a method of a stranger's distribution, by the command as it is typed."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("pybullet")

from nerfgrasp import cli
from nerfgrasp.commands import recipe

METHOD = "from nerfgrasp_baselines.random import Random\nclass Mine(Random): ...\n"
PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"
[project]
name = "their-dist"
version = "0.3"
[project.entry-points."nerfgrasp.baselines"]
their_method = "their_module:Mine"
[tool.hatch.build.targets.wheel]
only-include = ["their_module.py"]
"""


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, install: Callable[[Path, Path], None]) -> None:
    """An installed distribution that declares the method `their_method`."""
    source, site = tmp_path / "source", str(tmp_path / "site")
    source.mkdir()
    (source / "pyproject.toml").write_text(PROJECT)
    (source / "their_module.py").write_text(METHOD)
    install(source, Path(site))
    monkeypatch.syspath_prepend(site)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([site, *filter(None, [os.environ.get("PYTHONPATH")])]))


def test_a_stranger_s_method_has_a_row(
    stranger: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    out = tmp_path / "table"
    args = ["table", "--out", str(out), "--methods", "their_method", "--scenes", "2"]
    args += ["--clutter_scenes", "0", "--novel_poses", "0"]
    assert cli.main([*args, "--status"]) == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert first.split()[:3] == ["simple-their_method", "to", "do"]
    assert not out.exists()

    assert cli.main(args) == 0
    table = (out / "table.md").read_text()
    assert "\n| their_method | 0." in table
    assert "\n| MV3    |           0.84 |" in table
    assert "nerfgrasp evaluate --task simple --method their_method" in (out / "times.md").read_text()
    capsys.readouterr()
    assert cli.main([*args, "--status"]) == 0
    assert " done in 0:0" in capsys.readouterr().out.splitlines()[0]


def test_a_method_whose_model_is_not_shipped_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(recipe, "shipped_models", lambda: {"mv3-laptop": tmp_path})
    args = ["table", "--out", str(tmp_path / "out"), "--evaluate_only", "--novel_poses", "0", "--status"]
    assert cli.main([*args, "--methods", "no3", "mv3", "tn", "random"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "no model is shipped as no3-laptop, tn-laptop: left out of the table"
    stages = [line.split()[0] for line in lines[1:]]
    assert stages == ["simple-mv3", "clutter-mv3", "simple-random", "clutter-random", "report"]
    assert cli.main([*args, "--methods", "mv3", "--scale", "paper"]) == 2
    assert capsys.readouterr().err.endswith(": no model is shipped as mv3-paper: nothing is left to try\n")


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (["--methods", "randm"], "unknown method 'randm': did you mean 'random'"),
        (["--methods", "random", "--scenes", "0"], "scenes is 0: it must be from 1 to 999999"),
        (["--methods", "random", "--seeds", "0"], "seeds is 0: it must be from 1 to"),
        (["--methods", "random", "random"], "methods: random and random are both called random"),
        (["--methods", "random", "--sceens", "3"], "--sceens 3 (did you mean --scenes?)"),
        (["--methods", "random", "--scale", "desk"], "desk"),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_written(
    args: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["table", "--out", str(tmp_path / "out"), *args]) == 2
    err = capsys.readouterr().err
    assert line in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()
