"""The attention network: a fully convolutional residual network without normalisation, one logit a cell.

Source: Zeng et al. 2020, "Transporter Networks", sections 3.1 and 4: 43 layers, no batch norm.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pixel_shuffle, pixel_unshuffle, relu

from nerfgrasp.models.stored import StoredModule
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp_baselines.transporter.canvases import canvas_side, cut, turned, upright
from nerfgrasp_baselines.transporter.heights import map_shape

CHANNELS = 4
"""RGB and height."""
TYPICAL_HEIGHT = 0.05
"""Metres that the network sees as 1."""


@dataclass(frozen=True)
class TransporterConfig:
    """The network's shape and what it looks at. The defaults are the paper's scale: 43 layers and a readout."""

    widths: tuple[int, ...] = (64, 128, 256, 512)
    """Channels of the stages on the way down, each at half the resolution of the one before; back up without the
    last."""
    blocks: int = 2
    """Residual blocks a stage, of three convolutions each."""
    fold: int = 1
    """Cells a side that are folded into channels before the first layer, and unfolded after the last."""
    skips: bool = False
    """Whether a stage on the way up adds what the one of its resolution on the way down made."""
    rotations: int = 18
    """Canvases over a half turn."""
    pixel: float = 0.003125
    """Side of a cell in metres."""
    views: int = 3
    """Images that are fused, from the front."""


class Block(nn.Module):
    """relu(x + f(x)), f of three convolutions: 1×1, 3×3, 1×1."""

    def __init__(self, width_in: int, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width_in, width, 1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        self.third = nn.Conv2d(width, width, 1)
        self.skip = nn.Identity() if width_in == width else nn.Conv2d(width_in, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Maps `[N, width_in, H, W]` to `[N, width, H, W]`."""
        return relu(self.skip(x) + self.third(relu(self.second(relu(self.first(x))))))


class Attention(StoredModule):
    """Logits of grasps over the cells of canvases."""

    kind = "transporter"
    config_class = TransporterConfig
    method = "transporter"
    config: TransporterConfig

    def __init__(self, config: TransporterConfig) -> None:
        super().__init__()
        self.config = config
        widths, folded = config.widths, config.fold**2
        self.stem = nn.Conv2d(CHANNELS * folded, widths[0], 3, padding=1)
        before = (widths[0], *widths[:-1])
        self.down = nn.ModuleList(_stage(a, b, config.blocks) for a, b in zip(before, widths, strict=True))
        self.up = nn.ModuleList(_stage(a, b, config.blocks) for a, b in pairwise(widths[::-1]))
        self.readout = nn.Conv2d(widths[0], folded, 1)
        self.apply(_start)

    @property
    def multiple(self) -> int:
        """What a canvas's side is a multiple of."""
        return int(self.config.fold * 2 ** (len(self.config.widths) - 1))

    def forward(self, canvases: Tensor) -> Tensor:
        """Maps canvases `[N, 4, S, S]` to logits `[N, S, S]`, each canvas by itself."""
        scaled = torch.cat([2 * canvases[:, :3] - 1, canvases[:, 3:] / TYPICAL_HEIGHT], dim=1)
        x = relu(self.stem(pixel_unshuffle(scaled, self.config.fold)))
        passed: list[Tensor] = []
        for stage in self.down:
            x = stage(nn.functional.avg_pool2d(passed[-1], 2) if passed else x)
            passed.append(x)
        for stage, beside in zip(self.up, passed[-2::-1], strict=True):
            x = interpolate(stage(x), scale_factor=2.0, mode="bilinear", align_corners=False)
            x = x + beside if self.config.skips else x
        return pixel_shuffle(self.readout(x), self.config.fold)[:, 0]

    def look(self, maps: Tensor, workspace: Workspace, T_world_canvas: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Looks at one map from every angle.

        Args:
            maps: `[4, H, W]`.
            workspace: what it shows.
            T_world_canvas: the first canvas, `[3, 3]`; over the workspace's middle if not given.

        Returns:
            Logits `[K, S, S]`, minus infinity outside of the workspace, and the canvases `[K, 3, 3]`.
        """
        pixel = self.config.pixel
        first = upright(workspace) if T_world_canvas is None else T_world_canvas
        canvases = turned(first, self.config.rotations)
        side = canvas_side(map_shape(workspace, pixel), self.multiple)
        pictures, inside = cut(maps, workspace, canvases, side, pixel)
        return self(pictures).masked_fill(~inside, -torch.inf), canvases


def _start(module: nn.Module) -> None:
    """Keeps the scale of activations through the layers: without normalisation nothing else does."""
    if isinstance(module, nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    if isinstance(module, Block):
        # A block starts as its skip.
        nn.init.zeros_(module.third.weight)


def _stage(width_in: int, width: int, blocks: int) -> nn.Sequential:
    return nn.Sequential(*(Block(width_in if number == 0 else width, width) for number in range(blocks)))
