"""Points on the surfaces of a scene's objects, and where among them an open gripper finds room."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from nerfgrasp.grippers import Gripper
from nerfgrasp.scenes.objects import SceneObject
from nerfgrasp.scenes.prisms import Prism, mass_properties
from nerfgrasp.sim.catalogue import model_of
from nerfgrasp.sim.decomposition import read_objects
from nerfgrasp.sim.physics import PHYSICS

POINTS = 800
"""Drawn on each object, before those within it are dropped."""
INSIDE = 1e-4
"""Metres; points this near to another piece of their object are not on its surface."""
MARGIN = 0.001
"""Metres to keep free around the gripper."""


@dataclass(frozen=True)
class Surface:
    """Points of objects as the physics knows them: unions of convex pieces."""

    points: Tensor
    """`[P, 3]`, metres in the world."""
    normals: Tensor
    """`[P, 3]`, unit, outwards."""
    object: Tensor
    """`[P]`, long: whose point it is."""


def sample_surface(objects: Sequence[SceneObject], generator: torch.Generator) -> Surface:
    """Draws points evenly on the surfaces of objects.

    Args:
        objects: prisms or meshes, whose models must be at hand.
        generator: the only source of randomness.

    Raises:
        UserError: a mesh object's model is not at hand.
    """
    drawn = []
    for number, thing in enumerate(objects):
        points, normals = _sample(_pieces(thing), int(torch.randint(2**31, (), generator=generator)))
        T = thing.T_world_object.double()
        moved = torch.from_numpy(points) @ T[:3, :3].T + T[:3, 3]
        drawn.append((moved, torch.from_numpy(normals) @ T[:3, :3].T, torch.full((len(points),), number)))
    return Surface(*(torch.cat(parts) for parts in zip(*drawn, strict=True)))


def centres_of_mass(objects: Sequence[SceneObject]) -> Tensor:
    """Returns the objects' centres of mass `[N, 3]` in the world."""
    centres = [mass_properties(o).centre if isinstance(o, Prism) else np.asarray(o.centre) for o in objects]
    poses = [thing.T_world_object.double() for thing in objects]
    return torch.stack([T[:3, :3] @ torch.from_numpy(c) + T[:3, 3] for T, c in zip(poses, centres, strict=True)])


def has_room(T_world_grasp: Tensor, surface: Surface, gripper: Gripper) -> Tensor:
    """Returns a bool `[N]`: whether the open gripper touches nothing at grasps `[N, 4, 4]` nor on its way there."""
    centre, half = torch.tensor(gripper.open_boxes(), dtype=surface.points.dtype).unbind(1)
    low, high = centre - half - MARGIN, centre + half + MARGIN
    low[:, 2] -= PHYSICS.approach_distance
    return torch.cat([_no_point_within(part, surface.points, low, high) for part in T_world_grasp.split(128)])


def _no_point_within(T: Tensor, points: Tensor, low: Tensor, high: Tensor) -> Tensor:
    local = (points - T[:, None, :3, 3]) @ T[:, :3, :3]
    within = [((local > a) & (local < b)).all(dim=-1).any(dim=-1) for a, b in zip(low, high, strict=True)]
    return ~torch.stack(within).any(dim=0)


def _pieces(thing: SceneObject) -> list[trimesh.Trimesh]:
    """Returns the convex pieces of an object in its own frame."""
    if isinstance(thing, Prism):
        floors = (0.0, thing.height)
        solids = [np.array([[*corner, z] for z in floors for corner in part]) for part in thing.parts]
        return [trimesh.convex.convex_hull(solid) for solid in solids]
    return _hulls(model_of(thing).hulls)


@lru_cache(maxsize=64)
def _hulls(path: Path) -> list[trimesh.Trimesh]:
    return [piece.convex_hull for piece in read_objects(path)]


def _sample(pieces: Sequence[trimesh.Trimesh], seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns points `[P, 3]` on the surface of a union of convex pieces, and their normals `[P, 3]`."""
    whole = trimesh.util.concatenate(list(pieces))
    points, faces = trimesh.sample.sample_surface(whole, POINTS, seed=seed)
    owner = np.repeat(np.arange(len(pieces)), [len(piece.faces) for piece in pieces])[faces]
    outside = np.ones(len(points), dtype=bool)
    for number, piece in enumerate(pieces):
        level = (piece.face_normals * piece.triangles[:, 0]).sum(axis=1)
        outside &= (owner == number) | ((points @ piece.face_normals.T - level).max(axis=1) > INSIDE)
    normals = np.concatenate([piece.face_normals for piece in pieces])
    return np.asarray(points)[outside], normals[faces][outside]
