"""PyBullet, imported without the line about its build that it prints."""

import os
import sys


def _import_quietly() -> None:
    # The line comes from C, past sys.stderr: only the file descriptor silences it.
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        import pybullet  # noqa: F401
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


_import_quietly()

import pybullet as p  # noqa: E402  # the module itself, now loaded

__all__ = ["p"]
