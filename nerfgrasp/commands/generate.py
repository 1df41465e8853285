"""`nerfgrasp generate`: draws and renders scenes into a set."""

from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
from joblib import Parallel, cpu_count, delayed, parallel_config
from tqdm import tqdm

from nerfgrasp.data.folders import FolderWriter
from nerfgrasp.data.packed import PackedWriter
from nerfgrasp.data.settings import SetSettings
from nerfgrasp.errors import UserError, unknown_name
from nerfgrasp.scenes.scene import Workspace

TASKS = ("simple",)
WRITERS: dict[str, type[PackedWriter] | type[FolderWriter]] = {"packed": PackedWriter, "folders": FolderWriter}
RESTARTS = 2
"""How often scenes are taken up again after a worker process died."""


def generate(
    task: str = "simple",
    *,
    scenes: int,
    views: int = 24,
    seed: int = 0,
    out: Path,
    size: int = 128,
    demonstrations: bool = True,
    workers: int | None = None,
    format: Literal["packed", "folders"] = "packed",
) -> None:
    """Generates a set of simulated scenes: images from known cameras, the truth and, if asked for, a grasp each.

    A set is a function of its settings: the number of workers does not change a byte of it. A run that was
    stopped or killed continues where the same command is given again.

    Args:
        task: what the scenes are: `simple`.
        scenes: how many scenes.
        views: images of each scene.
        seed: a set's scenes are the first of an endless sequence that the seed names.
        out: the set's folder, a new one or one to continue.
        size: width and height of an image in pixels.
        demonstrations: whether to demonstrate a grasp in each scene, in physics.
        workers: number of processes; one a core if not given.
        format: `packed` for training, or `folders`, one scene folder each.

    Raises:
        UserError: a value is out of range, or `out` holds another set or cannot be written.
    """
    _check(task, scenes, views, seed, size, workers, format)
    # Without demonstrations nothing in a set depends on physics.
    physics = _physics() if demonstrations else ""
    settings = SetSettings(task, seed, scenes, views, size, demonstrations, physics, format)
    writer = WRITERS[format](Path(out), settings)
    writer.prepare(Workspace())
    missing = writer.missing()
    if not missing:
        print(f"{out} is already complete: {scenes} scenes")
        return
    _write_missing(writer, missing, workers or cpu_count())
    _report(writer)


def _physics() -> str:
    from nerfgrasp.sim.physics import PHYSICS, physics_hash

    return physics_hash(PHYSICS)


def write_slot(writer: PackedWriter | FolderWriter, index: int) -> None:
    """Draws, renders and writes scene `index` of a set; a pure function of the set's settings and `index`."""
    from nerfgrasp.sim.rendering import render_scene
    from nerfgrasp.sim.tasks import scene_cameras, simple_scene

    settings = writer.settings
    with _single_thread():
        truth = simple_scene(settings.seed, index)
        camera = scene_cameras(settings.seed, index, settings.views, settings.size)
        images, masks = render_scene(truth, camera)
        if settings.demonstrations:
            from nerfgrasp.sim.attempt import demonstrate

            truth = replace(truth, demonstration=demonstrate(truth))
    writer.write(index, images, masks, camera, truth)


def _write_missing(writer: PackedWriter | FolderWriter, missing: list[int], workers: int) -> None:
    total = writer.settings.scenes
    with tqdm(total=total, initial=total - len(missing), unit="scene", desc="generate", disable=None) as progress:
        for attempt in range(RESTARTS + 1):
            try:
                for _ in _in_parallel(writer, missing, workers):
                    progress.update()
                return
            except BrokenProcessPool as error:
                missing = writer.missing()
                progress.n = total - len(missing)
                if attempt == RESTARTS:
                    message = f"worker processes died {attempt + 1} times (out of memory?)"
                    raise UserError(f"{message}: try fewer workers; the same command continues") from error


def _in_parallel(writer: PackedWriter | FolderWriter, missing: list[int], workers: int) -> Iterator[None]:
    with parallel_config("loky", n_jobs=min(workers, len(missing)), inner_max_num_threads=1):
        # One scene takes far longer than handing it out: no batches, so that a killed run loses little.
        parallel = Parallel(return_as="generator_unordered", batch_size=1)
        yield from parallel(delayed(write_slot)(writer, index) for index in missing)


@contextmanager
def _single_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _report(writer: PackedWriter | FolderWriter) -> None:
    settings = writer.settings
    line = f"{writer.folder}: {settings.scenes} scenes of {settings.views} views"
    if settings.demonstrations:
        without = sum(writer.truth(index).demonstration is None for index in range(settings.scenes))
        line += f", {without} without a demonstrated grasp"
    print(line)


def _check(task: str, scenes: int, views: int, seed: int, size: int, workers: int | None, format: str) -> None:
    if task not in TASKS:
        raise unknown_name("task", task, TASKS)
    if format not in WRITERS:
        raise unknown_name("format", format, WRITERS)
    ranges = {"scenes": (scenes, 1, 999_999), "views": (views, 1, 1000), "size": (size, 16, 2048)}
    ranges |= {"seed": (seed, 0, 2**32 - 1), "workers": (1 if workers is None else workers, 1, 1024)}
    for name, (value, least, most) in ranges.items():
        if not least <= value <= most:
            raise UserError(f"{name} is {value}: it must be from {least} to {most}")
