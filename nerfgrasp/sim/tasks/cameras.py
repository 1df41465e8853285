"""From where cameras look at a scene; the same for every task."""

import math

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray

from nerfgrasp.geometry import Camera, look_at
from nerfgrasp.scenes.images import IMAGE_SIZE
from nerfgrasp.sim.tasks.draws import scene_generator

CAMERA_DISTANCE = 0.8
CAMERA_POLAR = (math.radians(30.0), math.radians(60.0))
CAMERA_AZIMUTH = (math.radians(-150.0), math.radians(150.0))
SPREAD_VIEWS = 3
"""So many views from the front are those that methods see; their azimuths lie apart."""
MIN_SPREAD = math.radians(60.0)
_CAMERA_STREAM = 1


def scene_cameras(seed: int, index: int, views: int, size: int = IMAGE_SIZE) -> Camera:
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
