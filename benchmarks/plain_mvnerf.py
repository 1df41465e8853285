"""MVNeRF written out plainly, on the weights of a fast one: what the fast path must agree with, and be compared to.

The same mathematics with nothing rearranged: every point's inputs are put side by side and go through one linear layer,
and image features are sampled as the encoder gives them. Eager, in the precision of the weights.
"""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, linear, relu, softplus

from nerfgrasp.geometry import Camera, invert, project, transform
from nerfgrasp.models import Field, MVNeRF
from nerfgrasp.models.field import encode
from nerfgrasp.models.mvnerf import RayRenderings
from nerfgrasp.models.rendering import importance, render_rays, stratified
from nerfgrasp.scenes.scene import Workspace


def render(
    model: MVNeRF,
    images: Tensor,
    camera: Camera,
    origins: Tensor,
    directions: Tensor,
    workspace: Workspace,
    generator: torch.Generator | None = None,
) -> RayRenderings:
    """Does what `model.observe` and `model.render` do; shapes as there."""
    features = model.encoder(images.flatten(0, 1)).unflatten(0, images.shape[:2])
    table = workspace.minimum[..., 2].flatten().expand(len(images))
    near, far = model._range(origins, directions, workspace)
    distances = stratified(near, far, model.config.coarse_samples, generator)
    coarse = render_rays(
        lambda x, q: evaluate(model.coarse, features, images, camera, table, x, q), origins, directions, distances
    )
    drawn = importance(coarse, model.config.fine_samples, generator)
    if model.config.reuse_coarse_samples:
        drawn = torch.cat([drawn, distances], dim=-1)
    closer = drawn.sort(dim=-1).values
    fine = render_rays(
        lambda x, q: evaluate(model.fine, features, images, camera, table, x, q), origins, directions, closer
    )
    return RayRenderings(coarse, fine)


def evaluate(
    field: Field, features: Tensor, images: Tensor, camera: Camera, table: Tensor, points: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns RGB `[B, R, S, 3]` and density `[B, R, S]` of points seen along directions; arguments as below."""
    x, colours = _view_activations(field, features, images, camera, table, points, directions)
    h = _fused(field, x)[-1]
    raw = field.readout(relu(h))
    colour = raw[..., :3].sigmoid()
    if field.blend is not None:
        gate = raw[..., 4:].sigmoid()
        colour = (1 - gate) * colour + gate * (field.blend(x, h) * colours).sum(dim=1)
    return colour, 100.0 * softplus(raw[..., 3] - 2.0)


def activations(
    field: Field, features: Tensor, images: Tensor, camera: Camera, table: Tensor, points: Tensor, directions: Tensor
) -> list[Tensor]:
    """Returns the scene activations, each `[B, R, S, width]`, of points `[B, R, S, 3]` seen along `[B, R, 3]`.

    Args:
        field: whose weights are used.
        features: the encoder's, `[B, V, C, h, w]`.
        images: `[B, V, 3, H, W]`.
        camera: batch shape `[B, V]`.
        table: heights `[B]` in metres.
        points: metres, world frame.
        directions: unit.
    """
    return _fused(field, _view_activations(field, features, images, camera, table, points, directions)[0])


def _view_activations(
    field: Field, features: Tensor, images: Tensor, camera: Camera, table: Tensor, points: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """Each view's activations `[B, V, R, S, width]`, and the colours that it sees."""
    height = points[..., 2:] - table[:, None, None, None]
    each = [
        _first_layer(field, features[:, v], images[:, v], camera[:, v], height, points, directions)
        for v in range(images.shape[1])
    ]
    x = torch.stack([row for row, _ in each], dim=1)
    for block in field.view_trunk:
        x = block(x)
    return x, torch.stack([colour for _, colour in each], dim=1)


def _fused(field: Field, x: Tensor) -> list[Tensor]:
    pooled = [x.mean(dim=1)]
    if field.config.pool_variance:
        pooled.append(x.var(dim=1, correction=0))
    outputs = [field.pool_layer(torch.cat(pooled, dim=-1))]
    for block in field.fused_trunk:
        outputs.append(block(outputs[-1]))
    return outputs


def _first_layer(
    field: Field,
    features: Tensor,
    images: Tensor,
    camera: Camera,
    height: Tensor,
    points: Tensor,
    directions: Tensor,
) -> tuple[Tensor, Tensor]:
    """One view's first activations `[B, R, S, width]`, and the colours `[B, R, S, 3]` that it sees."""
    batch, rays, samples, _ = points.shape
    flat = points.flatten(1, 2)
    T_camera_world = invert(camera.T_world_camera)
    pixels, _ = project(camera, flat)
    size = torch.tensor([camera.width, camera.height], device=points.device)
    grid = (2.0 * pixels / size - 1.0).clamp(-2.0, 2.0)[:, None].to(images)
    sampled = [
        grid_sample(maps, grid, padding_mode="border", align_corners=False)[:, :, 0].transpose(1, 2)
        for maps in (images, features.to(images))
    ]
    turned = (directions @ T_camera_world[..., :3, :3].transpose(-1, -2)).repeat_interleave(samples, dim=1)
    inputs = [
        encode(transform(T_camera_world, flat), field.config.position_frequencies),
        sampled[0],
        encode(turned, field.config.direction_frequencies),
        sampled[1],
    ]
    layers = [field.point_layer.weight, field.direction_layer.weight, field.feature_layer.weight.flatten(1)]
    if field.height_layer is not None:
        inputs.append(encode(height.flatten(1, 2), field.config.height_frequencies))
        layers.append(field.height_layer.weight)
    first = linear(torch.cat(inputs, dim=-1), torch.cat(layers, dim=1), field.point_layer.bias)
    return first.view(batch, rays, samples, -1), sampled[0].view(batch, rays, samples, 3)
