"""Finding and loading methods: by a registered name, or by a model folder that names its method."""

from contextlib import AbstractContextManager
from functools import lru_cache
from inspect import Parameter, signature
from pathlib import Path
from typing import Any

from torch import nn

from nerfgrasp import registry
from nerfgrasp.errors import UserError, choices_hint, unknown_name
from nerfgrasp.files import read_json
from nerfgrasp.methods.interface import Method
from nerfgrasp.methods.spec import MethodSpec
from nerfgrasp.models.folder import find_model, weights_hash
from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.search.strategies import Strategy


def find_method(name: str, **options: Any) -> MethodSpec:
    """Returns the method that a name stands for. It is not imported, and its options are not checked.

    Example:
        >>> find_method("oracle", tries=10)
        MethodSpec(name='oracle', folder=None, options={'tries': 10})

    Args:
        name: a registered name (the method's default model is used), a model folder, a shipped model's name, or a
            Hugging Face repository id.
        options: the method's options; None for one that is not given.

    Raises:
        UserError: the name is none of these, or the model's `config.json` names no registered method.
    """
    if name in registry.names(registry.BASELINES):
        return MethodSpec(registry.find(registry.BASELINES, name).name, options=options)
    try:
        folder = find_model(name)
    except UserError as error:
        if Path(name).name != name:
            raise
        raise unknown_name("method (and no model)", name, registry.names(registry.BASELINES)) from error
    return MethodSpec(registry.find(registry.BASELINES, method_of(folder, name)).name, str(folder), options)


def method_of(folder: Path, name: str) -> str:
    """Returns the method's name in the `config.json` of a model that the user called `name`."""
    method = read_json(folder / "config.json").get("method")
    if not isinstance(method, str):
        raise UserError(f"model {name}: its config.json names no grasping method, so it finds no grasps")
    return method


@lru_cache(maxsize=1)
def load_method(spec: MethodSpec) -> Method:
    """Imports and loads a method. The last one is kept, so a worker process loads its method once.

    Args:
        spec: the method, its folder and its options.

    Raises:
        UserError: the method cannot be loaded, has no default model, does not have one of the options, or refuses an
            option's value; or its code fails.
    """
    kind = registry.load(registry.BASELINES, spec.name)
    with blaming(spec.name, "from_pretrained"):
        parameters = list(signature(kind.from_pretrained).parameters.values())
        if not parameters:
            raise TypeError("it takes no folder")
    _check_options(spec, parameters[1:])
    if spec.folder is None and parameters[0].default is Parameter.empty:
        raise UserError(f"method {spec.name!r} needs a model: give the model's folder instead of the method's name")
    with blaming(spec.name, "from_pretrained"):
        method: Method = kind.from_pretrained(*([] if spec.folder is None else [spec.folder]), **spec.options)
    return method


def takes_option(spec: MethodSpec, name: str) -> bool:
    """Returns whether a method's `from_pretrained` has a keyword parameter of that name."""
    return name in signature(registry.load(registry.BASELINES, spec.name).from_pretrained).parameters


def _check_options(spec: MethodSpec, parameters: list[Parameter]) -> None:
    """Refuses an option that is not one of `from_pretrained`'s keyword parameters."""
    if any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters):
        return
    names = [one.name for one in parameters if one.kind in (Parameter.KEYWORD_ONLY, Parameter.POSITIONAL_OR_KEYWORD)]
    for name in spec.options:
        if name not in names:
            raise UserError(f"method {spec.name!r} has no option {name!r}: {choices_hint(name, names)}")


def blaming(name: str, step: str) -> AbstractContextManager[None]:
    """Turns an exception in a method's code into a UserError that names the method; see `registry.blaming`.

    Args:
        name: the method's registered name.
        step: the step that failed, e.g. `scene 3, attempt 0`.
    """
    return registry.blaming(registry.described(registry.BASELINES, name), step)


def method_search(method: Method) -> str | None:
    """Returns the name and hash of a method's search strategy; None for a method without one."""
    strategy = getattr(method, "strategy", None)
    return strategy.identity if isinstance(strategy, Strategy) else None


def method_hash(method: Method) -> str | None:
    """Returns 16 hexadecimal digits of the SHA-256 of a method's weights; None for a method without a model."""
    model = getattr(method, "model", None)
    return weights_hash(model)[:16] if isinstance(model, nn.Module) else None


def rendering_model(method: Method) -> GraspValue | None:
    """Returns a method's model if it can render the scene; else None."""
    model = getattr(method, "model", None)
    return model if isinstance(model, GraspValue) and model.config.renders else None
