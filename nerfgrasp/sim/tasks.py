"""The tasks' scenes: which objects stand where, and from where cameras look at them.

Everything here is a pure function of (seed, index): no physics, no global random state.
"""

import colorsys
import math

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray

from nerfgrasp.geometry import Camera, look_at
from nerfgrasp.scenes.prisms import Prism, clear_gap, footprint_in_world
from nerfgrasp.scenes.scene import Truth, Workspace
from nerfgrasp.sim.shapes import RANDOM_FOOTPRINTS

MAX_OBJECTS = 5
CLEAR_GAP = 0.06
"""Metres between any two footprints, so that the open fingers reach every side of every object."""
WORKSPACE_MARGIN = 0.02
"""Metres between any footprint and the workspace's border."""
CAMERA_DISTANCE = 0.8
CAMERA_POLAR = (math.radians(30.0), math.radians(60.0))
CAMERA_AZIMUTH = (math.radians(-150.0), math.radians(150.0))
SPREAD_VIEWS = 3
"""So many views from the front are those that methods see; their azimuths lie apart."""
MIN_SPREAD = math.radians(60.0)
_LAYOUT_STREAM, _CAMERA_STREAM = 0, 1

workspace = Workspace()


def scene_generator(seed: int, index: int, stream: int) -> Generator:
    """Returns the random generator of one scene's `stream` of draws; streams are independent of each other."""
    return np.random.default_rng(np.random.SeedSequence((seed, index, stream)))


def simple_scene(seed: int, index: int) -> Truth:
    """Returns one scene of the simple task: one to five upright prisms, well apart, each of one colour."""
    rng = scene_generator(seed, index, _LAYOUT_STREAM)
    count = int(rng.integers(1, MAX_OBJECTS + 1))
    while True:
        objects = _try_layout(rng, count)
        if objects is not None:
            return Truth("simple", seed, index, objects)


def scene_cameras(seed: int, index: int, views: int, size: int = 128) -> Camera:
    """Returns cameras `[views]` on a sphere about the workspace's centre on the table, looking at it.

    The first three views' azimuths lie at least 60° apart, and asking for more views changes none of the first.
    """
    rng = scene_generator(seed, index, _CAMERA_STREAM)
    azimuths = np.concatenate([_spread_azimuths(rng), rng.uniform(*CAMERA_AZIMUTH, max(views, SPREAD_VIEWS))])[:views]
    polar = scene_generator(seed, index, _CAMERA_STREAM + 1).uniform(*CAMERA_POLAR, views)
    around = [np.sin(polar) * np.cos(azimuths), np.sin(polar) * np.sin(azimuths), np.cos(polar)]
    eyes = torch.from_numpy(CAMERA_DISTANCE * np.stack(around, axis=-1))
    T_world_camera = look_at(eyes, torch.zeros(3, dtype=eyes.dtype)).float()
    focal = 120 / 128 * size
    intrinsics = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    return Camera(intrinsics.repeat(views, 1, 1), T_world_camera, size, size)


def _spread_azimuths(rng: Generator) -> NDArray[np.float64]:
    while True:
        azimuths = rng.uniform(*CAMERA_AZIMUTH, SPREAD_VIEWS)
        apart = (azimuths[:, None] - azimuths[None] + math.pi) % (2 * math.pi) - math.pi
        if (np.abs(apart)[~np.eye(SPREAD_VIEWS, dtype=bool)] >= MIN_SPREAD).all():
            return azimuths


def _try_layout(rng: Generator, count: int, tries: int = 60) -> tuple[Prism, ...] | None:
    """Draws objects one after another and finds each a free place; None where one finds none."""
    placed: list[Prism] = []
    for _ in range(count):
        kind = str(rng.choice(list(RANDOM_FOOTPRINTS)))
        parts = RANDOM_FOOTPRINTS[kind](rng)
        height, density, colour = rng.uniform(0.025, 0.12), rng.uniform(200.0, 600.0), _saturated_colour(rng)
        for _ in range(tries):
            prism = Prism(kind, parts, float(height), colour, float(density), _random_pose(rng))
            if _fits(prism, placed):
                placed.append(prism)
                break
        else:
            return None
    return tuple(placed)


def _fits(prism: Prism, placed: list[Prism]) -> bool:
    limit = workspace.maximum.double().numpy()[:2] - WORKSPACE_MARGIN
    footprint = footprint_in_world(prism)
    inside = all((np.abs(part) <= limit).all() for part in footprint)
    return inside and all(clear_gap(footprint, footprint_in_world(other)) >= CLEAR_GAP for other in placed)


def _random_pose(rng: Generator) -> torch.Tensor:
    x, y = rng.uniform(-0.23, 0.23, 2)
    yaw = rng.uniform(-math.pi, math.pi)
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    pose[:2, 3] = x, y
    return torch.from_numpy(pose).float()


def _saturated_colour(rng: Generator) -> tuple[float, float, float]:
    hue, saturation, value = rng.uniform(0.0, 1.0), rng.uniform(0.75, 1.0), rng.uniform(0.6, 1.0)
    return colorsys.hsv_to_rgb(float(hue), float(saturation), float(value))
