"""Volume rendering: C = Σᵢ wᵢ cᵢ, wᵢ = Tᵢ (1 − exp(−σᵢ δᵢ)), Tᵢ = exp(−Σⱼ₍ⱼ<ᵢ₎ σⱼ δⱼ).

The field is a callable; nothing here knows a network. Source: Mildenhall et al. 2020, section 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nerfgrasp.geometry import Camera, box_intersection, pixel_centres, pixel_rays
from nerfgrasp.scenes.scene import Workspace

if TYPE_CHECKING:
    from nerfgrasp.models.mvnerf import MVNeRF, SceneFeatures

RadianceField = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""(points `[B, R, S, 3]`, directions `[B, R, 3]`) to (RGB `[B, R, S, 3]`, density `[B, R, S]` in 1/m)."""


@dataclass(frozen=True)
class Rendering:
    """Rendered rays."""

    colour: Tensor
    """`[B, R, 3]`, RGB in [0, 1]."""
    depth: Tensor
    """`[B, R]`: expected distance along the ray, metres."""
    weights: Tensor
    """`[B, R, S]`: each sample's share in the colour."""
    distances: Tensor
    """`[B, R, S]`: the samples' distances along the ray, metres, ascending."""


def composite(colour: Tensor, density: Tensor, distances: Tensor) -> Rendering:
    """Composites samples along rays; what passes all samples is given to the last one.

    Args:
        colour: `[B, R, S, 3]`.
        density: `[B, R, S]` in 1/m.
        distances: `[B, R, S]` in metres, ascending.
    """
    steps = distances[..., 1:] - distances[..., :-1]
    optical = torch.cat([density[..., :-1] * steps, torch.full_like(density[..., :1], 1e10)], dim=-1)
    passed = torch.cumsum(optical[..., :-1], dim=-1)
    transmittance = torch.exp(-torch.cat([torch.zeros_like(passed[..., :1]), passed], dim=-1))
    weights = transmittance * -torch.expm1(-optical)
    return Rendering((weights[..., None] * colour).sum(dim=-2), (weights * distances).sum(dim=-1), weights, distances)


def stratified(near: Tensor, far: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
    """Returns `[..., count]` distances between `near` and `far` `[...]`, one in each of `count` equal intervals.

    Random in its interval with a generator, the interval's middle without.
    """
    shape = (*near.shape, count)
    offset = torch.full(shape, 0.5) if generator is None else torch.rand(shape, generator=generator)
    share = (torch.arange(count) + offset) / count
    return near[..., None] + (far - near)[..., None] * share.to(near)


def importance(rendering: Rendering, count: int, generator: torch.Generator | None = None) -> Tensor:
    """Draws `[..., count]` distances where a coarse rendering has its weights (inverse of their distribution).

    Args:
        rendering: the coarse rendering; no gradient flows through it.
        count: samples a ray.
        generator: for random draws; evenly spaced quantiles without.
    """
    distances = rendering.distances.detach()
    middles = 0.5 * (distances[..., 1:] + distances[..., :-1])
    weights = rendering.weights.detach()[..., 1:-1] + 1e-3
    cumulative = torch.cumsum(weights / weights.sum(dim=-1, keepdim=True), dim=-1)
    cumulative = torch.cat([torch.zeros_like(cumulative[..., :1]), cumulative], dim=-1)
    zero = torch.zeros_like(distances[..., 0])
    quantiles = stratified(zero, zero + 1.0, count, generator)
    upper = torch.searchsorted(cumulative, quantiles, right=True).clamp(1, cumulative.shape[-1] - 1)
    low, high = cumulative.gather(-1, upper - 1), cumulative.gather(-1, upper)
    share = (quantiles - low) / (high - low).clamp(min=1e-6)
    start, end = middles.gather(-1, upper - 1), middles.gather(-1, upper)
    return start + share.clamp(0.0, 1.0) * (end - start)


def render_rays(field: RadianceField, origins: Tensor, directions: Tensor, distances: Tensor) -> Rendering:
    """Evaluates a field at `distances` `[B, R, S]` along rays `[B, R, 3]` and composites."""
    points = origins[..., None, :] + directions[..., None, :] * distances[..., None]
    colour, density = field(points, directions)
    return composite(colour, density, distances)


@torch.no_grad()
def render_image(
    model: MVNeRF, features: SceneFeatures, camera: Camera, workspace: Workspace, chunk: int = 512
) -> tuple[Tensor, Tensor, Tensor]:
    """Renders one camera's image of one scene.

    Args:
        model: the network.
        features: of one scene (B = 1).
        camera: batch shape `[]`.
        workspace: where the scene is.
        chunk: rays at a time; few enough for a processor's cache, which is faster than many.

    Returns:
        RGB `[H, W, 3]` in [0, 1], depth `[H, W]` along the rays in metres, and a bool mask `[H, W]` of the rays
        that meet the model's box about the workspace; elsewhere RGB and depth are zero.
    """
    pixels = pixel_centres(camera.width, camera.height).to(camera.intrinsics).flatten(0, 1)
    origins, directions = pixel_rays(camera, pixels)
    minimum, maximum = model.bounds(workspace.minimum, workspace.maximum)
    near, far = box_intersection(origins, directions, minimum, maximum)
    inside = far > near
    colour = origins.new_zeros(len(pixels), 3)
    depth = origins.new_zeros(len(pixels))
    for chosen in inside.nonzero()[:, 0].split(chunk) if inside.any() else ():
        fine = model.render(features, origins[None, chosen], directions[None, chosen], workspace).fine
        colour[chosen], depth[chosen] = fine.colour[0], fine.depth[0]
    size = (camera.height, camera.width)
    return colour.view(*size, 3), depth.view(size), inside.view(size)
