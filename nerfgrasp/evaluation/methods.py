"""The methods that are evaluated: found by a registered name, or by the model folder that names one."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from inspect import Parameter, signature
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

import torch
from torch import nn

from nerfgrasp import registry
from nerfgrasp.errors import UserError, unknown_name
from nerfgrasp.files import read_json
from nerfgrasp.models.folder import find_model, weights_hash
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search.strategies import Strategy


class Method(Protocol):
    """What the group `nerfgrasp.baselines` holds."""

    needs: ClassVar[frozenset[str]]
    """Out of `depth` and `truth`: what it is given beside RGB images."""

    def propose(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> Grasps:
        """Returns up to `count` grasps, best first."""


@runtime_checkable
class Schedulable(Protocol):
    """A method that can search in several ways."""

    def with_schedule(self, name: str) -> Method:
        """Returns the method with another search, by its name; an unknown one is a UserError."""


@runtime_checkable
class Posable(Protocol):
    """A method that searches in a pose parameterization."""

    def with_pose(self, name: str) -> Method:
        """Returns the method in another parameterization, by its registered name; an unknown one is a UserError."""


def find_method(name: str) -> tuple[str, str | None]:
    """Returns the registered name of a method and the model folder that it is to be loaded from.

    Args:
        name: a registered name (no folder: the method's own default), a model's folder, a shipped model's name, or a
            Hugging Face repository id.

    Raises:
        UserError: it is none of them, or the model's `config.json` names no method that is registered.
    """
    if name in registry.names(registry.BASELINES):
        return registry.find(registry.BASELINES, name).name, None
    try:
        folder = find_model(name)
    except UserError as error:
        if Path(name).name != name:
            raise
        raise unknown_name("method (and no model)", name, registry.names(registry.BASELINES)) from error
    return registry.find(registry.BASELINES, method_of(folder, name)).name, str(folder)


def method_of(folder: Path, name: str) -> str:
    """Returns the registered name of the method that a model is for, as its folder says.

    Args:
        folder: the model's.
        name: what the user called it.

    Raises:
        UserError: its `config.json` names none, or cannot be read.
    """
    method = read_json(folder / "config.json").get("method")
    if not isinstance(method, str):
        raise UserError(f"model {name}: its config.json names no grasping method, so it finds no grasps")
    return method


@lru_cache(maxsize=1)
def load_method(
    name: str, folder: str | None, *, schedule: str | None = None, device: str | None = None, pose: str | None = None
) -> Method:
    """Returns a method, loaded once a process.

    Args:
        name: as registered.
        folder: to load it from; None for its default.
        schedule: how it is to search, by name, for a method with a `with_schedule(name)`; None for its own way.
        device: where it is to compute, for a method whose `from_pretrained` takes a `device`; None for its own choice.
        pose: the parameterization that it is to search in, for a method with a `with_pose(name)`; None for its own.

    Raises:
        UserError: it cannot be loaded, it has no default, or no such schedule, device or parameterization; or its code
            is at fault.
    """
    kind = registry.load(registry.BASELINES, name)
    with blaming(name, "from_pretrained"):
        parameters = list(signature(kind.from_pretrained).parameters.values())
        if not parameters:
            raise TypeError("it takes no folder")
        if folder is None and parameters[0].default is Parameter.empty:
            raise UserError(f"method {name!r} needs a model: give the model's folder instead of the method's name")
        if device is not None and "device" not in [parameter.name for parameter in parameters]:
            raise UserError(f"method {name!r} takes no device: leave device {device!r} out")
        where = {} if device is None else {"device": device}
        method: Method = kind.from_pretrained(*([] if folder is None else [folder]), **where)
    if schedule is not None:
        if not isinstance(method, Schedulable):
            raise UserError(f"method {name!r} has no search schedules: leave schedule {schedule!r} out")
        with blaming(name, "with_schedule"):
            method = method.with_schedule(schedule)
    if pose is not None:
        if not isinstance(method, Posable):
            raise UserError(f"method {name!r} searches in no pose parameterization: leave pose {pose!r} out")
        with blaming(name, "with_pose"):
            method = method.with_pose(pose)
    return method


@contextmanager
def blaming(name: str, where: str) -> Iterator[None]:
    """Tells in one line of an error in a method's code, which is nobody's mistake but its author's.

    Its traceback is what `--debug` shows. What the method tells the user itself, by a UserError, stays as it is.

    Args:
        name: as registered.
        where: what was asked of it, e.g. `scene 3, attempt 0`.

    Raises:
        UserError: the block raised; it names the method, its class, distribution and version.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # a stranger's code may raise anything
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        raise UserError(f"{described(name)}, {where}: {cause} (the plug-in is at fault)") from error


def described(name: str) -> str:
    """Returns a method's name with its class, distribution and version, where it is registered.

    Example:
        >>> described("psi").partition(" of ")[0]
        "method 'psi' (nerfgrasp.search.psi:Psi"
    """
    found = [f" ({entry})" for entry in registry.entries(registry.BASELINES) if entry.name == name]
    return f"method {name!r}{''.join(found)}"


def method_search(method: Method) -> str | None:
    """Returns name and hash of how a method searches, its `strategy`'s; None if it has none."""
    strategy = getattr(method, "strategy", None)
    return strategy.identity if isinstance(strategy, Strategy) else None


def method_hash(method: Method) -> str | None:
    """Returns 16 hexadecimal digits of the SHA-256 of a method's weights, its `model`'s; None if it has none."""
    model = getattr(method, "model", None)
    return weights_hash(model)[:16] if isinstance(model, nn.Module) else None
