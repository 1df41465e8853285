"""How fast a training step, a rendering and the encoder are: beside a plain reference and the machine's own peak.

    python benchmarks/training.py --configs '[mv3.yaml, laptop/mv3.yaml]'

Steps are of random images from cameras about the workspace, as many and as large as the configs say, drawn beforehand.
FLOPs are counted by torch on the plain mathematics, forward and backward, and are held against the rate of large matrix
products in the same run. Fast and plain steps alternate, because machines are noisy.
"""

import math
import resource
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import plain_mvnerf
import torch
from jsonargparse import auto_cli
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode
from tqdm import trange

from configs import network_config
from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.commands.configs import read_configs
from nerfgrasp.geometry import Camera, look_at, pixel_centres, pixel_rays
from nerfgrasp.models import MVNeRF, MVNeRFConfig, render_image
from nerfgrasp.models.mvnerf import RayRenderings
from nerfgrasp.scenes.scene import Workspace

MATRIX = {torch.float32: 2048, torch.bfloat16: 1024}
"""Sides of the matrices whose products tell the machine's peak; bfloat16 is emulated, and slow, on some processors."""
DISTANCE = 0.8
"""Metres of the cameras from the workspace."""

Rays = tuple[Tensor, Tensor, Workspace]


class Settings(NamedTuple):
    """What a config says of a step."""

    network: MVNeRFConfig
    scenes: int
    rays: int
    size: int


class Batch(NamedTuple):
    """A step's data."""

    images: Tensor
    camera: Camera
    origins: Tensor
    directions: Tensor
    colours: Tensor

    def rays(self) -> Rays:
        """Returns what is to be rendered."""
        return self.origins, self.directions, Workspace().to(self.origins.device)


def main(
    configs: list[Path], steps: int = 10, device: str = "cpu", bfloat16: bool = False, memory_steps: int = 0
) -> None:
    """Prints the table.

    Args:
        configs: laid over each other as `nerfgrasp fit` does; files, or names of the project's own.
        steps: fast and plain training steps that are timed.
        device: `cpu`, `cuda` or `mps`.
        bfloat16: whether the steps run in mixed precision.
        memory_steps: so many fast steps more, to see whether memory grows; 0 for none.
    """
    keep_freed_memory()
    settings = read_settings(configs)
    torch.manual_seed(0)
    model, batch = MVNeRF(settings.network).to(device), random_batch(settings, device)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-5)

    def step(render: Callable[[], RayRenderings]) -> None:
        with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=bfloat16):
            loss = loss_of(render(), batch.colours)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def fast() -> RayRenderings:
        features = model.observe(batch.images, batch.camera, batch.rays()[2])
        return model.render(features, *batch.rays())

    def plain() -> RayRenderings:
        return plain_mvnerf.render(model, batch.images, batch.camera, *batch.rays())

    flops, fast_flops = (flops_of(partial(step, render)) for render in (plain, fast))
    fast_s, plain_s = alternate(lambda: step(fast), lambda: step(plain), steps, device)
    peaks = {dtype: matrix_rate(dtype, device) for dtype in MATRIX}
    count = settings.scenes * settings.rays
    print(f"device                   {device}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    for dtype, peak in peaks.items():
        print(f"peak {str(dtype).removeprefix('torch.'):<19} {peak / 1e9:10.1f} GFLOP/s, products of {MATRIX[dtype]}²")
    print(
        f"a step                   {flops / 1e9:10.2f} GFLOP plainly, {fast_flops / 1e9:.2f} fast, "
        f"on {count} rays of {settings.scenes} scenes"
    )
    for name, seconds in (("fast", fast_s), ("plain", plain_s)):
        shares = ", ".join(
            f"{flops / seconds / peak:.2f} of {str(d).removeprefix('torch.')}" for d, peak in peaks.items()
        )
        print(f"{name + ' step':<24} {seconds:10.3f} s, {count / seconds:8.1f} rays/s, {shares}")
    print(f"fast against plain       {plain_s / fast_s:10.2f} times the rays/s")
    print_inference(model, batch, settings, device)
    print(f"peak memory              {peak_memory(device) / 1e6:10.0f} MB")
    if memory_steps:
        print_growth(lambda: step(fast), memory_steps, device)


def read_settings(configs: list[Path]) -> Settings:
    """Returns what configs say of the network and of a batch."""
    merged = read_configs(configs)
    data = merged["data"]["init_args"]
    size = data["train"]["size"]
    return Settings(network_config(merged), data.get("scenes_per_step", 1), data.get("rays_per_scene", 512), size)


def random_batch(settings: Settings, device: str) -> Batch:
    """Draws images and rays through random pixels of further views."""
    scenes, size = settings.scenes, settings.size
    inputs = _cameras(scenes, settings.network.views, size)
    rays = [pixel_rays(camera, size * torch.rand(settings.rays, 2)) for camera in _cameras(scenes, 1, size)[:, 0]]
    origins, directions = (torch.stack(parts).to(device) for parts in zip(*rays, strict=True))
    images = torch.rand(scenes, settings.network.views, 3, size, size)
    return Batch(images.to(device), inputs.to(device), origins, directions, torch.rand_like(origins))


def _cameras(scenes: int, views: int, size: int) -> Camera:
    azimuth = 2 * math.pi * torch.rand(scenes, views)
    polar = torch.deg2rad(30 + 30 * torch.rand(scenes, views))
    around = torch.stack([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()], dim=-1)
    focal = 120 / 128 * size
    intrinsics = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(intrinsics.expand(scenes, views, 3, 3), look_at(DISTANCE * around, torch.zeros(3)), size, size)


def loss_of(rendered: RayRenderings, colours: Tensor) -> Tensor:
    """Returns the training's loss."""
    parts = (rendered.coarse.colour, rendered.fine.colour)
    return sum(((part.float() - colours).square().mean() for part in parts), torch.zeros((), device=colours.device))


def flops_of(do: Callable[[], None]) -> int:
    """Returns how many FLOPs torch counts in matrix products and convolutions, forward and backward."""
    with FlopCounterMode(display=False) as counter:
        do()
    return counter.get_total_flops()


def alternate(one: Callable[[], None], other: Callable[[], None], times: int, device: str) -> tuple[float, float]:
    """Returns the median seconds of two things done by turns, after one turn that does not count."""
    spent: tuple[list[float], list[float]] = ([], [])
    for _ in range(times + 1):
        for do, seconds in zip((one, other), spent, strict=True):
            seconds.append(timed(do, device))
    return statistics.median(spent[0][1:]), statistics.median(spent[1][1:])


def timed(do: Callable[[], object], device: str) -> float:
    """Returns how many seconds something takes."""
    start = time.perf_counter()
    do()
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def matrix_rate(dtype: torch.dtype, device: str) -> float:
    """Returns the best rate of matrix products, in FLOP/s."""
    side = MATRIX[dtype]
    a = torch.rand(side, side, device=device).to(dtype)
    seconds = min(timed(lambda: a @ a, device) for _ in range(6))
    return 2 * side**3 / seconds


@torch.inference_mode()
def print_inference(model: MVNeRF, batch: Batch, settings: Settings, device: str) -> None:
    """Prints how long one scene's images take to encode and one image to render."""
    model.eval()
    workspace = batch.rays()[2]
    images, camera = batch.images[:1], batch.camera[:1]
    encode = min(timed(lambda: model.observe(images, camera, workspace), device) for _ in range(3))
    features = model.observe(images, camera, workspace)
    target = _cameras(1, 1, settings.size).to(device)[0, 0]
    render = min(timed(lambda: render_image(model, features, target, workspace), device) for _ in range(2))
    rays = len(pixel_centres(target.width, target.height).flatten(0, 1))
    print(f"encoding {images.shape[1]} images        {encode:10.3f} s")
    print(f"rendering one image      {render:10.3f} s at {settings.size}², {rays} pixels")
    model.train()


def print_growth(step: Callable[[], None], steps: int, device: str) -> None:
    """Prints the peak memory after a tenth of the steps and after all."""
    for number in trange(steps, desc="memory"):
        if number == steps // 10:
            early = peak_memory(device)
        step()
    late = peak_memory(device)
    print(
        f"peak memory              {early / 1e6:10.0f} MB after {steps // 10} steps, {late / 1e6:.0f} MB after {steps}"
    )


def peak_memory(device: str) -> float:
    """Returns the most memory held so far, in bytes."""
    if device == "cuda":
        return torch.cuda.max_memory_allocated()
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
