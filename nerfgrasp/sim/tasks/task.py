"""What a task is."""

from collections.abc import Callable
from dataclasses import dataclass

from nerfgrasp.scenes.scene import Truth


@dataclass(frozen=True)
class Task:
    """A family of scenes and how often a method may grasp in each."""

    name: str
    """By which `find_task` finds it."""
    attempts: int
    """At most so many a scene."""
    draw: Callable[[int, int], Truth]
    """(seed, index) -> the scene: the same on every call."""
    catalogue: str | None = None
    """The name of the set that its objects come from; None where they are prisms."""
