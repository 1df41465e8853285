"""Views of a packed set's scenes as tensors."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.geometry import Camera
from nerfgrasp.scenes.scene import Workspace


class Views(NamedTuple):
    """Images from known cameras, in a form that loaders stack and trainers move."""

    images: Tensor
    """`[..., 3, H, W]`, RGB in [0, 1]."""
    intrinsics: Tensor
    """`[..., 3, 3]`, pixels."""
    T_world_camera: Tensor
    """`[..., 4, 4]`, metres."""
    minimum: Tensor
    """The lower corner of the workspace that they show, metres; broadcasts with the cameras' positions `[..., 3]`."""
    maximum: Tensor
    """Its upper corner."""

    def camera(self) -> Camera:
        """Returns the cameras, batch shape `[...]`."""
        height, width = self.images.shape[-2:]
        return Camera(self.intrinsics, self.T_world_camera, width, height)

    def workspace(self) -> Workspace:
        """Returns the workspace."""
        return Workspace(self.minimum, self.maximum)


def read_views(scenes: PackedScenes, scene: int, views: np.ndarray) -> Views:
    """Returns views `[V]` of one scene, batch shape `[V]`, the workspace's `[1]`."""
    camera = scenes.camera(scene)[torch.from_numpy(np.asarray(views))]
    corners = scenes.workspace.minimum[None], scenes.workspace.maximum[None]
    return Views(to_float(scenes.images[scene][views]), camera.intrinsics, camera.T_world_camera, *corners)


def to_float(images: np.ndarray) -> Tensor:
    """Maps uint8 `[..., H, W, 3]` to float32 `[..., 3, H, W]` in [0, 1]."""
    return torch.from_numpy(images.astype(np.float32) / 255.0).movedim(-1, -3).contiguous()
