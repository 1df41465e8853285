"""The pictures in docs/: what the tasks look like, and how grasp attempts end.

    python benchmarks/pictures.py --objects YCB_FOLDER

writes docs/tasks.png, a contact sheet of each task's first scenes, and docs/outcomes.png, a strip of frames of a
success and of each failure. The attempts are the oracle's, perturbed at random until every outcome has come up. Without
`--objects` the novel objects are those that come with PyBullet.
"""

import math
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import roma
import torch
from jsonargparse import auto_cli
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from nerfgrasp.files import replacing
from nerfgrasp.geometry import Camera
from nerfgrasp.scenes.oracle import sample_top_down, valid_grasps
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.attempt import Attempt, Outcome
from nerfgrasp.sim.film import Frame, film_grasp
from nerfgrasp.sim.tasks import TASKS, find_task, scene_cameras, scene_generator, simple_scene
from nerfgrasp.viz.contact_sheet import Section, contact_sheet
from nerfgrasp.viz.film_strip import close_up, film_strip, square_camera, square_image

COLUMNS = 6
"""Images in a row."""
LENSES = {"simple": 1.15, "clutter": 1.4, "novel": 1.8}
"""Focal lengths in image widths; that of the tasks' own cameras is 0.94."""
SHIFT, TURN, SINK = 0.014, math.radians(14.0), 0.004
"""How grasps are perturbed: metres and radians, standard deviations along and about each axis; and metres down."""
TRIES = 3
"""Grasps in each scene."""
_PERTURBATION_STREAM = 30

TITLES = {
    "simple": "simple: one to five prisms, upright and apart",
    "clutter": "clutter: five prisms, piled up or pushed together",
    "novel": "novel: one object of the catalogue {catalogue}, as it fell",
}
DROPPED = "dropped"
"""Beside the outcomes of the attempt: what an attempt may do to the scene."""
HEADINGS = {
    Outcome.SUCCESS: "success",
    Outcome.OBJECT_COLLISION: "approach collision with an object",
    Outcome.TABLE_COLLISION: "approach collision with the table",
    Outcome.NOTHING_BETWEEN_FINGERS: "nothing between the fingers",
    Outcome.SLIPPED: "slipped while lifting",
    DROPPED: "an object dropped from the workspace",
    Outcome.NO_GRASP: "no grasp proposed",
}


def main(out: Path = Path("docs"), seed: int = 7, scenes: int = 12, objects: Path | None = None) -> None:
    """Draws the pictures.

    Args:
        out: where they are written.
        seed: of the scenes and the perturbed grasps.
        scenes: how many of each task.
        objects: a folder of object models for the novel task.
    """
    _write(out / "tasks.png", contact_sheet([task_section(name, seed, scenes, objects) for name in TASKS], COLUMNS))
    _write(
        out / "outcomes.png",
        contact_sheet([film_strip(HEADINGS[name], *found) for name, *found in find_outcomes(seed)], COLUMNS),
    )


def task_section(name: str, seed: int, scenes: int, objects: Path | None) -> Section:
    """Returns one task's first scenes, each as its first camera sees it, captioned with what is in it."""
    task = find_task(name, objects if name == "novel" else None)
    truths = [task.draw(seed, index) for index in tqdm(range(scenes), desc=name)]
    images = tuple(square_image(truth, scene_camera(truth)) for truth in truths)
    captions = tuple(_contents(truth) for truth in truths)
    return Section(TITLES[name].format(catalogue=task.catalogue), images, captions)


def find_outcomes(seed: int) -> list[tuple[str, tuple[Frame, ...], Camera]]:
    """Returns an attempt's frames for every outcome, in the order of `HEADINGS`, and the camera that sees it well."""
    first = simple_scene(seed, 0)
    found: dict[str, tuple[tuple[Frame, ...], Camera]] = {
        Outcome.NO_GRASP: ((Frame("untouched", first),), scene_camera(first))
    }
    for truth, grasp in tqdm(perturbed_grasps(seed), desc="attempts"):
        attempt, frames = film_grasp(truth, grasp)
        name = _name(attempt)
        if name not in found:
            found[name] = (frames, close_up(grasp))
        if len(found) == len(HEADINGS):
            break
    return [(name, *found[name]) for name in HEADINGS]


def perturbed_grasps(seed: int) -> Iterator[tuple[Truth, Tensor]]:
    """Yields simple scenes with grasps `[4, 4]` that are valid ones moved, turned and lowered at random."""
    for index in count():
        truth = simple_scene(seed, index)
        rng = scene_generator(seed, index, _PERTURBATION_STREAM)
        generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
        valid = valid_grasps(truth.objects)
        for _ in range(TRIES if len(valid) else 0):
            grasp = sample_top_down(valid, generator).float()
            turn = roma.rotvec_to_rotmat(torch.from_numpy(rng.normal(0.0, TURN, 3)).float())
            grasp[:3, :3] = grasp[:3, :3] @ turn
            grasp[:3, 3] += torch.from_numpy(rng.normal((0.0, 0.0, -SINK), SHIFT)).float()
            yield truth, grasp


def scene_camera(truth: Truth) -> Camera:
    """Returns the scene's first camera `[1]` with a longer lens, so that the objects fill the image."""
    return square_camera(scene_cameras(truth.seed, truth.index, 1).T_world_camera, LENSES[truth.task])


def _name(attempt: Attempt) -> str:
    return DROPPED if attempt.dropped else attempt.outcome


def _contents(truth: Truth) -> str:
    kinds = [getattr(thing, "name", None) or getattr(thing, "kind", "") for thing in truth.objects]
    return ", ".join(kinds) if len(kinds) <= 3 else f"{len(kinds)} objects"


def _write(path: Path, image: Image.Image) -> None:
    with replacing(path) as temporary:
        image.save(temporary, format="PNG", optimize=True)
    print(path)


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
