"""Slices through a grasp: planes of poses, in each of which two of its six coordinates change.

Coordinates are displacements from the grasp: tx, ty, tz along three axes through its tool centre point, and rx, ry, rz,
a rotation vector along the same axes.
"""

import math
from dataclasses import dataclass
from itertools import product
from typing import Literal

import roma
import torch
from scipy.optimize import linprog
from torch import Tensor

from nerfgrasp.errors import unknown_name
from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace

COORDINATES = ("tx", "ty", "tz", "rx", "ry", "rz")
SLICES = ("tx-ty", "tx-tz", "ty-tz", "rx-ry", "rx-rz", "ry-rz", "ty-rx", "ty-ry", "ty-rz")
"""Those usually shown: all of translations, all of rotations, and the mixed ones that the paper names."""

Axes = Literal["grasp", "world"]
"""Whose axes displacements are along: the grasp's own (x closes, z approaches) or the world's."""


@dataclass(frozen=True)
class Coordinate:
    """A coordinate and how far it goes; the grasp itself is at 0."""

    name: str
    """One of `COORDINATES`."""
    low: float
    """Metres or radians."""
    high: float
    """Metres or radians."""

    @property
    def turns(self) -> bool:
        """Whether it is a rotation."""
        return self.name.startswith("r")


@dataclass(frozen=True)
class Slice:
    """A grid of poses about a grasp."""

    across: Coordinate
    """Changes from column to column."""
    upward: Coordinate
    """Changes from row to row; the first row is the lowest."""
    T_world_grasp: Tensor
    """`[N, N, 4, 4]`."""
    inside: Tensor
    """Bool `[N, N]`: the poses that lie in the workspace."""

    @property
    def name(self) -> str:
        """Both coordinates, e.g. `tx-ty`."""
        return f"{self.across.name}-{self.upward.name}"

    @property
    def kind(self) -> str:
        """`translation`, `rotation` or `mixed`."""
        kinds = {"rotation" if axis.turns else "translation" for axis in (self.across, self.upward)}
        return kinds.pop() if len(kinds) == 1 else "mixed"


def cut_slice(
    T_world_grasp: Tensor,
    name: str,
    workspace: Workspace,
    *,
    size: int,
    axes: Axes = "grasp",
    reach: float | None = None,
    turn: float = math.pi / 2,
) -> Slice:
    """Returns a slice through a grasp.

    Args:
        T_world_grasp: the grasp, `[4, 4]`, in the workspace.
        name: two different coordinates, e.g. `tx-ty`.
        workspace: translations go as far as it does in the slice; what lies outside of it is marked.
        size: poses in each direction, N.
        axes: whose axes the coordinates are along.
        reach: translations go no farther than this, metres; None for all of the workspace.
        turn: rotations go this far to either side, radians.

    Raises:
        UserError: there is no such slice.
    """
    basis = T_world_grasp[:3, :3] if axes == "grasp" else torch.eye(3).to(T_world_grasp)
    numbers = _coordinates(name)
    moved = [number for number in numbers if number < 3]
    spans = dict(zip(moved, _spans(T_world_grasp[:3, 3], basis[:, moved], workspace, reach), strict=True))
    across, upward = (Coordinate(COORDINATES[number], *spans.get(number, (-turn, turn))) for number in numbers)
    steps = [torch.linspace(axis.low, axis.high, size).to(T_world_grasp) for axis in (upward, across)]
    displacement = T_world_grasp.new_zeros(size, size, 6)
    displacement[..., numbers[1]], displacement[..., numbers[0]] = torch.meshgrid(*steps, indexing="ij")
    position = T_world_grasp[:3, 3] + displacement[..., :3] @ basis.T
    rotation = roma.rotvec_to_rotmat(displacement[..., 3:] @ basis.T) @ T_world_grasp[:3, :3]
    low, high = workspace.minimum.to(position) - 1e-6, workspace.maximum.to(position) + 1e-6
    inside = ((position >= low) & (position <= high)).all(dim=-1)
    return Slice(across, upward, make_pose(rotation, position), inside)


def _coordinates(name: str) -> tuple[int, int]:
    parts = name.split("-")
    if len(parts) != 2 or parts[0] == parts[1] or not set(parts) <= set(COORDINATES):
        choices = [
            f"{a}-{b}" for a, b in product(COORDINATES, COORDINATES) if COORDINATES.index(a) < COORDINATES.index(b)
        ]
        raise unknown_name("slice", name, choices)
    return COORDINATES.index(parts[0]), COORDINATES.index(parts[1])


def _spans(point: Tensor, basis: Tensor, workspace: Workspace, reach: float | None) -> list[tuple[float, float]]:
    """How far the workspace goes along the axes `[3, K]` of a line or plane through a point in it, metres."""
    sides = torch.cat([basis, -basis]).double()
    room = torch.cat([workspace.maximum.to(point) - point, point - workspace.minimum.to(point)]).double().clamp(min=0.0)
    farthest = math.inf if reach is None else reach
    spans = []
    for axis in torch.eye(basis.shape[1]).tolist():
        low, high = (
            sign * linprog([sign * share for share in axis], sides.numpy(), room.numpy(), bounds=(None, None)).fun
            for sign in (1.0, -1.0)
        )
        spans.append((max(low, -farthest), min(high, farthest)))
    return spans
