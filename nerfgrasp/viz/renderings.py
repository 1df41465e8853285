"""Views as a model renders them, beside the truth where it is known, and the colours that show them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfgrasp.geometry import Camera, depth_along_axis
from nerfgrasp.models.mvnerf import MVNeRF
from nerfgrasp.models.rendering import render_image
from nerfgrasp.scenes.scene import Observations, Workspace
from nerfgrasp.viz.figures import Panel

OUTSIDE = 0.93
"""The grey of pixels whose rays miss the model's box."""
WORST = 0.3
"""An error of a colour, mean over its channels, from which on it is drawn brightest."""


@dataclass(frozen=True)
class RenderedView:
    """What a model renders of one view."""

    camera: Camera
    """Batch shape `[]`."""
    rgb: Tensor
    """`[H, W, 3]` in [0, 1]."""
    depth: Tensor
    """`[H, W]` along the optical axis, metres."""
    inside: Tensor
    """`[H, W]` bool: pixels whose rays meet the model's box about the workspace. Elsewhere nothing is rendered."""
    truth: Tensor | None = None
    """`[H, W, 3]` in [0, 1], where it is known."""
    true_depth: Tensor | None = None
    """`[H, W]` along the optical axis, metres, where it is known."""


def render_views(model: MVNeRF, inputs: Observations, camera: Camera, workspace: Workspace) -> Iterator[RenderedView]:
    """Renders a scene from further cameras, one after another, on the model's device; the views come to the CPU.

    Args:
        model: the network.
        inputs: as many views as the network sees at once.
        camera: batch shape `[N]`.
        workspace: where the scene is.
    """
    device = next(model.parameters()).device
    inputs, box = inputs.to(device), workspace.to(device)
    seen = inputs.camera
    views = Camera(seen.intrinsics[None], seen.T_world_camera[None], seen.width, seen.height)
    with torch.no_grad():
        features = model.observe(inputs.images[None], views, box)
    for each in (camera[view].to("cpu") for view in range(len(camera))):
        rgb, distance, inside = (part.cpu() for part in render_image(model, features, each.to(device), box))
        yield RenderedView(each, rgb, depth_along_axis(each, distance), inside)


def panels(view: RenderedView, limits: tuple[float, float] | None = None) -> dict[str, Panel]:
    """Returns what there is to show of a view: `truth`, `rendered`, `error`, `true depth`, `depth`, in this order.

    Args:
        view: without the truth, there is no error; without the true depth, it is left out.
        limits: the depths that are brightest and darkest, metres; the view's own if None.
    """
    limits = depth_limits([view]) if limits is None else limits
    images: dict[str, Tensor] = {}
    if view.truth is not None:
        images["truth"] = view.truth
    images["rendered"] = grey_outside(view.rgb, view.inside)
    if view.truth is not None:
        images["error"] = colour_error(view.rgb, view.truth, view.inside)
    if view.true_depth is not None:
        images["true depth"] = colour_depth(view.true_depth, view.inside, limits)
    images["depth"] = colour_depth(view.depth, view.inside, limits)
    return {name: Panel(name, image, view.camera) for name, image in images.items()}


def depth_limits(views: Sequence[RenderedView]) -> tuple[float, float]:
    """Returns near and far, metres, of what views show inside of the box, outliers cut; of the truth where known."""
    depths = [view.depth if view.true_depth is None else view.true_depth for view in views]
    shown = torch.cat([depth[view.inside] for depth, view in zip(depths, views, strict=True)])
    shown = shown[shown.isfinite()]
    if not len(shown):
        return 0.0, 1.0
    near, far = torch.quantile(shown, torch.tensor([0.01, 0.99], device=shown.device)).tolist()
    return near, far


def colour_depth(depth: Tensor, inside: Tensor, limits: tuple[float, float]) -> Tensor:
    """Returns depth `[H, W]` as RGB `[H, W, 3]` in [0, 1]: bright is near, grey where not `inside` `[H, W]`."""
    near, far = limits
    return grey_outside(paint((far - depth) / max(far - near, 1e-6)), inside.cpu())


def colour_error(rgb: Tensor, truth: Tensor, inside: Tensor) -> Tensor:
    """Returns how far colours `[H, W, 3]` are off as RGB `[H, W, 3]`: black is right, grey where not `inside`."""
    return grey_outside(paint((rgb - truth).abs().mean(dim=-1) / WORST), inside.cpu())


def grey_outside(rgb: Tensor, inside: Tensor) -> Tensor:
    """Returns RGB `[H, W, 3]`, grey where not `inside` `[H, W]`."""
    return torch.where(inside[..., None], rgb, torch.full_like(rgb, OUTSIDE))


def paint(share: Tensor, colours: str = "magma") -> Tensor:
    """Returns RGB `[H, W, 3]` of shares `[H, W]` in one of matplotlib's colormaps: 0 is dark, 1 is bright."""
    from matplotlib import colormaps

    return torch.from_numpy(colormaps[colours](share.clamp(0.0, 1.0).cpu().numpy())[..., :3]).float()
