"""`nerfgrasp generate`: draws and renders scenes into a set."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nerfgrasp.commands.ranges import check_ranges
from nerfgrasp.data.folders import FolderWriter
from nerfgrasp.data.packed import PackedWriter
from nerfgrasp.data.settings import SetSettings
from nerfgrasp.errors import UserError, unknown_name
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper, find_gripper
from nerfgrasp.parallel import Cluster, run_all
from nerfgrasp.scenes.images import IMAGE_SIZE
from nerfgrasp.scenes.scene import Workspace

if TYPE_CHECKING:  # a training machine has no simulator
    from nerfgrasp.sim.tasks import Task

WRITERS: dict[str, type[PackedWriter] | type[FolderWriter]] = {"packed": PackedWriter, "folders": FolderWriter}


def generate(
    task: str = "simple",
    *,
    scenes: int,
    views: int = 24,
    seed: int = 0,
    out: Path,
    size: int = IMAGE_SIZE,
    demonstrations: bool = True,
    workers: int | None = None,
    cluster: Cluster | None = None,
    objects: Path | None = None,
    format: Literal["packed", "folders"] = "packed",
    depth: bool = False,
    gripper: str | None = None,
) -> None:
    """Generates a set of simulated scenes: images from known cameras, the truth and, if asked for, a grasp each.

    A set is a function of its settings: the number of workers does not change a byte of it. A run that was
    stopped or killed continues where the same command is given again.

    Args:
        task: what the scenes are: `simple`, `clutter` or `novel`.
        scenes: how many scenes.
        views: images of each scene.
        seed: a set's scenes are the first of an endless sequence that the seed names.
        out: the set's folder, a new one or one to continue.
        size: width and height of an image in pixels.
        demonstrations: whether to demonstrate a grasp in each scene, in physics.
        workers: number of processes; one a core if not given.
        cluster: `ray` draws and renders on a Ray cluster, whose machines all see `out`.
        objects: for `novel`: a folder of URDFs or meshes; the one that NERFGRASP_OBJECTS names if not given, or else
            the objects that come with pybullet.
        format: `packed` for training, or `folders`, one scene folder each.
        depth: whether to keep the images' depth, for methods that need it; in packed sets alone. The rest of the set
            stays the same.
        gripper: the hand that demonstrates grasps: a registered gripper (`nerfgrasp plugins list`) or a YAML file
            (docs/grippers.md); the Robotiq 2F-85 if not given.

    Raises:
        UserError: a value is out of range, or `out` holds another set or cannot be written.
    """
    from nerfgrasp.sim.catalogue import open_catalogue
    from nerfgrasp.sim.physics import PHYSICS, physics_hash
    from nerfgrasp.sim.tasks import find_task

    check_ranges(scenes=scenes, views=views, seed=seed, size=size, workers=workers)
    if format not in WRITERS:
        raise unknown_name("format", format, WRITERS)
    if depth and format != "packed":
        raise UserError(f"depth is kept in packed sets alone, not in {format}")
    found = find_task(task, objects)
    # Simple scenes are drawn, not settled: without demonstrations nothing in them depends on physics.
    hand = DEFAULT_GRIPPER if gripper is None or not demonstrations else find_gripper(gripper)
    physics = physics_hash(PHYSICS, hand) if demonstrations or task != "simple" else ""
    catalogue = open_catalogue(objects).sha256 if found.catalogue else ""
    settings = SetSettings(task, seed, scenes, views, size, demonstrations, physics, format, catalogue, depth)
    writer = WRITERS[format](Path(out), settings)
    writer.prepare(Workspace())
    if not writer.missing():
        print(f"{out} is already complete: {scenes} scenes")
        return
    job = partial(write_slot, writer, found, hand)
    run_all(job, writer.missing, scenes, workers=workers, cluster=cluster, describe="generate", unit="scene")
    writer.clear()  # where a worker was lost, others were killed beside it
    _report(writer)


def write_slot(writer: PackedWriter | FolderWriter, task: "Task", gripper: Gripper, index: int) -> None:
    """Draws, renders and writes scene `index` of a set; a pure function of the set's settings and `index`."""
    from nerfgrasp.sim.rendering import render_scene
    from nerfgrasp.sim.tasks import scene_cameras

    settings = writer.settings
    truth = task.draw(settings.seed, index)
    camera = scene_cameras(settings.seed, index, settings.views, settings.size)
    depth = None
    if settings.depth:
        images, masks, depth = render_scene(truth, camera, depth=True)
    else:
        images, masks = render_scene(truth, camera)
    if settings.demonstrations:
        from nerfgrasp.sim.attempt import demonstrate

        truth = replace(truth, demonstration=demonstrate(truth, gripper))
    writer.write(index, images, masks, camera, truth, depth)


def _report(writer: PackedWriter | FolderWriter) -> None:
    settings = writer.settings
    line = f"{writer.folder}: {settings.scenes} scenes of {settings.views} views"
    if settings.demonstrations:
        without = sum(writer.truth(index).demonstration is None for index in range(settings.scenes))
        line += f", {without} without a demonstrated grasp"
    print(line)
