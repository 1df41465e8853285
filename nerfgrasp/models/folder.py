"""Models as folders, the way the Hugging Face Hub keeps them: `config.json` and `model.safetensors`."""

import hashlib
import json
from dataclasses import asdict, fields, is_dataclass
from importlib.resources import files
from pathlib import Path
from textwrap import shorten
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_type_hints

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import nn

from nerfgrasp.errors import UserError, unknown_name
from nerfgrasp.files import make_folder, read_json, replacing, write_through
from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.models.mvnerf import MVNeRF
from nerfgrasp.models.stored import StoredModule

DEFAULT_MODEL = "mv3-laptop"
"""The shipped model that `nerfgrasp optimize` uses if no other is named."""

_CONFIG, _WEIGHTS = "config.json", "model.safetensors"

Config = TypeVar("Config")
Stored = TypeVar("Stored", bound=StoredModule)


def save_model(folder: Path, model: StoredModule, *, dtype: torch.dtype | None = None) -> None:
    """Writes a model folder; a model that is there already stays until all of the new one is on the disk.

    The config holds the weights file's SHA-256: where a process is killed as the two files take their places, what it
    leaves is refused by `load_stored`.

    Args:
        folder: made if it is not there.
        model: what to keep, backbone included.
        dtype: the weights' type in the file, e.g. `torch.float16`; as they are if None.

    Raises:
        UserError: the folder cannot be written.
    """
    header: dict[str, Any] = {"format": 1, "kind": model.kind}
    if model.method is not None:
        header["method"] = model.method
    config = {**header, "config": asdict(model.config)}
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    if dtype is not None:
        state = {name: tensor.to(dtype) if tensor.is_floating_point() else tensor for name, tensor in state.items()}
    weights = save(state)
    config["weights_sha256"] = hashlib.sha256(weights).hexdigest()
    make_folder(folder)
    with replacing(folder / _CONFIG) as config_file, replacing(folder / _WEIGHTS) as weights_file:
        write_through(config_file, (json.dumps(config, indent=2) + "\n").encode())
        write_through(weights_file, weights)


def load_model(name: str | Path) -> MVNeRF | GraspValue:
    """Reads a scene model or a grasp value; argument and errors as `load_stored`'s."""
    model = load_stored(name, GraspValue, MVNeRF)
    assert isinstance(model, GraspValue | MVNeRF)
    return model


def load_stored(name: str | Path, *modules: type[Stored]) -> Stored:
    """Reads a model of one of these classes, in evaluation mode, on the CPU, in float32.

    Args:
        name: a folder, a shipped model's name, or a Hugging Face repository id.
        modules: what it may be; a plug-in gives its own.

    Raises:
        UserError: there is no such model, it is of none of the classes, or a file of it is missing, truncated or of
            another shape, or they were not written together.
    """
    folder = find_model(str(name))
    config = read_json(folder / _CONFIG)
    plain, kinds = config.get("config"), {module.kind: module for module in modules}
    if config.get("kind") not in kinds or not isinstance(plain, dict):
        raise UserError(f"{folder / _CONFIG}: no model of a known kind ({', '.join(sorted(kinds))})")
    module = kinds[config["kind"]]
    try:
        model = module(from_plain(module.config_class, _without_pretrained(plain)))
    except (UserError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"{folder / _CONFIG}: {error}") from error
    _load_weights(model, folder / _WEIGHTS, config.get("weights_sha256"))
    return model.eval()


def load_backbone(name: str | Path) -> MVNeRF:
    """Reads an MVNeRF as `load_model` does; of a grasp value, the one that it stands on.

    Raises:
        UserError: there is no such model, it is damaged, or it never learned to render.
    """
    model = load_model(name)
    if isinstance(model, MVNeRF):
        return model
    if not model.config.renders:
        raise UserError(f"model {name} never learned to render: it was trained on grasps alone, without a backbone")
    return model.backbone


def find_model(name: str) -> Path:
    """Returns a model's folder: as it is, shipped with the package, or fetched from the Hugging Face Hub.

    Raises:
        UserError: there is none of that name.
    """
    if Path(name).is_dir():
        return Path(name)
    shipped = shipped_models()
    if name in shipped:
        return shipped[name]
    if name.count("/") != 1 or name.startswith((".", "/")):
        raise unknown_name("model (no folder, and none shipped by that name)", name, shipped)
    return _fetch(name)


def shipped_models() -> dict[str, Path]:
    """Returns the folders of the models that come with the package, by name."""
    folder = Path(str(files("nerfgrasp"))) / "assets" / "models"
    return {file.parent.name: file.parent for file in sorted(folder.glob(f"*/{_CONFIG}"))}


def weights_hash(model: nn.Module) -> str:
    """Returns the SHA-256 of a model's weights: names, shapes and values, in order."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def from_plain(config_class: type[Config], plain: dict[str, Any]) -> Config:
    """Builds a (nested) config dataclass from plain JSON data.

    Raises:
        ValueError: a key is unknown, or its value is of another type.
    """
    hints = get_type_hints(config_class)
    unknown = plain.keys() - {entry.name for entry in fields(config_class)}  # type: ignore[arg-type]
    if unknown:
        raise ValueError(f"unknown key {sorted(unknown)[0]!r} in {config_class.__name__}")
    values = {key: _typed(f"{config_class.__name__}.{key}", hints[key], value) for key, value in plain.items()}
    return config_class(**values)


def _typed(name: str, hint: Any, value: Any) -> Any:
    choices = [one for one in get_args(hint) if one is not NoneType] if isinstance(hint, UnionType) else []
    if value is not None and len(choices) == 1:  # optional
        return _typed(name, choices[0], value)
    if isinstance(hint, type) and is_dataclass(hint) and isinstance(value, dict):
        return from_plain(hint, value)
    if hint is float and type(value) is int:
        return float(value)
    # A bool is an int to `isinstance`, but not to us.
    if isinstance(hint, type) and type(value) is not hint:
        raise ValueError(f"{name} is {value!r}, not of type {hint.__name__}")
    return tuple(value) if isinstance(value, list) else value


def _without_pretrained(plain: dict[str, Any]) -> dict[str, Any]:
    """The weights come from the folder: none are to be fetched for the encoder."""
    copy = dict(plain)
    for key in ("backbone", "encoder"):
        if isinstance(copy.get(key), dict):
            copy[key] = _without_pretrained(copy[key])
    return {**copy, "pretrained": False} if "pretrained" in copy else copy


def _load_weights(model: nn.Module, path: Path, sha256: str | None) -> None:
    """Loads a file; its hash is compared if there is one to compare it with."""
    try:
        state = load_file(path)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path} is damaged or truncated: {error}") from error
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        reason = str(error).splitlines()[1].strip() if "\n" in str(error) else str(error)
        raise UserError(f"{path} does not fit {_CONFIG}: {shorten(reason, 160)}") from error
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if sha256 not in (None, found):
        raise UserError(f"{path} is not the file that {_CONFIG} was written with: write the model again")


def _fetch(repository: str) -> Path:
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(repository, allow_patterns=[_CONFIG, _WEIGHTS]))
    except Exception as error:  # the hub's client raises many kinds; to the user they are one
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        hub = "it cannot be fetched from the Hugging Face Hub"
        raise UserError(f"no folder {repository!r}, and {hub}: {reason}") from error
