import errno
import json
import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfgrasp.data.folders import FolderWriter
from nerfgrasp.data.packed import PackedScenes, PackedWriter
from nerfgrasp.data.settings import SetSettings
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera, look_at
from nerfgrasp.scenes.folder import read_scene
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Truth, Workspace

SETTINGS = SetSettings("simple", 5, scenes=2, views=3, size=16, demonstrations=True, physics="abc")
Slot = tuple[np.ndarray, np.ndarray, Camera, Truth]


def slot(index: int) -> Slot:
    """The content of a scene, a function of its number."""
    rng = np.random.default_rng(index)
    images = rng.integers(0, 256, (3, 16, 16, 3), dtype=np.uint8)
    masks = rng.integers(0, 3, (3, 16, 16), dtype=np.uint8)
    eyes = torch.from_numpy(rng.uniform(0.1, 1.0, (3, 3))).float()
    intrinsics = torch.from_numpy(rng.uniform(1.0, 9.0, (3, 3, 3))).float()
    parts = (((0.0, 0.0), (0.1, 0.0), (1 / 3, 0.2)),)
    prism = Prism("triangle", parts, 0.07, (0.1, 1 / 3, 0.9), 400.0, look_at(eyes[0], eyes[1]))
    demonstration = look_at(eyes[1], eyes[2]) if index else None
    camera = Camera(intrinsics, look_at(eyes, torch.zeros(3)), 16, 16)
    return images, masks, camera, Truth("simple", 5, index, (prism,), demonstration)


def packed(folder: Path) -> Path:
    writer = PackedWriter(folder, SETTINGS)
    writer.prepare(Workspace())
    for index in range(2):
        writer.write(index, *slot(index))
    return folder


def test_round_trip_is_exact(tmp_path: Path) -> None:
    scenes = PackedScenes(packed(tmp_path / "set"))
    assert len(scenes) == 2
    assert scenes.settings == SETTINGS
    assert torch.equal(scenes.workspace.maximum, Workspace().maximum)
    for index in range(2):
        images, masks, camera, truth = slot(index)
        assert np.array_equal(scenes.images[index], images)
        assert np.array_equal(scenes.masks[index], masks)
        assert torch.equal(scenes.camera(index).intrinsics, camera.intrinsics)
        assert torch.equal(scenes.camera(index).T_world_camera, camera.T_world_camera)
        again = scenes.truth(index)
        assert (again.task, again.seed, again.index) == ("simple", 5, index)
        assert torch.equal(again.objects[0].T_world_object, truth.objects[0].T_world_object)
    assert scenes.truth(0).demonstration is None
    assert torch.equal(scenes.truth(-1).demonstration, slot(1)[3].demonstration)


def test_scene(tmp_path: Path) -> None:
    scene = PackedScenes(packed(tmp_path / "set")).scene(1)
    images, _, camera, _ = slot(1)
    assert scene.name == "000001"
    assert scene.observations.images.shape == (3, 3, 16, 16)
    assert scene.observations.images[2, 1, 5, 7] == images[2, 5, 7, 1] / np.float32(255)
    assert torch.equal(scene.observations.camera.T_world_camera, camera.T_world_camera)
    assert scene.truth is not None
    assert scene.truth.index == 1


def test_depth_comes_back_to_the_tenth_of_a_millimetre(tmp_path: Path) -> None:
    depth = np.random.default_rng(0).uniform(0.3, 6.0, (3, 16, 16)).astype(np.float32)
    depth[0, 0, :2] = np.inf, 7.0
    writer = PackedWriter(tmp_path / "set", replace(SETTINGS, depth=True))
    writer.prepare(Workspace())
    for index in range(2):
        writer.write(index, *slot(index), depth)
    scenes = PackedScenes(tmp_path / "set")
    back = scenes.read_depth(1, np.array([0, 2]))
    assert back.dtype == np.float32
    assert np.isinf(back[0, 0, :2]).all()
    np.testing.assert_allclose(back[1], depth[2], atol=5.1e-5, rtol=0)
    assert scenes.depth is not None
    assert scenes.depth[0, 1, 2, 3] == round(float(depth[1, 2, 3]) * 10_000)


def test_a_set_without_depth_has_none_to_give(tmp_path: Path) -> None:
    folder = packed(tmp_path / "set")
    with pytest.raises(UserError, match="set keeps no depth: generate it with --depth true"):
        PackedScenes(folder).read_depth(0, np.array([0]))
    settings = json.loads((folder / "set.json").read_text())
    assert settings.pop("depth") is False
    (folder / "set.json").write_text(json.dumps(settings))
    assert PackedScenes(folder).settings == SETTINGS, "sets may be older than depth"


def test_scene_outside_is_an_index_error(tmp_path: Path) -> None:
    scenes = PackedScenes(packed(tmp_path / "set"))
    with pytest.raises(IndexError):
        scenes.truth(2)


def test_arrays_are_mapped_and_read_only(tmp_path: Path) -> None:
    scenes = PackedScenes(packed(tmp_path / "set"))
    assert isinstance(scenes.images, np.memmap)
    with pytest.raises(ValueError, match="read-only"):
        scenes.images[0] = 0


def test_pickles_as_a_name(tmp_path: Path) -> None:
    scenes = PackedScenes(packed(tmp_path / "set"))
    pickled = pickle.dumps(scenes)
    assert len(pickled) < 1000
    assert np.array_equal(pickle.loads(pickled).images, scenes.images)


def test_order_of_writing_does_not_matter(tmp_path: Path) -> None:
    packed(tmp_path / "a")
    writer = PackedWriter(tmp_path / "b", SETTINGS)
    writer.prepare(Workspace())
    for index in (1, 0, 1):
        writer.write(index, *slot(index))
    files = [path.relative_to(tmp_path / "a") for path in sorted((tmp_path / "a").rglob("*.*"))]
    assert files == [path.relative_to(tmp_path / "b") for path in sorted((tmp_path / "b").rglob("*.*"))]
    assert all((tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes() for file in files)


def test_missing_shrinks_and_incomplete_is_refused(tmp_path: Path) -> None:
    writer = PackedWriter(tmp_path / "set", SETTINGS)
    writer.prepare(Workspace())
    assert writer.missing() == [0, 1]
    writer.write(1, *slot(1))
    assert writer.missing() == [0]
    with pytest.raises(UserError, match="is not complete: 1 of 2 scenes are missing"):
        PackedScenes(tmp_path / "set")
    PackedWriter(tmp_path / "set", SETTINGS).prepare(Workspace())
    writer.write(0, *slot(0))
    assert np.array_equal(PackedScenes(tmp_path / "set").images[1], slot(1)[0])


def test_what_a_killed_run_left_goes(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    for name in (".set.json.1.tmp", ".images.npy.1.tmp"):
        (folder / name).write_text("half")
    writer = PackedWriter(folder, SETTINGS)
    writer.prepare(Workspace())
    (folder / "scenes" / ".000000.json.1.tmp").write_text("half")
    writer.prepare(Workspace())
    assert not list(folder.rglob(".*"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 6}, "seed 5, asked for 6"),
        ({"scenes": 3}, "scenes 2, asked for 3"),
        ({"physics": "abd", "size": 32}, "size 16, asked for 32; physics 'abc', asked for 'abd'"),
        ({"format": "folders"}, "format 'packed', asked for 'folders'"),
        ({"depth": True}, "depth False, asked for True"),
    ],
)
def test_another_set_in_the_folder_is_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    packed(tmp_path / "set")
    with pytest.raises(UserError, match=message):
        PackedWriter(tmp_path / "set", replace(SETTINGS, **change)).prepare(Workspace())
    assert len(PackedScenes(tmp_path / "set")) == 2


def test_a_folder_with_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(UserError, match=r"is not empty and holds no set\.json"):
        PackedWriter(tmp_path, SETTINGS).prepare(Workspace())
    with pytest.raises(UserError, match=r"thesis\.tex"):
        PackedWriter(tmp_path / "thesis.tex", SETTINGS).prepare(Workspace())
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("images.npy", Path.unlink, r"is damaged: cannot read images\.npy"),
        ("masks.npy", truncate, r"is damaged: cannot read masks\.npy"),
        ("masks.npy", lambda path: path.write_bytes(b""), r"is damaged: cannot read masks\.npy"),
        ("intrinsics.npy", lambda path: np.save(path, np.zeros(3)), r"intrinsics\.npy is float64 \(3,\), not float32"),
        ("set.json", Path.unlink, r"is no data set: it has no set\.json"),
        ("set.json", truncate, r"set\.json is not valid JSON"),
        ("set.json", lambda path: path.write_text('{"version": 1}'), "'task' is missing or wrong"),
        ("set.json", lambda path: path.write_text('{"version": 2}'), "format version 2, this program reads 1"),
        ("scenes/000001.json", Path.unlink, "is not complete: 1 of 2 scenes are missing"),
    ],
)
def test_damage_is_refused(tmp_path: Path, name: str, damage: Callable[[Path], object], message: str) -> None:
    folder = packed(tmp_path / "set")
    damage(folder / name)
    with pytest.raises(UserError, match=message):
        PackedScenes(folder)


@pytest.mark.parametrize("damage", [truncate, lambda path: path.write_text("{}")])
def test_a_damaged_truth_is_refused(tmp_path: Path, damage: Callable[[Path], object]) -> None:
    scenes = PackedScenes(packed(tmp_path / "set"))
    damage(tmp_path / "set" / "scenes" / "000001.json")
    with pytest.raises(UserError, match=r"000001\.json"):
        scenes.truth(1)


def test_arrays_lost_from_a_begun_set_are_not_made_anew(tmp_path: Path) -> None:
    folder = packed(tmp_path / "set")
    (folder / "scenes" / "000001.json").unlink()
    (folder / "images.npy").unlink()
    with pytest.raises(UserError, match=r"is damaged: cannot read images\.npy"):
        PackedWriter(folder, SETTINGS).prepare(Workspace())


def test_no_set_there(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere is no data set"):
        PackedScenes(tmp_path / "nowhere")


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="space cannot be reserved here")
def test_a_full_disk_is_told_and_nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "posix_fallocate", full)
        with pytest.raises(UserError, match=r"cannot write .*images\.npy: No space left on device"):
            PackedWriter(tmp_path / "set", SETTINGS).prepare(Workspace())
    assert not list((tmp_path / "set").iterdir())
    assert len(PackedScenes(packed(tmp_path / "set"))) == 2


def test_a_folder_that_turned_read_only_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_only(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    writer = PackedWriter(packed(tmp_path / "set"), SETTINGS)
    monkeypatch.setattr("nerfgrasp.data.packed.open_memmap", read_only)
    with pytest.raises(UserError, match=r"cannot write .*images\.npy: Read-only file system"):
        writer.write(0, *slot(0))


def test_space_is_taken_before_the_first_scene(tmp_path: Path) -> None:
    PackedWriter(tmp_path / "set", SETTINGS).prepare(Workspace())
    status = (tmp_path / "set" / "images.npy").stat()
    assert status.st_size > 2 * 3 * 16 * 16 * 3
    assert status.st_blocks * 512 >= status.st_size


def test_folders_hold_the_same_scenes(tmp_path: Path) -> None:
    writer = FolderWriter(tmp_path / "set", replace(SETTINGS, format="folders"))
    writer.prepare(Workspace())
    images, masks, camera, truth = slot(1)
    intrinsics = torch.tensor([[10.0, 0.0, 8.0], [0.0, 11.0, 8.0], [0.0, 0.0, 1.0]]).repeat(3, 1, 1)
    camera = replace(camera, intrinsics=intrinsics)
    for _ in range(2):  # Another process may have been there first.
        writer.write(1, images, masks, camera, truth)
    assert writer.missing() == [0]
    scene = read_scene(tmp_path / "set" / "000001")
    assert np.array_equal((scene.observations.images * 255).round().byte().movedim(1, -1).numpy(), images)
    assert torch.equal(scene.observations.camera.T_world_camera, camera.T_world_camera)
    assert torch.equal(scene.observations.camera.intrinsics, intrinsics)
    assert torch.equal(writer.truth(1).demonstration, truth.demonstration)
    assert json.loads((tmp_path / "set" / "set.json").read_text())["format"] == "folders"
    with pytest.raises(UserError, match="is a set of folders, not a packed one"):
        PackedScenes(tmp_path / "set")
