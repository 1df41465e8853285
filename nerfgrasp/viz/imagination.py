"""The scene as a model imagines it, from sides that no input image shows."""

import math

import torch
from torch import Tensor

from nerfgrasp.geometry import Camera, look_at, shrink
from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.scenes.scene import Observations, Workspace
from nerfgrasp.viz.figures import Panel
from nerfgrasp.viz.renderings import panels, render_views


def imagine(model: GraspValue, observations: Observations, workspace: Workspace, longer_side: int = 128) -> list[Panel]:
    """Renders the model's RGB and depth from the side that its input images leave out.

    Args:
        model: its backbone renders.
        observations: as many views as the model sees at once are used, from the front.
        workspace: where the scene is.
        longer_side: an image larger than this is rendered smaller, to keep it quick; pixels.
    """
    used = observations.select(slice(model.views))
    camera = shrink(opposite_camera(used.camera, workspace), longer_side)
    shown = panels(next(render_views(model.backbone, used, camera[None], workspace)))
    titles = {"rendered": "imagined from another side", "depth": "its depth"}
    return [Panel(title, shown[name].image, camera) for name, title in titles.items()]


def opposite_camera(camera: Camera, workspace: Workspace) -> Camera:
    """Returns a camera, batch shape `[]`, that looks at the workspace from amid the cameras' widest gap.

    Args:
        camera: batch shape `[V]`.
        workspace: whose centre on the table it looks at.
    """
    azimuth = _azimuths(camera, workspace).sort().values
    gaps = torch.diff(azimuth, append=azimuth[:1] + 2 * math.pi)
    widest = gaps.argmax()
    return orbit(camera, workspace, azimuth[widest] + gaps[widest] / 2)


def full_orbit(camera: Camera, workspace: Workspace, frames: int) -> Camera:
    """Returns cameras `[frames]` evenly about the workspace, from where the first camera of `[V]` stands on."""
    turn = torch.arange(frames).to(camera.intrinsics) * (2 * math.pi / frames)
    return orbit(camera, workspace, _azimuths(camera, workspace)[0] + turn)


def orbit(camera: Camera, workspace: Workspace, azimuth: Tensor) -> Camera:
    """Returns cameras `[...]` at azimuths `[...]` (radians, about z) that look at the workspace.

    Their distance and height are the mean of the given cameras', their intrinsics those of the first.

    Args:
        camera: batch shape `[V]`.
        workspace: whose centre on the table they look at.
        azimuth: radians.
    """
    centre = _centre(workspace)
    offset = camera.T_world_camera[:, :3, 3] - centre
    radius, height = offset[:, :2].norm(dim=-1).mean(), offset[:, 2].mean()
    eye = centre + torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), height.expand_as(azimuth)], dim=-1)
    intrinsics = camera.intrinsics[0].expand(*azimuth.shape, 3, 3)
    return Camera(intrinsics, look_at(eye, centre), camera.width, camera.height)


def _azimuths(camera: Camera, workspace: Workspace) -> Tensor:
    offset = camera.T_world_camera[:, :3, 3] - _centre(workspace)
    return torch.atan2(offset[:, 1], offset[:, 0])


def _centre(workspace: Workspace) -> Tensor:
    """The workspace's centre on the table `[3]`."""
    return torch.cat([(workspace.minimum + workspace.maximum)[:2] / 2, workspace.minimum[2:]])
