import os
import signal
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfgrasp.errors import UserError
from nerfgrasp.parallel import run_all


def missing(folder: Path, total: int) -> list[int]:
    return [index for index in range(total) if not (folder / str(index)).exists()]


# What workers do is made here, not imported: they cannot import a test.
def touching(folder: Path, **special: Any) -> Any:
    """Returns a job that makes the file of its number; piece 2 may die, once or for ever, or fail."""

    def job(index: int) -> tuple[int, int]:
        mark = folder.parent / "died"
        if index == 2 and special.get("fails"):
            raise special["fails"]
        if index == 2 and special.get("dies") and not (special["dies"] == "once" and mark.exists()):
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        (folder / str(index)).touch()
        return index, torch.get_num_threads()

    return job


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "done").mkdir()
    return tmp_path / "done"


def run(folder: Path, *, total: int = 5, results: list[Any] | None = None, **options: Any) -> None:
    special = {key: options.pop(key) for key in ("dies", "fails") if key in options}
    keep = None if results is None else results.append
    job = touching(folder, **special)
    run_all(job, partial(missing, folder, total), total, describe="touch", unit="file", keep=keep, **options)


WAYS = [{"workers": 1}, {"workers": 2}, {"workers": 2, "cluster": "ray"}]


@pytest.fixture(params=WAYS, ids=["one", "two", "ray"])
def way(request: pytest.FixtureRequest) -> dict[str, Any]:
    if "cluster" in request.param:
        request.getfixturevalue("ray_cluster")
    return request.param


def test_everything_is_done_once_in_one_thread(folder: Path, way: dict[str, Any]) -> None:
    results: list[tuple[int, int]] = []
    (folder / "1").touch()
    run(folder, results=results, **way)
    assert sorted(results) == [(0, 1), (2, 1), (3, 1), (4, 1)]
    assert missing(folder, 5) == []


@pytest.mark.parametrize("way", WAYS[1:], ids=["two", "ray"], indirect=True)
def test_the_work_of_a_dead_worker_is_done_again(
    folder: Path, way: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    run(folder, dies="once", **way)
    assert missing(folder, 5) == []
    assert (folder.parent / "died").exists()
    assert "touch: a worker process died (killed, or out of memory?); going on with the" in capsys.readouterr().err


def test_workers_that_keep_dying_are_told(folder: Path) -> None:
    with pytest.raises(UserError, match=r"worker processes died 3 times .*: try fewer workers"):
        run(folder, dies="always", workers=2)
    assert 2 in missing(folder, 5)


def test_an_error_comes_through(folder: Path, way: dict[str, Any]) -> None:
    with pytest.raises(UserError) as caught:
        run(folder, fails=UserError("object set: no such folder"), **way)
    assert str(caught.value) == "object set: no such folder"


def test_without_ray_one_line_names_the_extra(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(UserError, match=r"--cluster ray needs Ray: pip install 'nerfgrasp\[cluster\]'"):
        run(folder, cluster="ray")
    assert missing(folder, 5) == [0, 1, 2, 3, 4]


def test_nothing_missing_starts_nothing(folder: Path) -> None:
    run(folder, total=0, workers=2, fails=ZeroDivisionError())
