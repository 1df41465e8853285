"""The clutter task: five prisms in a pile or in a huddle, in whatever poses they came to rest in."""

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.prisms import Prism, corners_in_world
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.settling import huddle, pile, stable
from nerfgrasp.sim.tasks.draws import (
    WORKSPACE_MARGIN,
    random_prism,
    random_rotation,
    scene_generator,
    upright_pose,
    workspace,
)

OBJECTS = 5
MAX_HEIGHT = 0.07
"""Metres. A prism that fell over is grasped across its height, so that has to fit between the fingers as well: of
those up to 120 mm high, one in five lay where no grasp from above could hold it."""
PILE_REACH = 0.05
"""Metres from the workspace's centre along x and y within which objects are dropped on a pile."""
HUDDLE_RADIUS = 0.16
"""Metres from the workspace's centre at which objects lie before they are pushed towards it."""
UPRIGHT = 0.5
"""The share of a huddle's objects that stand upright before they are pushed."""
_LAYOUT_STREAM = 0


def clutter_scene(seed: int, index: int) -> Truth:
    """Returns one scene of the clutter task: five prisms at rest after being piled up or pushed together.

    Which of the two, and all else, is drawn from the scene's own generator; a scene of which something lies outside
    of the workspace or within its margin, or does not stay where it is, is drawn again.
    """
    rng = scene_generator(seed, index, _LAYOUT_STREAM)
    arrange = _pile if rng.random() < 0.5 else _huddle
    while True:
        objects = arrange(rng)
        if all(_inside(prism) for prism in objects) and stable(objects):
            return Truth("clutter", seed, index, objects)


def _pile(rng: Generator) -> tuple[Prism, ...]:
    places = rng.uniform(-PILE_REACH, PILE_REACH, (OBJECTS, 2))
    return pile(tuple(_placed(random_prism(rng, MAX_HEIGHT), random_rotation(rng), place) for place in places))


def _huddle(rng: Generator) -> tuple[Prism, ...]:
    angles = rng.uniform(-math.pi, math.pi) + 2 * math.pi * np.arange(OBJECTS) / OBJECTS
    places = HUDDLE_RADIUS * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    turns = [_yaw(rng) if rng.random() < UPRIGHT else random_rotation(rng) for _ in range(OBJECTS)]
    return huddle(
        tuple(_placed(random_prism(rng, MAX_HEIGHT), turn, place) for turn, place in zip(turns, places, strict=True))
    )


def _yaw(rng: Generator) -> Tensor:
    return upright_pose(rng, 0.0)[:3, :3]


def _placed(prism: Prism, rotation: Tensor, place: NDArray[np.float64]) -> Prism:
    """Returns the prism turned and moved to `place` (x, y), its lowest corner on the table."""
    turned = replace(prism, T_world_object=make_pose(rotation, torch.zeros(3)))
    position = torch.tensor([*place.tolist(), -corners_in_world(turned)[:, 2].min()], dtype=torch.float32)
    return replace(prism, T_world_object=make_pose(rotation, position))


def _inside(prism: Prism) -> bool:
    corners = corners_in_world(prism)
    limit = workspace.maximum.double().numpy()
    return bool((np.abs(corners[:, :2]) <= limit[:2] - WORKSPACE_MARGIN).all() and (corners[:, 2] <= limit[2]).all())
