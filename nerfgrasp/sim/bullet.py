"""PyBullet, imported without the line about its build that it prints."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def silence() -> Iterator[None]:
    """Silences what C code prints: it goes past `sys.stdout` and `sys.stderr`, so only descriptors can."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept, nowhere = [os.dup(1), os.dup(2)], os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        for descriptor, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)
        os.close(nowhere)


with silence():
    import pybullet as p

__all__ = ["HULL_MARGIN", "p", "silence"]

HULL_MARGIN = 0.001
"""Metres by which Bullet inflates convex hulls; hulls are made smaller by as much."""
