"""The novel task: one object of a catalogue, at rest in a pose that it fell into."""

from functools import partial
from pathlib import Path

import torch
from numpy.random import Generator
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import make_pose, transform
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.catalogue import chosen_folder, open_catalogue
from nerfgrasp.sim.settling import drop, stable
from nerfgrasp.sim.tasks.draws import WORKSPACE_MARGIN, random_rotation, scene_generator, workspace
from nerfgrasp.sim.tasks.task import Task

REACH = 0.05
"""Metres from the workspace's centre along x and y within which the object is let go."""
FALL = 0.03
"""Metres that its lowest corner falls."""
TRIES = 100
"""Falls of one object, at most."""
_LAYOUT_STREAM = 0


def novel_task(objects: Path | None = None) -> Task:
    """Returns the task of a catalogue's objects, each in as many scenes as any other.

    Args:
        objects: the catalogue's folder; without, what `open_catalogue` takes instead.

    Raises:
        UserError: there are no models, or one of them cannot be read.
    """
    # Settled here: a worker process may stand elsewhere, and know other variables.
    folder = chosen_folder(objects)
    catalogue = open_catalogue(folder)
    # What is wrong with a user's models is said now, not in the middle of a run.
    if folder is not None:
        _ = catalogue.models
    return Task("novel", 1, partial(novel_scene, folder=folder), catalogue.name)


def novel_scene(seed: int, index: int, folder: Path | None = None) -> Truth:
    """Returns one scene of the novel task: object number `index` modulo how many there are, fallen and at rest.

    It is let go near the workspace's centre, turned at random; a scene of which it rolls or sticks out of the
    workspace, or does not stay where it lies, is drawn again.

    Raises:
        UserError: `folder` has no models, or this one cannot be read, or it never stays in the workspace.
    """
    catalogue = open_catalogue(folder)
    model = catalogue.model(catalogue.names[index % len(catalogue.names)])
    rng = scene_generator(seed, index, _LAYOUT_STREAM)
    corners = torch.from_numpy(model.corners()).float()
    for _ in range(TRIES):
        resting = drop((model.place(_start(rng, corners)),))
        if _inside(transform(resting[0].T_world_object, corners)) and stable(resting):
            return Truth("novel", seed, index, resting)
    raise UserError(
        f"object {model.name!r} of {catalogue.name} never comes to rest within the workspace: is it too large?"
    )


def _start(rng: Generator, corners: Tensor) -> Tensor:
    """Returns a pose `[4, 4]` from which the hulls' `corners` `[K, 3]` fall."""
    rotation = random_rotation(rng)
    x, y = rng.uniform(-REACH, REACH, 2)
    z = FALL - float((corners @ rotation.T)[:, 2].min())
    return make_pose(rotation, torch.tensor([x, y, z], dtype=torch.float32))


def _inside(corners: Tensor) -> bool:
    limit = workspace.maximum - torch.tensor([WORKSPACE_MARGIN, WORKSPACE_MARGIN, 0.0])
    return bool((corners[:, :2].abs() <= limit[:2]).all() and (corners[:, 2] <= limit[2]).all())
