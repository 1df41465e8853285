"""Views of scenes as tensors."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerfgrasp.data.sources import SceneSource
from nerfgrasp.geometry import Camera, crop_to_box
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


def read_views(scenes: SceneSource, scene: int, views: np.ndarray, size: int | None = None) -> Views:
    """Returns views `[V]` of one scene, batch shape `[V]`, the workspace's `[1]`.

    Args:
        scenes: where from.
        scene: its number.
        views: their numbers.
        size: images of another size are cut to the workspace and resampled to a square of that side, as
            `MVNeRF.fit_images` does it; None takes them as they are.
    """
    camera = scenes.camera(scene)[torch.from_numpy(np.asarray(views))]
    workspace = scenes.workspace_of(scene)
    images = to_float(scenes.read_images(scene, views))
    if size is not None and images.shape[-2:] != (size, size):
        images, camera = crop_to_box(images, camera, workspace.minimum, workspace.maximum, size)
    corners = workspace.minimum[None], workspace.maximum[None]
    return Views(images, camera.intrinsics, camera.T_world_camera, *corners)


def to_float(images: np.ndarray) -> Tensor:
    """Maps uint8 `[..., H, W, 3]` to float32 `[..., 3, H, W]` in [0, 1]."""
    return torch.from_numpy(images.astype(np.float32) / 255.0).movedim(-1, -3).contiguous()
