"""Canvases: square cuttings of a height map, each turned by another angle, and the grasps that their cells stand for.

A canvas is a frame in the plane of the table: `T_world_canvas` `[3, 3]` maps (x, y, 1) in metres, the origin in its
middle. A cell stands for the top-down grasp with its tool centre point there, closing along the canvas's x axis. K
canvases a half turn / K apart make all grasps of a symmetric gripper.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from nerfgrasp.geometry import exact, make_pose
from nerfgrasp.scenes.scene import Workspace


def planar_pose(angle: Tensor, position: Tensor) -> Tensor:
    """Returns `[..., 3, 3]` from an angle `[...]` in radians and a position `[..., 2]` in metres."""
    cos, sin = torch.broadcast_tensors(angle.cos(), angle.sin())
    x, y = position.expand(*cos.shape, 2).unbind(-1)
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    return torch.stack([cos, -sin, x, sin, cos, y, zero, zero, one], dim=-1).unflatten(-1, (3, 3))


def upright(workspace: Workspace) -> Tensor:
    """Returns the canvas `[3, 3]` over a workspace's middle, its axes the world's."""
    middle = (workspace.minimum + workspace.maximum)[:2] / 2
    return planar_pose(torch.zeros_like(middle[0]), middle)


@exact
def turned(T_world_canvas: Tensor, count: int) -> Tensor:
    """Returns `[..., K, 3, 3]`: canvases `[..., 3, 3]` turned about their middles by k π / K."""
    angle = torch.arange(count).to(T_world_canvas) * (math.pi / count)
    return T_world_canvas[..., None, :, :] @ planar_pose(angle, angle.new_zeros(2))


def canvas_side(shape: tuple[int, int], multiple: int) -> int:
    """Returns the side in cells: a map's diagonal, rounded to the nearest multiple; turned, it loses no more than tips.

    Example:
        >>> canvas_side((160, 160), 16)
        224
    """
    return multiple * max(1, round(math.hypot(*shape) / multiple))


def cell_centres(side: int, pixel: float) -> Tensor:
    """Returns the cells' centres `[side, side, 2]` (x, y) in a canvas's frame; rows go along y."""
    along = (torch.arange(side) + 0.5 - side / 2) * pixel
    return torch.stack(torch.meshgrid(along, along, indexing="xy"), dim=-1)


@exact
def cut(maps: Tensor, workspace: Workspace, T_world_canvas: Tensor, side: int, pixel: float) -> tuple[Tensor, Tensor]:
    """Resamples a map into canvases, bilinearly.

    Args:
        maps: `[4, H, W]`.
        workspace: what it shows.
        T_world_canvas: `[K, 3, 3]`.
        side: of a canvas in cells.
        pixel: side of a cell in metres.

    Returns:
        Canvases `[K, 4, side, side]`, 0 outside of the map, and a bool `[K, side, side]`: which cells lie within.
    """
    local = cell_centres(side, pixel).to(maps).flatten(0, 1)
    points = local @ T_world_canvas[:, :2, :2].transpose(-1, -2) + T_world_canvas[:, None, :2, 2]
    low, high = workspace.minimum[:2], workspace.maximum[:2]
    grid = (2 * (points - low) / (high - low) - 1).unflatten(1, (side, side))
    many = maps.expand(len(grid), *maps.shape)
    return grid_sample(many, grid, align_corners=False), (grid.abs() <= 1).all(dim=-1)


@exact
def grasp_cell(T_world_grasp: Tensor, T_world_canvas: Tensor, side: int, pixel: float) -> Tensor:
    """Returns the cell `[3]` (canvas, row, column), long, that stands for a grasp.

    Args:
        T_world_grasp: `[4, 4]`; only its position and its closing axis, both seen from above, count.
        T_world_canvas: `[K, 3, 3]`. The canvas whose x axis is nearest to the closing axis, either way, is taken.
        side: of a canvas in cells. A point beyond the canvas is given to the nearest cell.
        pixel: side of a cell in metres.
    """
    axes = T_world_canvas[:, :2, 0]
    closest = (axes @ T_world_grasp[:2, 0].to(axes)).abs().argmax()
    canvas = T_world_canvas[closest]
    local = (T_world_grasp[:2, 3].to(canvas) - canvas[:2, 2]) @ canvas[:2, :2]
    column, row = (local / pixel + side / 2).floor().long().clamp(0, side - 1).unbind()
    return torch.stack([closest, row, column])


@exact
def cell_grasps(cells: Tensor, T_world_canvas: Tensor, side: int, pixel: float) -> Tensor:
    """Returns the grasps `[N, 4, 4]` on the table, z = 0, that cells `[N, 3]` (canvas, row, column) stand for."""
    canvas = T_world_canvas[cells[:, 0]]
    local = cell_centres(side, pixel).to(canvas)[cells[:, 1], cells[:, 2]]
    position = (canvas[:, :2, :2] @ local[:, :, None])[..., 0] + canvas[:, :2, 2]
    x = torch.cat([canvas[:, :2, 0], torch.zeros_like(position[:, :1])], dim=-1)
    z = torch.tensor([0.0, 0.0, -1.0]).to(x).expand_as(x)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)
    return make_pose(rotation, torch.cat([position, torch.zeros_like(position[:, :1])], dim=-1))
