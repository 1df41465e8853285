"""Ranking grasps, and keeping those that differ."""

import math

import roma
import torch
from torch import Tensor

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


def grasp_angle(rotation: Tensor, other: Tensor) -> Tensor:
    """Returns the angle between grasp rotations `[..., 3, 3]` in radians, in [0, π].

    A parallel gripper looks the same after a half turn about its approach axis, so the smaller of the two
    angles counts.
    """
    half_turn = torch.tensor([-1.0, -1.0, 1.0], dtype=rotation.dtype, device=rotation.device)
    angles = [roma.rotmat_geodesic_distance(rotation, turned) for turned in (other, other * half_turn)]
    return torch.minimum(*angles)


def distinct(
    grasps: Grasps, distance: float = 0.02, angle: float = math.radians(30.0), count: int | None = None
) -> Grasps:
    """Drops each grasp that is nearly the same as a better one (greedy suppression).

    Args:
        grasps: best first.
        distance: two grasps are nearly the same if their positions are closer than this, metres, ...
        angle: ... and their rotations too, radians; a half turn of the gripper makes no difference.
        count: stop after this many grasps; None for all.

    Returns:
        The grasps left, best first.
    """
    position, rotation = grasps.T_world_grasp[:, :3, 3], grasps.T_world_grasp[:, :3, :3]
    open_ = torch.ones(len(grasps), dtype=torch.bool, device=position.device)
    kept: list[int] = []
    while len(kept) != count and bool(open_.any()):
        best = int(torch.argmax(open_.byte()))
        near = (position - position[best]).norm(dim=-1) < distance
        alike = grasp_angle(rotation, rotation[best].expand_as(rotation)) < angle
        open_ &= ~(near & alike)
        open_[best] = False
        kept.append(best)
    return Grasps(grasps.T_world_grasp[kept], grasps.value[kept])
