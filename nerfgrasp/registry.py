"""Plug-ins by entry points: listing reads metadata only, getting a name imports that one.

Built-ins are declared in the project's own `pyproject.toml` and come through the same door as everyone else's.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from nerfgrasp.errors import UserError, unknown_name

POSES = "nerfgrasp.poses"
"""Pose parameterizations."""
BASELINES = "nerfgrasp.baselines"
"""Whole grasping methods."""
GRIPPERS = "nerfgrasp.grippers"
"""Parallel grippers: objects of the class `nerfgrasp.grippers.Gripper`."""

GROUPS = {POSES: "pose", BASELINES: "method", GRIPPERS: "gripper"}
"""Every group, with what one of its members is called."""


@dataclass(frozen=True, order=True)
class Entry:
    """What the metadata says of one plug-in."""

    group: str
    """The entry-point group, e.g. `nerfgrasp.poses`."""
    name: str
    """The registered name, as configs and options give it."""
    value: str
    """Where the object is: `package.module:Attribute`."""
    distribution: str
    """The installed distribution that declares it."""
    version: str
    """That distribution's version."""

    def __str__(self) -> str:
        return f"{self.value} of {self.distribution} {self.version}"


def entries(group: str) -> list[Entry]:
    """Returns the plug-ins of a group by name, without importing any.

    One distribution that is found twice (an editable install beside a built one) counts once, the first on the
    path; two distributions that declare one name are both in the list.
    """
    return sorted(map(_read, entry_points(group=group)))


def names(group: str) -> list[str]:
    """Returns the registered names of a group, without importing any plug-in.

    Example:
        >>> "quaternion" in names(POSES)
        True
    """
    return sorted({entry.name for entry in entries(group)})


def find(group: str, name: str) -> Entry:
    """Returns the one plug-in of that name, without importing it.

    Raises:
        UserError: no plug-in has the name (the message lists near misses and choices), or two distributions
            declare it (the message names both).
    """
    found = [entry for entry in entries(group) if entry.name == name]
    kind = GROUPS.get(group, group)
    if not found:
        raise unknown_name(kind, name, names(group))
    if len(found) > 1:
        raise UserError(f"{kind} {name!r} is declared twice: {' and '.join(map(str, found))}; uninstall one")
    return found[0]


def load(group: str, name: str) -> Any:
    """Imports and returns the plug-in of that name.

    Raises:
        UserError: as `find`, or the plug-in fails to import (the message names its distribution, version and cause).
    """
    entry = find(group, name)
    try:
        return EntryPoint(entry.name, entry.value, entry.group).load()
    except Exception as error:  # whatever a stranger's module raises while it is imported
        kind = GROUPS.get(group, group)
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise UserError(f"{kind} {name!r} ({entry}) fails to import: {cause}") from error


def described(group: str, name: str) -> str:
    """Returns a plug-in's kind and name with its class, distribution and version, if it is registered.

    Example:
        >>> described(BASELINES, "psi").partition(" of ")[0]
        "method 'psi' (nerfgrasp.methods.psi:Psi"
    """
    found = [f" ({entry})" for entry in entries(group) if entry.name == name]
    return f"{GROUPS.get(group, group)} {name!r}{''.join(found)}"


@contextmanager
def blaming(plugin: str, step: str) -> Iterator[None]:
    """Turns an exception in a plug-in's code into a UserError that names the plug-in.

    `--debug` shows the exception's traceback. A UserError that the plug-in raises passes unchanged.

    Args:
        plugin: the plug-in, as `described` names it.
        step: the step that failed, e.g. `scene 3, attempt 0`.

    Raises:
        UserError: the block raised an exception.

    Example:
        >>> with blaming("pose 'mine'", "decode"):
        ...     1 / 0
        Traceback (most recent call last):
        nerfgrasp.errors.UserError: pose 'mine', decode: ZeroDivisionError: division by zero (the plug-in is at fault)
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # a plug-in's code may raise anything
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise UserError(f"{plugin}, {step}: {cause} (the plug-in is at fault)") from error


def _read(point: EntryPoint) -> Entry:
    distribution = point.dist
    if distribution is None:
        return Entry(point.group, point.name, point.value, "unknown", "unknown")
    return Entry(point.group, point.name, point.value, distribution.metadata["Name"], distribution.version)
