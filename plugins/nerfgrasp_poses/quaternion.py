"""Position and unit quaternion, moved separately: the parameterization of the method's Algorithm 1."""

import roma
from torch import Tensor
from torch.nn.functional import normalize

from nerfgrasp_poses.decoupled import Decoupled


class Quaternion(Decoupled):
    """`orientation` `[..., 4]` is a quaternion xyzw.

    It may have any length but zero: `decode` normalises it, so that an unconstrained gradient step always lands on a
    pose, and `project` brings it back to length one.

    Example:
        >>> import torch
        >>> pose = Quaternion()
        >>> params = pose.encode(torch.eye(4))
        >>> {name: value.tolist() for name, value in params.items()}
        {'position': [0.0, 0.0, 0.0], 'orientation': [0.0, 0.0, 0.0, 1.0]}
        >>> torch.equal(pose.decode(params), torch.eye(4))
        True
    """

    def orientation(self, R: Tensor) -> Tensor:
        """Returns unit quaternions `[..., 4]`."""
        return roma.rotmat_to_unitquat(R)

    def rotation(self, orientation: Tensor) -> Tensor:
        """Returns the rotations of quaternions of any length but zero."""
        return roma.unitquat_to_rotmat(normalize(orientation, dim=-1))

    def tidy(self, orientation: Tensor) -> Tensor:
        """Returns quaternions of length one."""
        return normalize(orientation, dim=-1)
