"""What every test may ask for."""

import os
import subprocess
import sys

# Before torch is imported here and in every process that a test starts: small tensors gain nothing by a second thread,
# and on a busy machine two threads wait for each other most of the time.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Nothing is fetched in a test, and nothing may quietly be.
os.environ.setdefault("HF_HUB_OFFLINE", "1")
# No window and no warning about one.
os.environ.setdefault("MPLBACKEND", "Agg")

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfgrasp.geometry import (
    Camera,
    box_intersection,
    invert,
    look_at,
    make_pose,
    pixel_centres,
    pixel_rays,
    transform,
)
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Truth, Workspace


@pytest.fixture(autouse=True, scope="session")
def _few_threads() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def workspace() -> Workspace:
    """A box that is no cube and not centred, so that mixed-up axes and corners show."""
    return Workspace(torch.tensor([-0.25, -0.2, 0.0]), torch.tensor([0.25, 0.3, 0.2]))


@pytest.fixture(scope="session")
def cameras() -> Callable[..., Camera]:
    """Returns a function of a number of views, a size and a seed: cameras about the workspace, all different."""

    def make(views: int, size: int = 32, seed: int = 0) -> Camera:
        rng = np.random.default_rng(seed)
        azimuth, polar = 2.0 * np.arange(views) + rng.uniform(-0.5, 0.5, views), rng.uniform(0.6, 1.0, views)
        around = [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
        eyes = torch.from_numpy(0.8 * np.stack(around, axis=-1)).float()
        f, c = 0.9 * size, size / 2
        intrinsics = torch.tensor([[f, 0.0, c], [0.0, f, c], [0.0, 0.0, 1.0]]).repeat(views, 1, 1)
        return Camera(intrinsics, look_at(eyes, torch.zeros(3)), size, size)

    return make


def _box(rng: np.random.Generator) -> tuple[Prism, torch.Tensor]:
    """A box on the table and the grasp across its narrow side, from above."""
    x, y, height = 0.03, 0.08, 0.08
    corners = ((-x, -y), (x, -y), (x, y), (-x, y))
    yaw, place = rng.uniform(0, np.pi), torch.tensor([*rng.uniform(-0.1, 0.1, 2), 0.0]).float()
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    colour = tuple(float(share) for share in rng.permutation([0.9, 0.2, 0.1]))
    prism = Prism("box", (corners,), height, colour, 400.0, make_pose(turn, place))
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    return prism, make_pose(turn @ down, place + torch.tensor([0.0, 0.0, height - 0.02]))


def _pictures(camera: Camera, box: Prism) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ray-casts a box on a chequered table: images `[V, H, W, 3]` and masks `[V, H, W]`, uint8, and depth in metres."""
    pixels = pixel_centres(camera.width, camera.height).flatten(0, 1).expand(len(camera), -1, 2)
    origins, directions = pixel_rays(camera, pixels)
    T_object_world = invert(box.T_world_object)
    corner = torch.tensor([*box.parts[0][2], box.height])
    least = torch.tensor([*box.parts[0][0], 0.0])
    turned = directions @ T_object_world[:3, :3].T
    near, far = box_intersection(transform(T_object_world, origins), turned, least, corner)
    to_table = -origins[..., 2:] / directions[..., 2:]
    on_table = origins + directions * to_table
    light = ((on_table[..., :2] * 10).floor().sum(-1, keepdim=True) % 2 == 0).float()
    hit = (far > near)[..., None]
    colour = torch.where(hit, torch.tensor(box.colour), 0.6 + 0.2 * light.expand(-1, -1, 3))
    shape = (len(camera), camera.height, camera.width)
    along = (directions @ camera.T_world_camera[:, :3, 2:3]) * torch.where(hit, near[..., None], to_table)
    depth = torch.where(along > 0, along, torch.inf).view(shape).numpy()
    return (colour * 255).round().byte().view(*shape, 3).numpy(), hit.byte().view(shape).numpy(), depth


@pytest.fixture(scope="session")
def make_set(cameras: Callable[..., Camera]) -> Callable[..., Path]:
    """Returns a function that packs a set without a simulator: a coloured box a scene, seen by several views.

    The last scene has no demonstrated grasp.
    """
    from nerfgrasp.data.packed import PackedWriter
    from nerfgrasp.data.settings import SetSettings

    def make(folder: Path, *, scenes: int = 4, views: int = 6, seed: int = 5, size: int = 32, **more: Any) -> Path:
        settings = SetSettings("simple", seed, scenes, views, size, **{"demonstrations": False, "physics": "", **more})
        writer = PackedWriter(folder, settings)
        writer.prepare(Workspace())
        for index in range(scenes):
            box, grasp = _box(np.random.default_rng((seed, index)))
            camera = cameras(views, size, seed=100 * seed + index)
            truth = Truth("simple", seed, index, (box,), None if index == scenes - 1 else grasp)
            images, masks, depth = _pictures(camera, box)
            writer.write(index, images, masks, camera, truth, depth if settings.depth else None)
        return folder

    return make


@pytest.fixture(scope="session")
def packed_set(make_set: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of 4 scenes, 6 views, 32 pixels, for reading only."""
    return make_set(tmp_path_factory.mktemp("packed") / "set")


@pytest.fixture(scope="session")
def tiny_network() -> Callable[..., Any]:
    """Returns a function that makes an `MVNeRFConfig` of a network that computes in no time."""
    from nerfgrasp.models import EncoderConfig, FieldConfig, MVNeRFConfig

    def make(**changes: Any) -> MVNeRFConfig:
        encoder = EncoderConfig(
            vit="vit_tiny_patch16_224",
            pretrained=False,
            vit_size=32,
            vit_options={"depth": 4, "embed_dim": 24, "num_heads": 2},
            taps=(0, 1, 2, 3),
            tap_channels=8,
            vit_channels=8,
            stem_channels=16,
            conv_channels=16,
            conv_blocks=1,
            upsample=False,
        )
        field = FieldConfig(width=16, view_blocks=1, fused_blocks=3, position_frequencies=4, direction_frequencies=2)
        defaults = {"encoder": encoder, "coarse": field, "fine": field, "coarse_samples": 6, "fine_samples": 6}
        return MVNeRFConfig(**{**defaults, **changes})

    return make


@pytest.fixture
def object_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Prepared object models and downloads go to this fresh folder, and no folder of objects is set."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("NERFGRASP_OBJECTS", raising=False)
    return tmp_path / "cache"


CUBE = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
CUBE_FACES = {"top": (2, 6, 8, 4), "bottom": (1, 3, 7, 5), "sides": (1, 5, 6, 2), "side 2": (5, 7, 8, 6)}
CUBE_FACES |= {"side 3": (7, 3, 4, 8), "side 4": (3, 1, 2, 4)}


@pytest.fixture(scope="session")
def make_box() -> Callable[..., Path]:
    """Returns a function that writes a box as a textured OBJ: red on top, green below, blue all around.

    Its texture's quarters have four colours, so that one mirrored in either direction shows.
    """
    from PIL import Image

    def make(
        folder: Path, size: tuple[float, float, float] = (0.04, 0.06, 0.1), name: str = "textured", texture: bool = True
    ) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        lines = [f"mtllib {name}.mtl"] * texture
        lines += [f"v {x * size[0]} {y * size[1]} {z * size[2]}" for x, y, z in CUBE]
        lines += ["vt 0.25 0.75", "vt 0.25 0.25", "vt 0.75 0.75", *["usemtl skin"] * texture]
        for face, corners in CUBE_FACES.items():
            patch = {"top": 1, "bottom": 2}.get(face, 3)
            lines.append("f " + " ".join(f"{corner}/{patch}" for corner in corners))
        (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")
        if texture:
            (folder / f"{name}.mtl").write_text("newmtl skin\nmap_Kd texture_map.png \n")
            pixels = np.zeros((64, 64, 3), np.uint8)
            pixels[:32, :32, 0] = pixels[32:, :32, 1] = pixels[:32, 32:, 2] = 255
            Image.fromarray(pixels).save(folder / "texture_map.png")
        return folder / f"{name}.obj"

    return make


@pytest.fixture(scope="session")
def install() -> Callable[[Path, Path], None]:
    """Returns a function that installs a distribution's source into a folder, by pip, without a network."""

    def run(source: Path, target: Path) -> None:
        options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
        command = [sys.executable, "-m", "pip", "install", *options, "--target", str(target), str(source)]
        subprocess.run(command, check=True)

    return run


@pytest.fixture(scope="module")
def ray_cluster() -> Iterator[None]:
    """One machine with one processor, as a Ray cluster."""
    ray = pytest.importorskip("ray", reason="Ray comes with the extras `cluster` and `dev`")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, object_store_memory=80_000_000)
    yield
    ray.shutdown()
