"""The radiance field: points seen by several views, fused, mapped to colour and density.

x, q, features of V views  →  per-view trunk  →  mean over views  →  fused trunk  →  RGB, σ
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag, grid_sample, linear, relu, softplus

from nerfgrasp.geometry import Camera, exact, project, transform
from nerfgrasp.geometry.frames import invert


@dataclass(frozen=True)
class FieldConfig:
    """A field's shape. The defaults are the paper's (its supplementary diagrams)."""

    width: int = 128
    """Width of every layer."""
    view_blocks: int = 3
    """Residual blocks for each view by itself, weights shared."""
    fused_blocks: int = 3
    """Residual blocks after the views are fused."""
    position_frequencies: int = 10
    """Frequencies π·2ᵏ that encode a point in the camera's frame."""
    direction_frequencies: int = 10
    """Frequencies that encode the view direction in the camera's frame."""
    pool_variance: bool = False
    """Whether the variance over views is pooled beside the mean: views agree on surfaces, not in the air."""
    blend: int = 0
    """Channels of an attention that blends the colours that the views see at a point into the point's own; 0 for none,
    as in the paper. Views that do not see the point are to be told from those that do."""
    height_frequencies: int = 0
    """Frequencies that encode a point's height above the table, the workspace's lower face; 0 for none, as in the
    paper. One view alone shows where the table is only roughly, and objects stand on it."""


@dataclass(frozen=True)
class ViewMaps:
    """What a field reads from the views of B scenes."""

    features: Tensor
    """`[B, V, h, w, width]`: the encoder's features after the field's own feature layer."""
    images: Tensor
    """`[B, V, 3, H, W]`, RGB in [0, 1]."""
    camera: Camera
    """Batch shape `[B, V]`."""
    table: Tensor
    """`[B]`: the table's height in the world frame, metres."""


class Field(nn.Module):
    """Θ(x, q, o): a point and a view direction to colour, density and scene activations.

    The paper's first layer takes [encoded x, encoded q, RGB, image feature]. A linear layer commutes with
    bilinear interpolation, so its feature part is applied to the whole map once (`project_features`), and its
    direction part once a ray; the sum is the same.

    Source: the paper, section III-A, and its supplementary diagrams.
    """

    def __init__(self, config: FieldConfig, feature_channels: int) -> None:
        super().__init__()
        self.config = config
        width = config.width
        self.feature_layer = nn.Conv2d(feature_channels, width, 1, bias=False)
        self.direction_layer = nn.Linear(6 * config.direction_frequencies, width, bias=False)
        self.point_layer = nn.Linear(6 * config.position_frequencies + 3, width)
        heights = config.height_frequencies
        self.height_layer = nn.Linear(2 * heights, width, bias=False) if heights else None
        self.view_trunk = nn.ModuleList(ResidualBlock(width) for _ in range(config.view_blocks))
        self.pool_layer = nn.Linear(2 * width, width) if config.pool_variance else nn.Identity()
        self.fused_trunk = nn.ModuleList(ResidualBlock(width) for _ in range(config.fused_blocks))
        self.blend = ViewAttention(width, config.blend) if config.blend else None
        self.readout = nn.Linear(width, 5 if config.blend else 4)

    @property
    def activation_count(self) -> int:
        """How many scene activations a point has: the pooled one and each fused block's."""
        return 1 + self.config.fused_blocks

    def project_features(self, features: Tensor) -> Tensor:
        """Applies the feature part of the first layer: `[N, C, h, w]` to `[N, h, w, width]`."""
        return linear(features.movedim(1, -1), self.feature_layer.weight.flatten(1))

    def activations(self, maps: ViewMaps, points: Tensor, directions: Tensor) -> list[Tensor]:
        """Returns the scene activations, first the pooled one, each `[B, R, S, width]`.

        Args:
            maps: the views of B scenes.
            points: `[B, R, S, 3]` in metres, world frame: S samples on each of R rays.
            directions: `[B, R, 3]`, unit: one a ray.
        """
        return self._fused(self._view_activations(maps, points, directions)[0])

    def forward(self, maps: ViewMaps, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Returns RGB `[B, R, S, 3]` in [0, 1] and density `[B, R, S]` in 1/m."""
        views, seen = self._view_activations(maps, points, directions)
        fused = self._fused(views)[-1]
        raw = self.readout(relu(fused))
        colour = torch.sigmoid(raw[..., :3])
        if self.blend is not None:
            blended = (self.blend(views, fused) * seen).sum(dim=1)
            colour = colour + torch.sigmoid(raw[..., 4:]) * (blended - colour)
        # The network speaks of densities per centimetre: a surface's is then of order one.
        return colour, 100.0 * softplus(raw[..., 3] - 2.0)

    def _fused(self, views: Tensor) -> list[Tensor]:
        outputs = [self._pool(views)]
        for block in self.fused_trunk:
            outputs.append(block(outputs[-1]))
        return outputs

    def _view_activations(self, maps: ViewMaps, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Each view's activation of each point, `[B, V, R, S, width]`, and the colour it sees there."""
        batch, rays, samples, _ = points.shape
        views = maps.images.shape[1]
        flat = points.reshape(batch, 1, rays * samples, 3)
        in_camera, turned, grid = _as_seen(flat, directions, maps.camera)
        grid = grid.flatten(0, 1)
        colours = sample_maps(maps.images.flatten(0, 1).movedim(1, -1), grid)
        features = sample_maps(maps.features.flatten(0, 1), grid)
        encoded = encode(in_camera.flatten(0, 1), self.config.position_frequencies)
        point_part = self.point_layer(torch.cat([encoded, colours], dim=-1)) + features
        direction_part = self.direction_layer(encode(turned, self.config.direction_frequencies))
        x = point_part.view(batch, views, rays, samples, -1) + direction_part[..., None, :]
        if self.height_layer is not None:
            height = points[..., 2:] - maps.table[:, None, None, None]
            x = x + self.height_layer(encode(height, self.config.height_frequencies))[:, None]
        for block in self.view_trunk:
            x = block(x)
        return x, colours.view(batch, views, rays, samples, 3)

    def _pool(self, x: Tensor) -> Tensor:
        mean = x.mean(dim=1)
        if not self.config.pool_variance:
            return mean
        variance = (x - mean[:, None]).square().mean(dim=1)
        return self.pool_layer(torch.cat([mean, variance], dim=-1))


class ViewAttention(nn.Module):
    """Weights of V views at each point: a softmax over views of the products of keys and a query."""

    def __init__(self, width: int, channels: int) -> None:
        super().__init__()
        self.key = nn.Linear(width, channels, bias=False)
        self.query = nn.Linear(width, channels)

    def forward(self, views: Tensor, fused: Tensor) -> Tensor:
        """Returns weights `[B, V, ..., 1]` from the views' activations `[B, V, ..., width]` and the fused one."""
        keys, query = self.key(relu(views)), self.query(relu(fused))
        products = (keys * query[:, None]).sum(dim=-1, keepdim=True)
        return torch.softmax(products / math.sqrt(keys.shape[-1]), dim=1)


class ResidualBlock(nn.Module):
    """x + W₂ relu(W₁ relu(x)), of one width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Linear(width, width)
        self.second = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Maps `[..., width]` to `[..., width]`."""
        return x + self.second(relu(self.first(relu(x))))


@exact
def _as_seen(points: Tensor, directions: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Returns points and directions in cameras' frames, and where the points lie on the images.

    Args:
        points: `[B, 1, P, 3]` in metres, world frame.
        directions: `[B, R, 3]`.
        camera: batch shape `[B, V]`.

    Returns:
        Points `[B, V, P, 3]`, directions `[B, V, R, 3]`, and `[B, V, P, 2]`, x and y in [-1, 1] from border to border;
        what lies far beyond is brought nearer.
    """
    T_camera_world = invert(camera.T_world_camera)
    in_camera = transform(T_camera_world, points)
    turned = directions[:, None] @ T_camera_world[..., :3, :3].transpose(-1, -2)
    pixels, _ = project(camera, points)
    size = torch.tensor([camera.width, camera.height], device=points.device)
    return in_camera, turned, (2.0 * pixels / size - 1.0).clamp(-2.0, 2.0)


def encode(x: Tensor, frequencies: int) -> Tensor:
    """Positional encoding: sin(π 2ᵏ x), cos(π 2ᵏ x) for k < `frequencies`; `[..., D]` to `[..., 2·D·frequencies]`.

    Source: Mildenhall et al. 2020, equation 4, with the factor π.
    """
    scales = math.pi * 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)
    angles = (x[..., None, :] * scales[:, None]).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def sample_maps(maps: Tensor, grid: Tensor) -> Tensor:
    """Bilinear samples of maps, which repeat their borders; as `grid_sample(align_corners=False)` gives them.

    On the CPU a sum of rows of the map, where channels lie together, is several times faster, above all backward. On
    MPS `grid_sample` repeats no borders in all versions of PyTorch.

    Args:
        maps: `[N, h, w, C]`.
        grid: `[N, P, 2]`, x and y in [-1, 1] from border to border.

    Returns:
        `[N, P, C]`.
    """
    if maps.device.type == "cuda":
        sampled = grid_sample(maps.movedim(-1, 1), grid[:, None], padding_mode="border", align_corners=False)
        return sampled[:, :, 0].transpose(1, 2)
    count, height, width, channels = maps.shape
    size = torch.tensor([width, height], dtype=grid.dtype, device=grid.device)
    position = torch.minimum((0.5 * (grid + 1.0) * size - 0.5).clamp(min=0.0), size - 1.0)
    low = torch.minimum(position.detach().floor(), size - 2.0)
    x, y = (position - low).unbind(dim=-1)
    # A position that is no number has some row's index and no number for its share: what comes out is none either.
    column, row = low.nan_to_num().long().unbind(dim=-1)
    first = (torch.arange(count, device=grid.device)[:, None] * height + row) * width + column
    corners = first[..., None] + torch.tensor([0, 1, width, width + 1], device=grid.device)
    shares = torch.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], dim=-1)
    rows = maps.reshape(-1, channels)
    weigh = _weighted_rows if maps.device.type == "cpu" else _gathered_rows
    return weigh(rows, corners.view(-1, 4), shares.view(-1, 4).to(rows)).view(*grid.shape[:2], channels)


def _weighted_rows(rows: Tensor, chosen: Tensor, weights: Tensor) -> Tensor:
    """Returns the sums `[P, C]` of rows `[N, C]`, the chosen ones `[P, 4]` by their weights `[P, 4]`."""
    return embedding_bag(chosen, rows, per_sample_weights=weights, mode="sum")


def _gathered_rows(rows: Tensor, chosen: Tensor, weights: Tensor) -> Tensor:
    """Does what `_weighted_rows` does, by operations that every device has."""
    return (rows[chosen] * weights[..., None]).sum(dim=1)
