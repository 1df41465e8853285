"""Training configs by name: files, or those shipped with the package."""

from collections.abc import Sequence
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from nerfgrasp.errors import UserError, unknown_name


def shipped_configs(args: list[str]) -> list[str]:
    """Returns the arguments with each `--config NAME` that is no file here replaced by the shipped one's path.

    Raises:
        UserError: there is no such file, neither here nor among those shipped.
    """
    return [_with_config_found(before, argument) for before, argument in pairwise(["", *args])]


def find_config(name: str | Path, here: Path = Path()) -> Path:
    """Returns the path of a config: a file, seen from `here`, or else the shipped one of that name.

    Raises:
        UserError: there is neither.
    """
    if (here / name).is_file():
        return here / name
    package = Path(str(files("nerfgrasp")))
    folder = next(f for f in (package / "configs", package.parent / "configs") if f.is_dir())
    if not Path(name).is_absolute() and (folder / name).is_file():
        return folder / name
    raise unknown_name("config", str(name), (str(path.relative_to(folder)) for path in folder.rglob("*.yaml")))


def read_configs(names: Sequence[str | Path], here: Path = Path()) -> dict[str, Any]:
    """Reads configs, each laid over the one before, as `nerfgrasp fit` does.

    Raises:
        UserError: there is no such config, or it is no YAML.
    """
    merged: dict[str, Any] = {}
    for name in names:
        path = find_config(name, here)
        try:
            merged = laid_over(merged, yaml.safe_load(path.read_text(encoding="utf-8")) or {})
        except yaml.YAMLError as error:
            raise UserError(f"{path} is not valid YAML: {error}") from error
    return merged


def laid_over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Returns one nested mapping with another's entries put over it.

    Example:
        >>> laid_over({"a": {"b": 1, "c": 2}}, {"a": {"c": 3}})
        {'a': {'b': 1, 'c': 3}}
    """
    merged = dict(below)
    for key, value in above.items():
        under = merged.get(key)
        merged[key] = laid_over(under, value) if isinstance(value, dict) and isinstance(under, dict) else value
    return merged


def _with_config_found(before: str, argument: str) -> str:
    if before in ("--config", "-c"):
        return str(find_config(argument))
    if argument.startswith("--config="):
        return f"--config={find_config(argument.removeprefix('--config='))}"
    return argument
