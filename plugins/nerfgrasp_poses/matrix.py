"""Position and rotation matrix, moved separately."""

import roma
from torch import Tensor

from nerfgrasp_poses.decoupled import Decoupled


class Matrix(Decoupled):
    """`orientation` `[..., 9]` is a matrix, row after row, that stands for the rotation nearest to it.

    Nearest in the Frobenius norm (orthogonal Procrustes); `project` puts that rotation in its place.

    Example:
        >>> import torch
        >>> Matrix().encode(torch.eye(4))["orientation"].tolist()
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    """

    def orientation(self, R: Tensor) -> Tensor:
        """Returns the matrices' entries."""
        return R.flatten(-2)

    def rotation(self, orientation: Tensor) -> Tensor:
        """Returns the rotations nearest to any matrices."""
        return roma.special_procrustes(orientation.unflatten(-1, (3, 3)))
