"""Pinhole cameras: projection, rays through pixels, and cameras that look at a point."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfgrasp.geometry.frames import invert, make_pose, transform
from nerfgrasp.geometry.precision import exact


@dataclass(frozen=True)
class Camera:
    """Pinhole cameras of one image size, any batch shape (usually `[V]`, a scene's views).

    Indexing selects from the batch: `camera[:3]` holds the first three.
    """

    intrinsics: Tensor
    """`[..., 3, 3]` in pixels; pixel centres lie at +0.5."""
    T_world_camera: Tensor
    """`[..., 4, 4]`, OpenCV axes, metres."""
    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""

    def __getitem__(self, index: Any) -> "Camera":
        return Camera(self.intrinsics[index], self.T_world_camera[index], self.width, self.height)

    def __len__(self) -> int:
        return self.intrinsics.shape[0]

    def to(self, device: torch.device | str) -> "Camera":
        """Returns the same cameras on `device`."""
        return Camera(self.intrinsics.to(device), self.T_world_camera.to(device), self.width, self.height)


@exact
def project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Projects world points into cameras: u = K (R x + t) / z.

    Args:
        camera: batch shape `[...]`.
        points: `[..., N, 3]` in metres, world frame.

    Returns:
        Pixels `[..., N, 2]` (x, y) and depths along the optical axis `[..., N]` in metres. Points behind a
        camera have a negative depth, and their pixels mean nothing.
    """
    in_camera = transform(invert(camera.T_world_camera), points)
    depth = in_camera[..., 2]
    on_image = in_camera @ camera.intrinsics.transpose(-1, -2)
    return on_image[..., :2] / depth.clamp(min=1e-6)[..., None], depth


def sees_box(camera: Camera, minimum: Tensor, maximum: Tensor) -> Tensor:
    """Returns a bool `[...]`: whether any part of a box lies in a camera's image.

    Two convex bodies are apart if some normal of a face, or product of an edge of each, separates their corners: here
    the box and the pyramid of what the camera sees, up to a depth beyond the box.

    Args:
        camera: batch shape `[...]`.
        minimum: the box's lower corner `[3]`, metres, world frame.
        maximum: its upper corner.
    """
    choose = torch.cartesian_prod(*[torch.arange(2, device=minimum.device)] * 3).bool()
    T_camera_world = invert(camera.T_world_camera)
    box = transform(T_camera_world, torch.where(choose, maximum, minimum).to(T_camera_world))
    far = 1.1 * box[..., 2].amax(dim=-1).clamp(min=1e-6)
    u = torch.tensor([0.0, camera.width, camera.width, 0.0]).to(box)
    v = torch.tensor([0.0, 0.0, camera.height, camera.height]).to(box)
    on_image = torch.stack([u, v, torch.ones_like(u)], dim=-1)
    rays = on_image @ torch.linalg.inv(camera.intrinsics).transpose(-1, -2)
    pyramid = torch.cat([torch.zeros_like(rays[..., :1, :]), far[..., None, None] * rays], dim=-2)
    box_axes = T_camera_world[..., :3, :3].transpose(-1, -2)
    edges = torch.cat([rays, rays.roll(-1, dims=-2) - rays], dim=-2)
    sides = torch.linalg.cross(rays, rays.roll(-1, dims=-2))
    crossed = torch.linalg.cross(*torch.broadcast_tensors(box_axes[..., :, None, :], edges[..., None, :, :]))
    axis = torch.tensor([0.0, 0.0, 1.0]).to(box).expand_as(box[..., :1, :])
    axes = torch.cat([box_axes, axis, sides, crossed.flatten(-3, -2)], dim=-2)
    one, other = box @ axes.transpose(-1, -2), pyramid @ axes.transpose(-1, -2)
    apart = (one.amax(dim=-2) < other.amin(dim=-2)) | (other.amax(dim=-2) < one.amin(dim=-2))
    return ~apart.any(dim=-1)


def pixel_centres(width: int, height: int) -> Tensor:
    """Returns the centres `[height, width, 2]` (x, y) of an image's pixels."""
    x = torch.arange(width) + 0.5
    y = torch.arange(height) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


@exact
def pixel_rays(camera: Camera, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the world-frame rays through pixels.

    Args:
        camera: batch shape `[...]`.
        pixels: `[..., N, 2]` (x, y).

    Returns:
        Origins `[..., N, 3]` in metres and unit directions `[..., N, 3]`.
    """
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1)
    in_camera = homogeneous @ torch.linalg.inv(camera.intrinsics).transpose(-1, -2)
    directions = normalize(in_camera @ camera.T_world_camera[..., :3, :3].transpose(-1, -2), dim=-1)
    return camera.T_world_camera[..., None, :3, 3].expand_as(directions), directions


def look_at(eye: Tensor, target: Tensor, up: Tensor | None = None) -> Tensor:
    """Returns `T_world_camera` `[..., 4, 4]` of cameras at `eye` `[..., 3]` whose z axis points at `target`.

    The image's upper edge faces `up` (world z by default), which must not be parallel to the line of sight.
    """
    up = torch.tensor([0.0, 0.0, 1.0], dtype=eye.dtype, device=eye.device) if up is None else up
    forward = normalize(target - eye, dim=-1)
    right = normalize(torch.linalg.cross(forward, up.expand_as(forward)), dim=-1)
    down = torch.linalg.cross(forward, right)
    return make_pose(torch.stack([right, down, forward], dim=-1), eye)


def depth_along_axis(camera: Camera, distance: Tensor) -> Tensor:
    """Returns depth `[H, W]` along the optical axis of `distance` `[H, W]` along the pixels' rays, metres.

    Args:
        camera: batch shape `[]`.
        distance: of the camera's size.
    """
    pixels = pixel_centres(camera.width, camera.height).to(camera.intrinsics).flatten(0, 1)
    _, directions = pixel_rays(camera, pixels)
    return distance * (directions @ camera.T_world_camera[:3, 2]).view_as(distance)


def shrink(camera: Camera, longer_side: int) -> Camera:
    """Returns cameras that see the same in fewer pixels, the aspect ratio kept as far as whole pixels allow.

    Args:
        camera: any batch shape; comes back as it is if it is not larger.
        longer_side: of the smaller images, pixels.
    """
    scale = longer_side / max(camera.width, camera.height)
    if scale >= 1:
        return camera
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    ratio = torch.tensor([width / camera.width, height / camera.height, 1.0]).to(camera.intrinsics)
    return Camera(camera.intrinsics * ratio[:, None], camera.T_world_camera, width, height)
