"""Ranking grasps, and keeping those that differ."""

import math

import roma
import torch
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.scenes.scene import Grasps


def best_first(T_world_grasp: Tensor, value: Tensor) -> Grasps:
    """Sorts grasps by value, best first; those whose pose or value is not finite are left out.

    Args:
        T_world_grasp: `[P, 4, 4]`.
        value: `[P]`.
    """
    finite = value.isfinite() & T_world_grasp.flatten(1).isfinite().all(dim=1)
    kept = torch.nonzero(finite)[:, 0]
    order = kept[torch.sort(value[kept], descending=True, stable=True).indices]
    return Grasps(T_world_grasp[order], value[order])


def finite_first(T_world_grasp: Tensor, value: Tensor) -> Grasps:
    """As `best_first`, of which at least one is finite.

    Raises:
        UserError: none is.
    """
    grasps = best_first(T_world_grasp, value)
    if len(grasps) == 0:
        raise UserError("no candidate has a finite value: the model's weights may be damaged")
    return grasps


def grasp_angle(rotation: Tensor, other: Tensor) -> Tensor:
    """Returns the angle between grasp rotations `[..., 3, 3]` in radians, in [0, π].

    A parallel gripper looks the same after a half turn about its approach axis, so the smaller of the two
    angles counts.
    """
    half_turn = torch.tensor([-1.0, -1.0, 1.0], dtype=rotation.dtype, device=rotation.device)
    angles = [roma.rotmat_geodesic_distance(rotation, turned) for turned in (other, other * half_turn)]
    return torch.minimum(*angles)


DISTANCE, ANGLE = 0.02, math.radians(30.0)
"""Metres and radians: grasps that are nearer to each other in both are nearly the same."""


def alike(T_world_grasp: Tensor, other: Tensor, distance: float = DISTANCE, angle: float = ANGLE) -> Tensor:
    """Says of grasps `[..., 4, 4]` and others, broadcast, which are nearly the same: `[...]`, bool.

    Args:
        T_world_grasp: the ones.
        other: the others.
        distance: they are nearly the same if their positions are closer than this, metres, ...
        angle: ... and their rotations too, radians; a half turn of the gripper makes no difference.
    """
    one, two = torch.broadcast_tensors(T_world_grasp, other)
    near = (one[..., :3, 3] - two[..., :3, 3]).norm(dim=-1) < distance
    return near & (grasp_angle(one[..., :3, :3], two[..., :3, :3]) < angle)


def distinct(grasps: Grasps, distance: float = DISTANCE, angle: float = ANGLE, count: int | None = None) -> Grasps:
    """Drops each grasp that is nearly the same as a better one (greedy suppression).

    Args:
        grasps: best first.
        distance: see `alike`.
        angle: likewise.
        count: stop after this many grasps; None for all.

    Returns:
        The grasps left, best first.
    """
    T = grasps.T_world_grasp
    open_ = torch.ones(len(grasps), dtype=torch.bool, device=T.device)
    kept: list[int] = []
    while len(kept) != count and bool(open_.any()):
        best = int(torch.argmax(open_.byte()))
        open_ &= ~alike(T, T[best], distance, angle)
        open_[best] = False
        kept.append(best)
    return Grasps(T[kept], grasps.value[kept])
