"""Where a search starts: in proportion to the opacity of the model's own density."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.models.mvnerf import SceneFeatures
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.candidates import random_candidates

_TABLE = 0.006
"""Metres above the table below which density may be the table's own."""
_DEPTH = 0.01
"""Metres over which a cell's density counts as its opacity."""
_COLUMNS = 256
"""Columns of the grid that are asked at once."""


@dataclass(frozen=True)
class Occupancy:
    """Where a model sees something: a grid over a workspace, asked once for any number of searches."""

    points: Tensor
    """`[N, 3]`: the cells' centres in the world, metres."""
    cell: Tensor
    """`[3]`: the cells' sides, metres."""
    chance: Tensor
    """`[N]`: the cells' opacities in [0, 1]; 0 where density may be the table's own."""


def occupancy(model: GraspValue, features: SceneFeatures, workspace: Workspace, spacing: float) -> Occupancy:
    """Asks a model's density on a grid.

    A grasp encloses its object: of positions drawn uniformly in a workspace, nearly all are in the air. One question
    a cell of a grid costs far less than the value of a pose, which asks at 42 points.

    Args:
        model: whose backbone knows the density.
        features: of the scene, from `model.observe`.
        workspace: the box; its lower face is the table.
        spacing: of the grid's points, metres.
    """
    points, cell = grid(workspace, spacing)
    chance = opacity(model, features, points).flatten()
    chance = torch.where(points[..., 2].flatten() < workspace.minimum[2] + _TABLE, 0.0, chance).nan_to_num()
    return Occupancy(points.flatten(0, 1), cell, chance)


def occupied_candidates(
    count: int, workspace: Workspace, generator: torch.Generator, max_tilt: float, *, occupied: Occupancy
) -> Tensor:
    """Draws grasp poses whose positions lie where the model sees something.

    Args:
        count: how many, N.
        workspace: the box of the positions.
        generator: the only source of randomness.
        max_tilt: see `random_candidates`.
        occupied: where something is in it.

    Returns:
        `T_world_grasp` `[N, 4, 4]`: uniform orientations; positions uniform in cells that are drawn by their opacity.
    """
    points = occupied.points
    poses = random_candidates(count, workspace, generator, max_tilt)
    if not bool((occupied.chance > 0).any()):
        return poses
    chosen = torch.multinomial(occupied.chance.to(generator.device), count, replacement=True, generator=generator)
    within = torch.rand(count, 3, generator=generator, device=generator.device).to(points) - 0.5
    poses[:, :3, 3] = points[chosen.to(points.device)] + within * occupied.cell
    return poses


def grid(workspace: Workspace, spacing: float) -> tuple[Tensor, Tensor]:
    """Returns the centres `[C, Z, 3]` of a workspace's cells, column by column, and the cells' sides `[3]` in metres.

    The sides are `spacing` but for a rounding that makes the cells fill the workspace.
    """
    size = workspace.maximum - workspace.minimum
    counts = (size / spacing).round().clamp(min=1)
    cell = size / counts
    axes = [
        workspace.minimum[axis] + cell[axis] * (torch.arange(int(count), device=cell.device) + 0.5)
        for axis, count in enumerate(counts.tolist())
    ]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).flatten(0, 1), cell


@torch.no_grad()
def opacity(model: GraspValue, features: SceneFeatures, points: Tensor) -> Tensor:
    """Returns the opacity `[C, Z]`, in [0, 1], of a centimetre at points `[C, Z, 3]`, looked at from above."""
    down = torch.tensor([0.0, 0.0, -1.0], device=points.device)
    density = [model.density(features, part, down.expand(len(part), 3)) for part in points.split(_COLUMNS)]
    return -torch.expm1(-_DEPTH * torch.cat(density))
