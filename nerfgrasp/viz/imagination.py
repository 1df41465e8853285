"""The scene as a model imagines it, from a side that no input image shows."""

import math

import torch
from torch import Tensor

from nerfgrasp.geometry import Camera, look_at
from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.models.rendering import render_image
from nerfgrasp.scenes.scene import Observations, Workspace
from nerfgrasp.viz.figures import Panel

OUTSIDE = 0.93
"""The grey of pixels whose rays miss the model's box."""


def imagine(model: GraspValue, observations: Observations, workspace: Workspace, longer_side: int = 128) -> list[Panel]:
    """Renders the model's RGB and depth from the side that its input images leave out.

    Args:
        model: its backbone renders.
        observations: as many views as the model sees at once are used, from the front.
        workspace: where the scene is.
        longer_side: an image larger than this is rendered smaller, to keep it quick; pixels.
    """
    used = observations.select(slice(model.views))
    camera = _shrink(opposite_camera(used.camera, workspace), longer_side)
    rgb, depth, inside = render_image(model.backbone, model.observe(used, workspace), camera, workspace)
    rgb = torch.where(inside[..., None], rgb, torch.full_like(rgb, OUTSIDE))
    return [
        Panel("imagined from another side", rgb, camera),
        Panel("its depth", colour_depth(depth, inside), camera),
    ]


def opposite_camera(camera: Camera, workspace: Workspace) -> Camera:
    """Returns a camera, batch shape `[]`, that looks at the workspace from amid the cameras' widest gap.

    Its distance and height are the mean of theirs, its intrinsics those of the first.

    Args:
        camera: batch shape `[V]`.
        workspace: whose centre on the table it looks at.
    """
    centre = torch.cat([(workspace.minimum + workspace.maximum)[:2] / 2, workspace.minimum[2:]])
    offset = camera.T_world_camera[:, :3, 3] - centre
    azimuth = torch.atan2(offset[:, 1], offset[:, 0]).sort().values
    gaps = torch.diff(azimuth, append=azimuth[:1] + 2 * math.pi)
    widest = gaps.argmax()
    middle = azimuth[widest] + gaps[widest] / 2
    radius = offset[:, :2].norm(dim=-1).mean()
    eye = centre + torch.stack([radius * middle.cos(), radius * middle.sin(), offset[:, 2].mean()])
    return Camera(camera.intrinsics[0], look_at(eye, centre), camera.width, camera.height)


def colour_depth(depth: Tensor, inside: Tensor) -> Tensor:
    """Returns depth `[H, W]` as RGB `[H, W, 3]` in [0, 1]: bright is near, grey where not `inside` `[H, W]`."""
    from matplotlib import colormaps

    colour = torch.full((*depth.shape, 3), OUTSIDE)
    if inside.any():
        near, far = torch.quantile(depth[inside], torch.tensor([0.01, 0.99], device=depth.device))
        share = ((far - depth) / (far - near).clamp(min=1e-6)).clamp(0.0, 1.0)
        painted = torch.from_numpy(colormaps["magma"](share.cpu().numpy())[..., :3]).float()
        colour = torch.where(inside.cpu()[..., None], painted, colour)
    return colour


def _shrink(camera: Camera, longer_side: int) -> Camera:
    scale = longer_side / max(camera.width, camera.height)
    if scale >= 1:
        return camera
    width, height = round(camera.width * scale), round(camera.height * scale)
    ratio = torch.tensor([width / camera.width, height / camera.height, 1.0]).to(camera.intrinsics)
    return Camera(camera.intrinsics * ratio[:, None], camera.T_world_camera, width, height)
