"""Position and unit quaternion, moved separately: the parameterization of the method's Algorithm 1."""

import roma
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace


class Quaternion:
    """A pose as `position` `[..., 3]` in metres and `orientation` `[..., 4]`, a quaternion xyzw.

    The quaternion may have any length but zero: `decode` normalises it, so that an unconstrained gradient step
    always lands on a pose, and `project` brings it back to length one.

    Example:
        >>> pose = Quaternion()
        >>> params = pose.encode(torch.eye(4))
        >>> {name: value.tolist() for name, value in params.items()}
        {'position': [0.0, 0.0, 0.0], 'orientation': [0.0, 0.0, 0.0, 1.0]}
        >>> torch.equal(pose.decode(params), torch.eye(4))
        True
    """

    def encode(self, T: Tensor) -> dict[str, Tensor]:
        """Returns the parameters of rigid transforms `T` `[..., 4, 4]`."""
        return {"position": T[..., :3, 3], "orientation": roma.rotmat_to_unitquat(T[..., :3, :3])}

    def decode(self, params: dict[str, Tensor]) -> Tensor:
        """Returns the transforms `[..., 4, 4]` of parameters, whatever the quaternion's length."""
        rotation = roma.unitquat_to_rotmat(normalize(params["orientation"], dim=-1))
        return make_pose(rotation, params["position"])

    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        """Returns the nearest parameters whose position lies in `workspace` and whose quaternion is of length one."""
        position = params["position"]
        minimum, maximum = workspace.minimum.to(position), workspace.maximum.to(position)
        return {
            "position": torch.clamp(position, minimum, maximum),
            "orientation": normalize(params["orientation"], dim=-1),
        }
