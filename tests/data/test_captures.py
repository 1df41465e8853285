from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfgrasp.data.captures import CapturedScenes
from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.rays import RayBatch, RayData
from nerfgrasp.data.sources import open_source
from nerfgrasp.data.streams import SceneSet
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera, project
from nerfgrasp.models import MVNeRF
from nerfgrasp.scenes.folder import write_scene
from nerfgrasp.scenes.scene import Observations, Scene, Workspace

SIZES = {"a": (40, 30), "b": (24, 36)}


@pytest.fixture(scope="module")
def captures(cameras: Callable[..., Camera], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes of five views each, of different sizes and workspaces."""
    folder = tmp_path_factory.mktemp("captures")
    for seed, (name, (width, height)) in enumerate(SIZES.items()):
        generator = torch.Generator().manual_seed(seed)
        images = torch.randint(0, 256, (5, 3, height, width), generator=generator) / 255
        square = cameras(5, 36, seed)
        intrinsics = square.intrinsics + torch.tensor([[0, 0, width / 2 - 18], [0, 0, height / 2 - 18], [0, 0, 0]])
        camera = Camera(intrinsics, square.T_world_camera, width, height)
        box = Workspace(torch.tensor([-0.2, -0.1, 0.0]), torch.tensor([0.2, 0.15 + seed / 10, 0.2]))
        write_scene(folder / name, Scene(name, Observations(images, camera), box))
    (folder / "notes").mkdir()
    return folder


def rays(folder: Path, **changes: Any) -> RayData:
    data = RayData(folder, folder, **{"views": 2, "rays_per_scene": 40, "target_views": 2, **changes})
    data.check()
    data.setup("fit")
    return data


def batch(data: RayData, seed: int = 0) -> RayBatch:
    return data.draw(np.random.default_rng(seed))


def test_a_folder_is_opened_as_what_it_holds(captures: Path, packed_set: Path) -> None:
    scenes = open_source(captures)
    assert isinstance(scenes, CapturedScenes)
    assert [scenes.camera(i).width for i in range(len(scenes))] == [40, 24]
    assert scenes.workspace_of(1).maximum.tolist() == pytest.approx([0.2, 0.25, 0.2])
    assert len(open_source(captures / "b")) == 1
    assert isinstance(open_source(packed_set), PackedScenes)


@pytest.mark.parametrize("scene", SIZES)
def test_rays_pass_the_pixels_of_the_files(captures: Path, scene: str) -> None:
    scenes = CapturedScenes(captures / scene)
    found = batch(rays(captures / scene, object_share=0.5))
    camera, images = scenes.camera(0), scenes.read_images(0, np.arange(5))
    assert found.inputs.images.shape == (1, 2, 3, *SIZES[scene][::-1])
    assert images.shape == (5, *SIZES[scene][::-1], 3)
    for origin, direction, colour in zip(found.origins[0], found.directions[0], found.colours[0], strict=True):
        view = int((camera.T_world_camera[:, :3, 3] == origin).all(-1).nonzero()[0, 0])
        pixel, _ = project(camera[view], (origin + 0.7 * direction)[None])
        x, y = pixel[0].tolist()
        assert x % 1 == pytest.approx(0.5, abs=1e-3)
        assert np.array_equal(colour.numpy(), images[view, int(y), int(x)] / np.float32(255))


def test_sizes_that_differ_are_cut_as_the_network_cuts_them(captures: Path, tiny_network: Callable[..., Any]) -> None:
    found = batch(rays(captures, scenes_per_step=2, image_size=16, seed=3))
    assert found.inputs.images.shape == (2, 2, 3, 16, 16)
    network = MVNeRF(tiny_network(views=2, image_size=16))
    scenes = CapturedScenes(captures)
    for b in range(2):
        positions = [scenes.camera(i).T_world_camera[:, :3, 3] for i in range(2)]
        at = found.inputs.T_world_camera[b, :, :3, 3]
        scene = next(i for i in range(2) if (positions[i] == at[0]).all(-1).any())
        views = np.array([int((positions[scene] == place).all(-1).nonzero()[0, 0]) for place in at])
        whole = torch.from_numpy(scenes.read_images(scene, views) / np.float32(255)).movedim(-1, -3)
        box = scenes.workspace_of(scene)
        images, camera = network.fit_images(whole[None], _one(scenes.camera(scene)[torch.from_numpy(views)]), box)
        torch.testing.assert_close(found.inputs.images[b], images[0])
        torch.testing.assert_close(found.inputs.intrinsics[b], camera.intrinsics[0])


def _one(camera: Camera) -> Camera:
    return Camera(camera.intrinsics[None], camera.T_world_camera[None], camera.width, camera.height)


def test_the_last_views_of_a_folder_for_both_are_kept_out_of_training(captures: Path) -> None:
    data = rays(captures / "a", target_views=1, validation_targets=2, image_size=16)
    last = CapturedScenes(captures / "a").camera(0).T_world_camera[3:]
    held_out = [item.target.T_world_camera for item in data.val_dataloader()]
    assert torch.equal(torch.stack(held_out), last)
    assert all(item.target.images.shape == (3, 16, 16) for item in data.val_dataloader())
    assert not any(item.objects.any() for item in data.val_dataloader())
    for seed in range(8):
        found = batch(data, seed)
        seen = torch.cat([found.inputs.T_world_camera[0, :, :3, 3], found.origins[0]])
        assert not (seen[:, None] == last[:, :3, 3]).all(-1).any()


def test_one_folder_is_one_however_it_is_spelled(
    captures: Path, packed_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "link").symlink_to(captures)
    monkeypatch.chdir(captures.parent)
    packed = SceneSet(packed_set, scenes=4, views=6, seed=5, size=32)
    for other in (Path(captures.name), tmp_path / "link", captures / "a" / ".."):
        assert RayData(captures, other, views=2).kept_out == 1
    assert RayData(packed_set, packed).kept_out == 1
    assert RayData(captures / "a", captures / "b").kept_out == 0


def test_training_and_validation_folders_share_no_scene(captures: Path, tmp_path: Path) -> None:
    (tmp_path / "held-out").mkdir()
    (tmp_path / "held-out" / "mine").symlink_to(captures / "b")
    options: dict[str, Any] = {"views": 2, "image_size": 16}
    for train, validation in ((captures, captures / "a"), (captures / "a", captures)):
        with pytest.raises(UserError, match=r"train \(.*\) and validation \(.*\) lie one in the other"):
            RayData(train, validation, **options).check()
    with pytest.raises(UserError, match="share the scene .*b: give two folders apart, or one twice"):
        RayData(captures, tmp_path / "held-out", **options).check()
    RayData(captures / "a", tmp_path / "held-out", **options).check()


def test_masks_of_packed_sets_are_cut_with_their_images(packed_set: Path) -> None:
    data = RayData(packed_set, packed_set, views=2, image_size=16)
    data.setup("validate")
    item = data.val_dataloader().dataset[0]
    assert item.objects.shape == item.target.images.shape[-2:] == (16, 16)
    # The object is what is strongly coloured: the table and the ground are grey.
    colourful = (item.target.images.amax(0) - item.target.images.amin(0)) > 0.5
    assert item.objects.any()
    assert (colourful == item.objects).float().mean() > 0.95


@pytest.mark.parametrize(
    ("scene", "change", "message"),
    [
        ("a", {"scenes_per_step": 2}, "train: 2 scenes are needed at once, the set has 1"),
        ("a", {"views": 3}, "train: 6 views are needed at once, the set has 5"),
        (".", {"scenes_per_step": 2}, "train: images of 24x36 and 40x30 do not stack: give data.init_args.image_size"),
        ("notes", {}, "no transforms.json, neither here nor in a folder of it"),
        ("nowhere", {}, "nowhere: no such folder"),
    ],
)
def test_folders_that_do_not_do(captures: Path, scene: str, change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        rays(captures / scene, **change)
