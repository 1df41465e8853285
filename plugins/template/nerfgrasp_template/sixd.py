"""The continuous 6D rotation as a pose parameterization.

Source: Zhou et al., "On the Continuity of Rotation Representations in Neural Networks" (2019).
"""

import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace


class SixD:
    """A pose as `position` `[..., 3]` in metres and `orientation` `[..., 6]`.

    The orientation holds the first two columns of the rotation matrix, one after the other. Any two vectors that
    are not parallel decode to a rotation by Gram-Schmidt, continuously.

    Example:
        >>> SixD().encode(torch.eye(4))["orientation"].tolist()
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    """

    def encode(self, T: Tensor) -> dict[str, Tensor]:
        """Returns the parameters of rigid transforms `T` `[..., 4, 4]`."""
        return {"position": T[..., :3, 3], "orientation": torch.cat([T[..., :3, 0], T[..., :3, 1]], dim=-1)}

    def decode(self, params: dict[str, Tensor]) -> Tensor:
        """Returns the transforms `[..., 4, 4]` of parameters."""
        columns = params["orientation"].unflatten(-1, (2, 3)).transpose(-1, -2)
        return make_pose(roma.special_gramschmidt(columns), params["position"])

    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        """Returns parameters with orthonormal columns and the position clipped to `workspace`."""
        position = params["position"]
        clipped = torch.clamp(position, workspace.minimum.to(position), workspace.maximum.to(position))
        return {"position": clipped, "orientation": self.encode(self.decode(params))["orientation"]}
