"""Files that appear whole or not at all, and mistakes with them told in one line."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from nerfgrasp.errors import UserError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary sibling to write, a file or a folder, that becomes `path` when the block ends well.

    The name holds the process, so that two processes that write one path do not meet; what a killed one leaves
    behind, `remove_temporaries` clears.

    Raises:
        UserError: the disk is full, the folder is read-only, or `path` is a folder with something in it.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        remove(temporary)


def write_json(path: Path, data: Any, indent: int | None = None) -> None:
    """Writes JSON atomically and puts it on the disk; a number that is not finite is a ValueError."""
    with replacing(path) as temporary:
        write_through(temporary, (json.dumps(data, indent=indent, allow_nan=False) + "\n").encode())


def write_through(path: Path, data: bytes) -> None:
    """Writes a file and puts it on the disk."""
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def read_json(path: Path) -> dict[str, Any]:
    """Reads a file that holds one JSON object.

    Raises:
        UserError: there is no such file, it cannot be read, or it holds something else.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file") from error
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not valid JSON: {error}") from error
    if not isinstance(data, dict):
        raise UserError(f"{path} is not a JSON object")
    return data


def make_folder(folder: Path) -> None:
    """Makes a folder and its parents, if it is not there.

    Raises:
        UserError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror or error}") from error


def remove_temporaries(folder: Path) -> None:
    """Removes what a killed process left in `folder`."""
    for path in folder.glob(".*.tmp"):
        remove(path)


def remove(path: Path) -> None:
    """Removes a file or a folder, if it is there and can be removed."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        # A read-only file system refuses even where there is nothing to remove.
        with suppress(OSError):
            path.unlink(missing_ok=True)
