"""Image features: a vision transformer for the whole image, a convolution branch for the detail."""

import pickle
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from torch import Tensor, nn
from torch.nn.functional import interpolate

from nerfgrasp.errors import UserError, unknown_name


@dataclass(frozen=True)
class EncoderConfig:
    """The encoder's shape. The defaults are the paper's (its supplementary diagrams)."""

    vit: str = "vit_base_patch16_224"
    """Any vision transformer that timm knows by name."""
    pretrained: bool | str = True
    """True: timm's weights from the hub; a path: weights from that file; False: a random start."""
    vit_size: int = 224
    """Side in pixels to which the transformer's input is resized; a multiple of its patch size."""
    vit_options: dict[str, Any] = field(default_factory=dict)
    """Further arguments of the timm model, e.g. `depth`."""
    taps: tuple[int, ...] = (2, 5, 8, 11)
    """The four blocks (from 0) whose outputs are tapped, shallow to deep."""
    tap_channels: int = 256
    """Channels of each tap on its own grid."""
    vit_channels: int = 128
    """Channels that the transformer branch gives."""
    stem_channels: int = 64
    """Channels of the convolution branch's first layer."""
    conv_channels: int = 128
    """Channels that the convolution branch gives."""
    conv_blocks: int = 3
    """Residual blocks of the convolution branch."""
    conv_size: int | None = None
    """Side in pixels to which the convolution branch's input is resized; None leaves it as it is."""
    upsample: bool = True
    """Whether the features, made at half the image's resolution, are upsampled to the whole."""


class Encoder(nn.Module):
    """Maps images `[N, 3, H, W]` in [0, 1] to features `[N, C, h, w]`, h = H or H / 2.

    Source: VisionNeRF (Lin et al. 2023) as the paper's supplement draws it.

    Raises:
        UserError: the transformer's name is unknown to timm, it has no such options or blocks, or its weights
            cannot be had.
    """

    statistics: Tensor

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.vit = _create_vit(config)
        _check_taps(config.taps, len(self.vit.blocks))
        self.taps = nn.ModuleList(_tap(self.vit.embed_dim, config.tap_channels, level) for level in range(4))
        self.merge = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(4 * config.tap_channels, config.tap_channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(config.tap_channels, config.vit_channels, 3, padding=1),
        )
        widths = [config.stem_channels] + [config.conv_channels] * config.conv_blocks
        self.conv = nn.Sequential(
            nn.Conv2d(3, config.stem_channels, 7, stride=2, padding=3),
            _norm(config.stem_channels),
            nn.ReLU(),
            *(ResidualConv(a, b) for a, b in pairwise(widths)),
        )
        statistics = torch.tensor([self.vit.default_cfg[key] for key in ("mean", "std")])
        self.register_buffer("statistics", statistics.view(2, 3, 1, 1), persistent=False)

    @property
    def channels(self) -> int:
        """The number C of feature channels."""
        return self.config.vit_channels + self.config.conv_channels

    def map_size(self, height: int, width: int) -> tuple[int, int]:
        """Returns the features' h and w for images of a size."""
        if self.config.upsample:
            return height, width
        high, wide = (self.config.conv_size,) * 2 if self.config.conv_size is not None else (height, width)
        return (high + 1) // 2, (wide + 1) // 2

    def forward(self, images: Tensor) -> Tensor:
        """See the class."""
        normalised = (images - self.statistics[0]) / self.statistics[1]
        local = self.conv(_resize(normalised, self.config.conv_size))
        context = interpolate(self._context(normalised), size=local.shape[-2:], mode="bilinear", align_corners=False)
        features = torch.cat([context, local], dim=1)
        if self.config.upsample:
            features = interpolate(features, size=images.shape[-2:], mode="bilinear", align_corners=False)
        return features

    def _context(self, images: Tensor) -> Tensor:
        images = _resize(images, self.config.vit_size)
        maps = self.vit.forward_intermediates(images, indices=list(self.config.taps), intermediates_only=True)
        levels = [tap(level) for tap, level in zip(self.taps, maps, strict=True)]
        size = levels[0].shape[-2:]
        levels = [interpolate(level, size=size, mode="bilinear", align_corners=False) for level in levels]
        return self.merge(torch.cat(levels, dim=1))


class ResidualConv(nn.Module):
    """Two 3×3 convolutions with group norm and a skip (1×1 where the width changes)."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels_in, channels_out, 3, padding=1),
            _norm(channels_out),
            nn.ReLU(),
            nn.Conv2d(channels_out, channels_out, 3, padding=1),
            _norm(channels_out),
        )
        self.skip = nn.Identity() if channels_in == channels_out else nn.Conv2d(channels_in, channels_out, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Maps `[N, C_in, h, w]` to `[N, C_out, h, w]`."""
        return torch.relu(self.skip(x) + self.body(x))


def _resize(images: Tensor, side: int | None) -> Tensor:
    if side is None or images.shape[-2:] == (side, side):
        return images
    return interpolate(images, size=(side, side), mode="bilinear", align_corners=False, antialias=True)


def _norm(channels: int) -> nn.Module:
    # Group norm: batch statistics are noise at the few images a step that a scene gives.
    return nn.GroupNorm(max(1, channels // 16), channels)


def _tap(channels_in: int, channels: int, level: int) -> nn.Module:
    """A tap's way to its own grid, from 4 times the patch grid (level 0) to half of it (level 3)."""
    resize = [
        nn.ConvTranspose2d(channels, channels, 4, stride=4),
        nn.ConvTranspose2d(channels, channels, 2, stride=2),
        nn.Identity(),
        nn.Conv2d(channels, channels, 3, stride=2, padding=1),
    ][level]
    return nn.Sequential(nn.Conv2d(channels_in, channels, 1), resize, nn.Conv2d(channels, channels, 3, padding=1))


def _check_taps(taps: tuple[int, ...], depth: int) -> None:
    if len(taps) != 4 or not all(0 <= tap < depth for tap in taps) or sorted(set(taps)) != list(taps):
        given = list(taps)
        raise UserError(f"encoder.taps: {given}: they must be four blocks, from 0 to {depth - 1}, in ascending order")


def _create_vit(config: EncoderConfig) -> Any:
    import timm  # imported late: it takes seconds, and a config alone does not need it

    options: dict[str, Any] = {"img_size": config.vit_size, "num_classes": 0, "global_pool": "", **config.vit_options}
    if isinstance(config.pretrained, str):
        if not Path(config.pretrained).is_file():
            raise UserError(f"encoder.pretrained: no such file: {config.pretrained}")
        options["pretrained_cfg_overlay"] = {"file": config.pretrained}
    if not timm.is_model(config.vit):
        near = get_close_matches(config.vit, timm.list_models("vit_*"), n=5)
        raise unknown_name("timm model", config.vit, near or ["vit_tiny_patch16_224", "vit_base_patch16_224"])
    try:
        vit = timm.create_model(config.vit, pretrained=bool(config.pretrained), **options)
    except TypeError as error:
        raise UserError(f"encoder.vit_options: {config.vit}: {error}") from error
    except (OSError, RuntimeError, EOFError, KeyError, pickle.UnpicklingError, SafetensorError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise UserError(
            f"encoder.pretrained: cannot load weights for {config.vit} ({reason}); give a local file, or false "
            "for a random start"
        ) from error
    for unused in ("norm", "fc_norm", "head"):
        # The taps are taken before the final norm: parameters without a gradient would confuse optimizers.
        if hasattr(vit, unused):
            setattr(vit, unused, nn.Identity())
    return vit
