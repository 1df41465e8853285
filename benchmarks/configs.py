"""Training configs as the benchmarks read them: without a trainer, and without what it would need."""

from pathlib import Path
from typing import Any

import yaml

from nerfgrasp.models import MVNeRFConfig
from nerfgrasp.models.folder import from_plain

CONFIGS = Path(__file__).resolve().parent.parent / "configs"


def read_configs(paths: list[Path]) -> dict[str, Any]:
    """Reads configs, each laid over the one before; files, or names of the project's own."""
    merged: dict[str, Any] = {}
    for path in paths:
        found = path if path.is_file() else CONFIGS / path
        merged = laid_over(merged, yaml.safe_load(found.read_text()))
    return merged


def network_config(config: dict[str, Any]) -> MVNeRFConfig:
    """Returns the network that a config describes, its encoder without pretrained weights."""
    network = config.get("model", {}).get("init_args", {}).get("network", {})
    encoder = {**network.get("encoder", {}), "pretrained": False}
    return from_plain(MVNeRFConfig, {**network, "encoder": encoder})


def laid_over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Returns one nested mapping with another's entries put over it."""
    merged = dict(below)
    for key, value in above.items():
        under = merged.get(key)
        merged[key] = laid_over(under, value) if isinstance(value, dict) and isinstance(under, dict) else value
    return merged
