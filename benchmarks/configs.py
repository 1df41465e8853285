"""Training configs as the benchmarks read them: without a trainer, and without what it would need."""

from typing import Any

from nerfgrasp.models import MVNeRFConfig
from nerfgrasp.models.folder import from_plain


def network_config(config: dict[str, Any]) -> MVNeRFConfig:
    """Returns the network that a config describes, its encoder without pretrained weights."""
    network = config.get("model", {}).get("init_args", {}).get("network", {})
    encoder = {**network.get("encoder", {}), "pretrained": False}
    return from_plain(MVNeRFConfig, {**network, "encoder": encoder})
