"""Height maps: what several RGB-D cameras see, looked at straight from above.

A map is `[4, H, W]`: RGB in [0, 1], then metres above the workspace's lower face. Row i and column j lie at
y = minimum_y + (i + ½) pixel and x = minimum_x + (j + ½) pixel. Where no camera sees a point, all four are 0: black, at
the table's height.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from nerfgrasp.geometry import Camera, pixel_centres, transform
from nerfgrasp.scenes.scene import Workspace

BELOW = 0.01
"""Metres below the table at which a point still counts, as one on it."""
BLEND = 0.003
"""Metres: a cell's colour is the mean of its points no deeper than this below the highest."""
MOST_PARTS = 8
"""A pixel is divided into at most so many parts a side."""


def height_map(images: Tensor, depth: Tensor, camera: Camera, workspace: Workspace, pixel: float) -> Tensor:
    """Fuses views into one map, heights by their maximum.

    Args:
        images: `[V, 3, h, w]`, RGB in [0, 1].
        depth: `[V, h, w]`, metres along the optical axis; not finite where there is none.
        camera: batch shape `[V]`.
        workspace: what the map shows; points outside, but for those just below the table, are left out.
        pixel: side of a cell in metres.

    Returns:
        `[4, H, W]`: see above.
    """
    parts = _parts(camera, workspace, pixel)
    points, seen = subpixel_points(depth, camera, parts)
    colours = images.movedim(1, -1).repeat_interleave(parts, 1).repeat_interleave(parts, 2)
    return splat(points[seen], colours[seen], workspace, pixel)


def map_shape(workspace: Workspace, pixel: float) -> tuple[int, int]:
    """Returns the rows and columns of a workspace's map."""
    width, depth = ((workspace.maximum - workspace.minimum)[:2] / pixel).round().int().tolist()
    return depth, width


def within(points: Tensor, workspace: Workspace, margin: float) -> Tensor:
    """Returns a bool `[...]`: whether points `[..., 2]` lie on the map, `margin` metres from its edges or more."""
    low, high = workspace.minimum[:2] + margin, workspace.maximum[:2] - margin
    return ((points >= low) & (points <= high)).all(dim=-1)


def splat(points: Tensor, colours: Tensor, workspace: Workspace, pixel: float) -> Tensor:
    """Returns the map `[4, H, W]` of points `[N, 3]` with colours `[N, 3]`."""
    rows, columns = map_shape(workspace, pixel)
    cell = ((points[:, :2] - workspace.minimum[:2]) / pixel).floor().long()
    height = points[:, 2] - workspace.minimum[2]
    inside = (cell >= 0).all(-1) & (cell[:, 0] < columns) & (cell[:, 1] < rows)
    inside &= (height > -BELOW) & (points[:, 2] <= workspace.maximum[2])
    index, height = (cell[:, 1] * columns + cell[:, 0])[inside], height[inside].clamp(min=0.0)
    highest = height.new_zeros(rows * columns).scatter_reduce(0, index, height, "amax")
    top = height >= highest[index] - BLEND
    index, colour = index[top], colours[inside][top]
    count = colour.new_zeros(rows * columns).index_add(0, index, torch.ones_like(index).to(colour))
    total = colour.new_zeros(rows * columns, 3).index_add(0, index, colour)
    mean = total / count.clamp(min=1.0)[:, None]
    return torch.cat([mean, highest[:, None]], dim=1).T.reshape(4, rows, columns)


def subpixel_points(depth: Tensor, camera: Camera, parts: int) -> tuple[Tensor, Tensor]:
    """Divides every pixel into `parts` × `parts` and returns the world points that they see.

    Within a pixel 1 / depth is taken as linear, which it is on a plane; its slope is the smaller of those to the
    neighbours on either side, so that a surface is not stretched to the one behind it.

    Args:
        depth: `[V, h, w]`, metres along the optical axis.
        camera: batch shape `[V]`.
        parts: 1 leaves the pixels whole.

    Returns:
        Points `[V, h·parts, w·parts, 3]`, and a bool `[V, h·parts, w·parts]`: whether there is one.
    """
    near = torch.where(depth.isfinite() & (depth > 0), 1 / depth, 0.0)
    offset = (torch.arange(parts).to(depth) + 0.5) / parts - 0.5
    down, right = offset.repeat(depth.shape[1])[:, None], offset.repeat(depth.shape[2])

    def spread(values: Tensor) -> Tensor:
        return values.repeat_interleave(parts, 1).repeat_interleave(parts, 2)

    inverse = spread(near) + spread(_slope(near, 1)) * down + spread(_slope(near, 2)) * right
    seen = (spread(near) > 0) & (inverse > 0)
    metres = 1 / torch.where(seen, inverse, 1.0)
    pixels = pixel_centres(camera.width * parts, camera.height * parts).to(depth) / parts
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1).flatten(0, 1)
    rays = homogeneous @ torch.linalg.inv(camera.intrinsics).transpose(-1, -2)
    points = transform(camera.T_world_camera, rays * metres.flatten(1)[..., None])
    return points.unflatten(1, seen.shape[1:]), seen


def _slope(values: Tensor, dim: int) -> Tensor:
    """Returns the change a pixel along `dim`: the smaller of both sides', 0 where they differ in sign."""
    step = values.diff(dim=dim)
    edge = (1, 0) if dim == values.dim() - 1 else (0, 0, 1, 0)
    before, after = pad(step, edge), pad(step, [*edge[:-2], *edge[-2:][::-1]])
    smaller = torch.where(before.abs() < after.abs(), before, after)
    return torch.where(before * after > 0, smaller, 0.0)


def _parts(camera: Camera, workspace: Workspace, pixel: float) -> int:
    """Returns into how many parts a side pixels are to be divided so that no cell between them stays empty."""
    middle = (workspace.minimum + workspace.maximum) / 2
    distance = (camera.T_world_camera[:, :3, 3] - middle).norm(dim=-1)
    footprint = float((distance / camera.intrinsics[:, 0, 0]).max())
    # Half a cell: seen at a slant a pixel covers more of the table.
    return min(MOST_PARTS, max(1, math.ceil(2 * footprint / pixel)))
