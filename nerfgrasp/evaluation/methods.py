"""The methods that are evaluated: found by a registered name, or by the model folder that names one."""

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
    method = read_json(folder / "config.json").get("method")
    if not isinstance(method, str):
        raise UserError(f"model {name}: its config.json names no grasping method, so it finds no grasps")
    return registry.find(registry.BASELINES, method).name, str(folder)


@lru_cache(maxsize=1)
def load_method(name: str, folder: str | None, schedule: str | None = None) -> Method:
    """Returns a method, loaded once a process.

    Args:
        name: as registered.
        folder: to load it from; None for its default.
        schedule: how it is to search, by name, for a method with a `with_schedule(name)`; None for its own way.

    Raises:
        UserError: it cannot be loaded, it has no default, or no such schedule.
    """
    loader = registry.load(registry.BASELINES, name).from_pretrained
    parameter = next(iter(signature(loader).parameters.values()))
    if folder is None and parameter.default is Parameter.empty:
        raise UserError(f"method {name!r} needs a model: give the model's folder instead of the method's name")
    method: Method = loader() if folder is None else loader(folder)
    if schedule is None:
        return method
    if not isinstance(method, Schedulable):
        raise UserError(f"method {name!r} has no search schedules: leave schedule {schedule!r} out")
    return method.with_schedule(schedule)


def method_search(method: Method) -> str | None:
    """Returns name and hash of how a method searches, its `strategy`'s; None if it has none."""
    strategy = getattr(method, "strategy", None)
    return strategy.identity if isinstance(strategy, Strategy) else None


def method_hash(method: Method) -> str | None:
    """Returns 16 hexadecimal digits of the SHA-256 of a method's weights, its `model`'s; None if it has none."""
    model = getattr(method, "model", None)
    return weights_hash(model)[:16] if isinstance(model, nn.Module) else None
