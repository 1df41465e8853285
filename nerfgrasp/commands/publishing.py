"""Result folders that get all their files at once, or none."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerfgrasp.errors import UserError
from nerfgrasp.files import make_folder, remove

_PROBE_BYTES = 1 << 20


@contextmanager
def publishing(out: Path) -> Iterator[Path]:
    """Yields a temporary folder whose files move into `out` when the block ends well.

    `out` is made and tried at once, so that a folder that cannot be written is refused before any work is done;
    if the block fails, what was made is removed again. Other files in `out` stay as they are, but for the temporary
    folders that killed processes left there.

    Raises:
        UserError: `out` cannot be made or written, or the disk is full.
    """
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    temporary = out / f".{os.getpid()}.tmp"
    try:
        make_folder(out)
        _remove_abandoned(out)
        make_folder(temporary)
        _try_writing(temporary)
        yield temporary
        _move_files(temporary, out)
    except BaseException:
        remove(temporary)
        for folder in made:
            _remove_if_empty(folder)
        raise
    remove(temporary)


def _remove_abandoned(out: Path) -> None:
    """Removes temporary folders of processes that are no more; others may be at work on results of their own."""
    for path in out.glob(".*.tmp"):
        process = path.name.split(".")[1]
        if process.isdecimal() and path.is_dir() and not _lives(int(process)):
            remove(path)


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def _try_writing(folder: Path) -> None:
    probe = folder / "probe"
    try:
        probe.write_bytes(bytes(_PROBE_BYTES))
        probe.unlink()
    except OSError as error:
        raise UserError(f"cannot write {folder.parent}: {error.strerror or error}") from error


def _move_files(source: Path, out: Path) -> None:
    for path in sorted(source.iterdir()):
        try:
            path.replace(out / path.name)
        except OSError as error:
            raise UserError(f"cannot write {out / path.name}: {error.strerror or error}") from error


def _remove_if_empty(folder: Path) -> None:
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
