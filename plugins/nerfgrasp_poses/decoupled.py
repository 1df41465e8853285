"""Position and orientation as two groups of parameters, moved separately."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace


class Decoupled(ABC):
    """A pose as `position` `[..., 3]` in metres and `orientation` `[..., D]`; subclasses say what the latter is."""

    @abstractmethod
    def orientation(self, R: Tensor) -> Tensor:
        """Returns the parameters `[..., D]` of rotation matrices `[..., 3, 3]`."""

    @abstractmethod
    def rotation(self, orientation: Tensor) -> Tensor:
        """Returns the rotation matrices `[..., 3, 3]` of any parameters `[..., D]` that ascent may lead to."""

    def tidy(self, orientation: Tensor) -> Tensor:
        """Returns the usual parameters of the same rotations."""
        return self.orientation(self.rotation(orientation))

    def encode(self, T: Tensor) -> dict[str, Tensor]:
        """Returns the parameters of rigid transforms `T` `[..., 4, 4]`."""
        return {"position": T[..., :3, 3], "orientation": self.orientation(T[..., :3, :3])}

    def decode(self, params: dict[str, Tensor]) -> Tensor:
        """Returns the transforms `[..., 4, 4]` of parameters."""
        return make_pose(self.rotation(params["orientation"]), params["position"])

    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        """Returns tidy parameters of the same rotations, their positions clipped to `workspace`."""
        return {
            "position": clip(params["position"], workspace),
            "orientation": self.tidy(params["orientation"]),
        }


def clip(position: Tensor, workspace: Workspace) -> Tensor:
    """Returns the nearest positions `[..., 3]` in a workspace."""
    return torch.clamp(position, workspace.minimum.to(position), workspace.maximum.to(position))
