"""Position, axis and angle, moved separately."""

import math

import roma
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfgrasp_poses.decoupled import Decoupled

_LEAST_ANGLE = 1e-9
"""Radians below which a rotation has no axis to speak of; it gets z."""


class AxisAngle(Decoupled):
    """`orientation` `[..., 4]` is an axis of any length but zero, then an angle in radians.

    `project` brings the axis to length one and the angle into [-π, π].

    Example:
        >>> import torch
        >>> AxisAngle().encode(torch.eye(4))["orientation"].tolist()
        [0.0, 0.0, 1.0, 0.0]
    """

    def orientation(self, R: Tensor) -> Tensor:
        """Returns unit axes and angles in [0, π]."""
        vector = roma.rotmat_to_rotvec(R)
        angle = vector.norm(dim=-1, keepdim=True)
        upwards = vector.new_tensor([0.0, 0.0, 1.0]).expand_as(vector)
        axis = torch.where(angle > _LEAST_ANGLE, vector / angle.clamp(min=_LEAST_ANGLE), upwards)
        return torch.cat([axis, angle], dim=-1)

    def rotation(self, orientation: Tensor) -> Tensor:
        """Returns the rotations about axes of any length but zero."""
        axis, angle = orientation.split([3, 1], dim=-1)
        return roma.rotvec_to_rotmat(normalize(axis, dim=-1) * angle)

    def tidy(self, orientation: Tensor) -> Tensor:
        """Returns unit axes, and angles within a turn; unlike by way of the rotation, an axis survives angle zero."""
        axis, angle = orientation.split([3, 1], dim=-1)
        turned = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
        return torch.cat([normalize(axis, dim=-1), torch.where(angle.abs() > math.pi, turned, angle)], dim=-1)
