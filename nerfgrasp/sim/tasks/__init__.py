"""The tasks by name: which objects lie where, and from where cameras look at them."""

from pathlib import Path

from nerfgrasp.errors import UserError, unknown_name
from nerfgrasp.sim.tasks.cameras import scene_cameras
from nerfgrasp.sim.tasks.clutter import clutter_scene
from nerfgrasp.sim.tasks.draws import scene_generator, workspace
from nerfgrasp.sim.tasks.simple import simple_scene
from nerfgrasp.sim.tasks.task import Task

__all__ = [
    "TASKS",
    "Task",
    "clutter_scene",
    "find_task",
    "scene_cameras",
    "scene_generator",
    "simple_scene",
    "workspace",
]

TASKS: tuple[str, ...] = ("simple", "clutter", "novel")
"""The names that `find_task` knows."""
CLUTTER_ATTEMPTS = 10
"""For five objects."""


def find_task(name: str, objects: Path | None = None) -> Task:
    """Returns the task called `name`.

    Args:
        name: one of `TASKS`.
        objects: a folder of object models, for `novel` alone; see `nerfgrasp.sim.catalogue.open_catalogue`.

    Raises:
        UserError: there is no such task, or it takes no objects, or the folder is none of objects.
    """
    if name not in TASKS:
        raise unknown_name("task", name, TASKS)
    if name == "novel":
        from nerfgrasp.sim.tasks.novel import novel_task  # reads the models: only where they are asked for

        return novel_task(objects)
    if objects is not None:
        raise UserError(f"the task {name!r} draws its own objects: only 'novel' takes a folder of them ({objects})")
    return Task("simple", 1, simple_scene) if name == "simple" else Task("clutter", CLUTTER_ATTEMPTS, clutter_scene)
