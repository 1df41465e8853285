"""Position and rotation vector, moved separately."""

import roma
from torch import Tensor

from nerfgrasp_poses.decoupled import Decoupled


class RotationVector(Decoupled):
    """`orientation` `[..., 3]` is a rotation vector: the axis times the angle in radians.

    `project` brings its length to π at most; rotations of π have two vectors, between which a climb may jump.

    Example:
        >>> import torch
        >>> RotationVector().encode(torch.eye(4))["orientation"].tolist()
        [0.0, 0.0, 0.0]
    """

    def orientation(self, R: Tensor) -> Tensor:
        """Returns rotation vectors `[..., 3]` no longer than π."""
        return roma.rotmat_to_rotvec(R)

    def rotation(self, orientation: Tensor) -> Tensor:
        """Returns the rotations of vectors of any length."""
        return roma.rotvec_to_rotmat(orientation)
