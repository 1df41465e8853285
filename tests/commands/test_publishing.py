import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from nerfgrasp.commands.publishing import publishing
from nerfgrasp.errors import UserError


def write_half(path: Path) -> None:
    path.write_text("half")
    raise InterruptedError


def test_files_appear_together_at_the_end(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    with publishing(out) as folder:
        (folder / "one").write_text("1")
        (folder / "two").write_text("2")
        assert not (out / "one").exists()
    assert sorted(path.name for path in out.iterdir()) == ["one", "two"]


def test_results_replace_older_ones_and_leave_others_alone(tmp_path: Path) -> None:
    (tmp_path / "one").write_text("old")
    (tmp_path / "mine").write_text("mine")
    with publishing(tmp_path) as folder:
        (folder / "one").write_text("new")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"one": "new", "mine": "mine"}


def test_a_failure_leaves_everything_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "one").write_text("old")
    for out in (tmp_path, tmp_path / "new" / "deep"):
        with pytest.raises(InterruptedError), publishing(out) as folder:
            write_half(folder / "one")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"one": "old"}


def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    for name in (f".{ended.pid}.tmp", f".{os.getppid()}.tmp", ".mine.tmp"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "half").write_text("half")
    with publishing(tmp_path) as folder:
        (folder / "one").write_text("1")
    assert {path.name for path in tmp_path.iterdir()} == {"one", f".{os.getppid()}.tmp", ".mine.tmp"}


def test_a_path_through_a_file_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write .*file"), publishing(tmp_path / "file" / "out"):
        pytest.fail("the work began")


def test_a_full_disk_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(UserError, match="No space left on device"), publishing(tmp_path / "out"):
        pytest.fail("the work began")
    assert not (tmp_path / "out").exists()
