"""The simple task: upright prisms, well apart. A pure function of (seed, index), without physics."""

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from nerfgrasp.scenes.prisms import Prism, clear_gap, footprint_in_world
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.tasks.draws import WORKSPACE_MARGIN, random_prism, scene_generator, upright_pose, workspace

MAX_OBJECTS = 5
CLEAR_GAP = 0.06
"""Metres between any two footprints, so that the open fingers reach every side of every object."""
_LAYOUT_STREAM = 0


def simple_scene(seed: int, index: int) -> Truth:
    """Returns one scene of the simple task: one to five upright prisms, well apart, each of one colour."""
    rng = scene_generator(seed, index, _LAYOUT_STREAM)
    count = int(rng.integers(1, MAX_OBJECTS + 1))
    while True:
        objects = _try_layout(rng, count)
        if objects is not None:
            return Truth("simple", seed, index, objects)


def _try_layout(rng: Generator, count: int, tries: int = 60) -> tuple[Prism, ...] | None:
    """Draws objects one after another and finds each a free place; None where one finds none."""
    placed: list[Prism] = []
    for _ in range(count):
        drawn = random_prism(rng)
        for _ in range(tries):
            prism = replace(drawn, T_world_object=upright_pose(rng, 0.23))
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
