"""PyBullet, imported without the line about its build that it prints, and what is handed to it in its own terms."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import roma
import torch
from numpy.typing import NDArray


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

__all__ = ["HULL_MARGIN", "Pose", "box_compound", "matrix", "p", "quaternion", "silence"]

HULL_MARGIN = 0.001
"""Metres by which Bullet inflates convex hulls; hulls are made smaller by as much."""

Pose = NDArray[np.float64]
"""`[4, 4]`."""


def quaternion(rotation: NDArray[np.float64]) -> list[float]:
    """Returns the quaternion xyzw of a rotation `[3, 3]`."""
    xyzw: list[float] = roma.rotmat_to_unitquat(torch.from_numpy(rotation.copy())).tolist()
    return xyzw


def matrix(position: Sequence[float], orientation: Sequence[float]) -> Pose:
    """Returns the pose of a position and a quaternion xyzw."""
    T = np.eye(4)
    T[:3, :3] = roma.unitquat_to_rotmat(torch.tensor(orientation, dtype=torch.float64)).numpy()
    T[:3, 3] = position
    return T


def box_compound(client: int, centres: Sequence[tuple[float, ...]], halves: Sequence[tuple[float, ...]]) -> int:
    """Makes one collision shape of boxes and returns its number.

    Args:
        client: the connection.
        centres: of the boxes, metres.
        halves: half of each box's size along x, y and z, metres.
    """
    count = len(centres)
    shape: int = p.createCollisionShapeArray(
        shapeTypes=[p.GEOM_BOX] * count,
        halfExtents=[list(half) for half in halves],
        collisionFramePositions=[list(centre) for centre in centres],
        physicsClientId=client,
    )
    return shape
