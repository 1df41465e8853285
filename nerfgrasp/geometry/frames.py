"""Rigid transforms as 4x4 matrices. Rotations themselves are roma's."""

import torch
from torch import Tensor


def make_pose(rotation: Tensor, position: Tensor) -> Tensor:
    """Returns `[..., 4, 4]` from a rotation `[..., 3, 3]` and a position `[..., 3]` in metres."""
    batch = torch.broadcast_shapes(rotation.shape[:-2], position.shape[:-1])
    top = torch.cat([rotation.expand(*batch, 3, 3), position.expand(*batch, 3)[..., None]], dim=-1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=top.dtype, device=top.device)
    return torch.cat([top, bottom.expand(*batch, 1, 4)], dim=-2)


def transform(T_a_b: Tensor, points: Tensor) -> Tensor:
    """Maps points `[..., N, 3]` in frame b to frame a by `T_a_b` `[..., 4, 4]`."""
    return points @ T_a_b[..., :3, :3].transpose(-1, -2) + T_a_b[..., None, :3, 3]


def invert(T_a_b: Tensor) -> Tensor:
    """Returns `T_b_a` of a rigid `T_a_b` `[..., 4, 4]`."""
    rotation = T_a_b[..., :3, :3].transpose(-1, -2)
    return make_pose(rotation, -(rotation @ T_a_b[..., :3, 3:])[..., 0])


def is_rigid(T: Tensor, tolerance: float = 1e-4) -> Tensor:
    """Returns a bool `[...]`: whether `[..., 4, 4]` is a finite rotation and translation, within `tolerance`."""
    rotation = T[..., :3, :3]
    identity = torch.eye(3, dtype=T.dtype, device=T.device)
    orthogonal = ((rotation @ rotation.transpose(-1, -2) - identity).abs() < tolerance).all(-1).all(-1)
    last_row = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=T.dtype, device=T.device)
    proper = torch.det(rotation) > 0
    return orthogonal & proper & ((T[..., 3, :] - last_row).abs() < tolerance).all(-1) & T.isfinite().all(-1).all(-1)
