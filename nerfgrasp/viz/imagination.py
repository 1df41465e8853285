"""The scene as a model imagines it, from sides that no input image shows and from a grasp's own viewpoint."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from nerfgrasp.geometry import Camera, look_at, shrink
from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.scenes.scene import Observations, Workspace
from nerfgrasp.viz.figures import Panel
from nerfgrasp.viz.renderings import RenderedView, panels, render_views

IMAGINED, FROM_GRASP = "imagined", "from_grasp"
"""The names of what `imagine` renders: the side that the inputs leave out, and what lies before a grasp."""
GRASP_DISTANCE = 0.18
"""Metres from the tool centre point at which the grasp's own viewpoint lies, behind the palm."""
_TITLES = {IMAGINED: "imagined from another side", FROM_GRASP: "imagined from the grasp"}


def imagine(
    model: GraspValue,
    observations: Observations,
    workspace: Workspace,
    T_world_grasp: Tensor | None = None,
    longer_side: int = 128,
) -> dict[str, RenderedView]:
    """Renders the model's RGB and depth from the side that its input images leave out, and from a grasp.

    Args:
        model: its backbone renders.
        observations: as many views as the model sees at once are used, from the front.
        workspace: where the scene is.
        T_world_grasp: `[4, 4]`, see `grasp_camera`; without it the second render is left out.
        longer_side: an image larger than this is rendered smaller, to keep it quick; pixels.
    """
    used = observations.select(slice(model.views))
    camera = shrink(opposite_camera(used.camera, workspace), longer_side)
    found = {IMAGINED: next(render_views(model.backbone, used, camera[None], workspace))}
    if T_world_grasp is not None:
        found |= imagine_from_grasp(model, observations, workspace, T_world_grasp, longer_side)
    return found


def imagine_from_grasp(
    model: GraspValue, observations: Observations, workspace: Workspace, T_world_grasp: Tensor, size: int = 128
) -> dict[str, RenderedView]:
    """Renders as `imagine` does, but from the grasp `[4, 4]` alone; `size` pixels wide and high."""
    used = observations.select(slice(model.views))
    camera = grasp_camera(T_world_grasp.to(used.images), size)
    return {FROM_GRASP: next(render_views(model.backbone, used, camera[None], workspace))}


def imagined_panels(views: Mapping[str, RenderedView]) -> list[list[Panel]]:
    """Returns rows of panels of what `imagine` rendered: RGB and depth of each view."""
    rows = []
    for name, view in views.items():
        shown, close = panels(view), name == FROM_GRASP
        titles = {"rendered": _TITLES[name], "depth": "its depth"}
        rows.append([Panel(title, shown[key].image, view.camera, fingers_only=close) for key, title in titles.items()])
    return rows


def grasp_camera(T_world_grasp: Tensor, size: int = 128) -> Camera:
    """Returns a camera, batch shape `[]`, behind a grasp `[4, 4]` that looks along its approach.

    The tool centre point is amid a square image of `size` pixels, which shows there as much as the camera is away; the
    closing axis is horizontal.
    """
    T_grasp_camera = torch.eye(4).to(T_world_grasp)
    T_grasp_camera[2, 3] = -GRASP_DISTANCE
    intrinsics = torch.tensor([[size, 0.0, size / 2], [0.0, size, size / 2], [0.0, 0.0, 1.0]]).to(T_world_grasp)
    return Camera(intrinsics, T_world_grasp @ T_grasp_camera, size, size)


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
