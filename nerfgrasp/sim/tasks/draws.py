"""What every task draws from: the generators of a scene, the workspace, and prisms in any size and colour."""

import colorsys
import math

import numpy as np
import roma
import torch
from numpy.random import Generator
from torch.nn.functional import normalize

from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.sim.shapes import RANDOM_FOOTPRINTS

WORKSPACE_MARGIN = 0.02
"""Metres between any object and the workspace's border."""

workspace = Workspace()


def scene_generator(seed: int, index: int, stream: int) -> Generator:
    """Returns the random generator of one scene's `stream` of draws; streams are independent of each other."""
    return np.random.default_rng(np.random.SeedSequence((seed, index, stream)))


def random_prism(rng: Generator, max_height: float = 0.12) -> Prism:
    """Returns a prism of a random kind, size, density and saturated colour, upright at the origin.

    It is 25 mm to `max_height` metres high.
    """
    kind = str(rng.choice(list(RANDOM_FOOTPRINTS)))
    parts = RANDOM_FOOTPRINTS[kind](rng)
    height, density, colour = rng.uniform(0.025, max_height), rng.uniform(200.0, 600.0), _saturated_colour(rng)
    return Prism(kind, parts, float(height), colour, float(density), torch.eye(4))


def upright_pose(rng: Generator, reach: float) -> torch.Tensor:
    """Returns `T_world_object` `[4, 4]` on the table: x and y within ±`reach` metres, any yaw."""
    x, y = rng.uniform(-reach, reach, 2)
    yaw = rng.uniform(-math.pi, math.pi)
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    pose[:2, 3] = x, y
    return torch.from_numpy(pose).float()


def random_rotation(rng: Generator) -> torch.Tensor:
    """Returns a rotation `[3, 3]`, uniform over all."""
    return roma.unitquat_to_rotmat(normalize(torch.from_numpy(rng.normal(size=4)), dim=0)).float()


def _saturated_colour(rng: Generator) -> tuple[float, float, float]:
    hue, saturation, value = rng.uniform(0.0, 1.0), rng.uniform(0.75, 1.0), rng.uniform(0.6, 1.0)
    return colorsys.hsv_to_rgb(float(hue), float(saturation), float(value))
