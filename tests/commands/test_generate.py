import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfgrasp.commands import generate as command
from nerfgrasp.commands.generate import generate
from nerfgrasp.data import packed
from nerfgrasp.data.packed import PackedScenes, PackedWriter
from nerfgrasp.errors import UserError
from nerfgrasp.grippers import Gripper
from nerfgrasp.scenes.folder import read_scene
from nerfgrasp.sim.tasks import Task

pytest.importorskip("pybullet")

SMALL: dict[str, Any] = {"scenes": 6, "views": 3, "size": 32, "seed": 11, "demonstrations": False}


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set made in one go by one process, to compare others with."""
    folder = tmp_path_factory.mktemp("generate") / "unbroken"
    generate(**SMALL, out=folder, workers=1)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Every file in a folder, hidden ones too, by its relative path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_set_is_complete(unbroken: Path) -> None:
    scenes = PackedScenes(unbroken)
    assert len(scenes) == 6
    assert scenes.images.shape == (6, 3, 32, 32, 3)
    for index in range(6):
        truth = scenes.truth(index)
        assert (truth.task, truth.seed, truth.index, truth.demonstration) == ("simple", 11, index, None)
        assert scenes.masks[index].max() <= len(truth.objects)
        assert scenes.masks[index].any(), "objects are seen"
    assert len({images.tobytes() for images in scenes.images}) == 6


def test_killed_while_writing_and_continued(
    unbroken: Path, tmp_path: Path, run_until_killed: Callable[..., None]
) -> None:
    # The third that is written is the third scene's truth.
    run_until_killed(generate, **SMALL, out=tmp_path / "set", workers=1, writing=(packed, 3))
    assert len(list((tmp_path / "set" / "scenes").glob("*.json"))) == 2
    with pytest.raises(UserError, match="4 of 6 scenes are missing"):
        PackedScenes(tmp_path / "set")

    generate(**SMALL, out=tmp_path / "set", workers=1)
    assert contents(tmp_path / "set") == contents(unbroken)


def test_two_workers_killed_at_any_time_and_continued(
    unbroken: Path, tmp_path: Path, run_until_killed: Callable[..., None]
) -> None:
    def begun() -> bool:
        return any((tmp_path / "set").glob("scenes/*.json"))

    run_until_killed(generate, **SMALL, out=tmp_path / "set", workers=2, until=begun)
    generate(**SMALL, out=tmp_path / "set", workers=2)
    assert contents(tmp_path / "set") == contents(unbroken)


def test_the_number_of_workers_changes_nothing(unbroken: Path, tmp_path: Path) -> None:
    generate(**SMALL, out=tmp_path / "set", workers=2)
    assert contents(tmp_path / "set") == contents(unbroken)


def test_a_cluster_started_for_it_changes_nothing(unbroken: Path, tmp_path: Path) -> None:
    ray = pytest.importorskip("ray", reason="Ray comes with the extras `cluster` and `dev`")
    generate(**SMALL, out=tmp_path / "set", workers=2, cluster="ray")
    assert contents(tmp_path / "set") == contents(unbroken)
    assert not ray.is_initialized(), "what was started for the set is stopped"


def test_clutter_depends_on_physics_even_without_demonstrations(tmp_path: Path) -> None:
    generate("clutter", **{**SMALL, "scenes": 1}, out=tmp_path / "set", workers=1)
    scenes = PackedScenes(tmp_path / "set")
    assert scenes.settings.physics
    assert len(scenes.truth(0).objects) == 5


def test_novel_objects_name_their_catalogue(
    tmp_path: Path, make_box: Callable[..., Path], object_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_box(tmp_path / "things")
    few: dict[str, Any] = {**SMALL, "scenes": 1, "out": tmp_path / "set", "workers": 1}
    generate("novel", **few, objects=tmp_path / "things")
    assert PackedScenes(tmp_path / "set").settings.catalogue
    monkeypatch.setenv("NERFGRASP_OBJECTS", str(tmp_path / "things"))
    generate("novel", **few)
    make_box(tmp_path / "others", size=(0.05, 0.05, 0.05))
    with pytest.raises(UserError, match="holds another set .*catalogue"):
        generate("novel", **few, objects=tmp_path / "others")


def test_demonstrations_change_no_image(unbroken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # A scene does not depend on how many there are either.
    generate(**{**SMALL, "scenes": 2, "demonstrations": True}, out=tmp_path / "set", workers=1)
    scenes, without = PackedScenes(tmp_path / "set"), PackedScenes(unbroken)
    assert np.array_equal(scenes.images, without.images[:2])
    assert np.array_equal(scenes.masks, without.masks[:2])
    found = [scenes.truth(index).demonstration for index in range(2)]
    assert all(pose is None or pose.shape == (4, 4) for pose in found)
    assert any(pose is not None for pose in found)
    assert f"{found.count(None)} without a demonstrated grasp" in capsys.readouterr().out


def test_depth_changes_nothing_else(unbroken: Path, tmp_path: Path) -> None:
    generate(**{**SMALL, "scenes": 2}, out=tmp_path / "set", workers=1, depth=True)
    scenes, without = PackedScenes(tmp_path / "set"), PackedScenes(unbroken)
    for name in ("images", "masks", "intrinsics", "T_world_camera"):
        assert getattr(scenes, name).tobytes() == getattr(without, name)[:2].tobytes()
    for truth in ("scenes/000000.json", "scenes/000001.json"):
        assert (tmp_path / "set" / truth).read_bytes() == (unbroken / truth).read_bytes()
    # What an object covers is nearer than the table behind it, and the table lies 0.8 m away.
    depth, masks = scenes.read_depth(1, np.arange(3)), scenes.masks[1]
    assert 0.7 < np.median(depth[masks == 0]) < 1.1
    assert 0.4 < depth[masks > 0].min() < depth[masks > 0].max() < 1.2


def test_folders(unbroken: Path, tmp_path: Path) -> None:
    generate(**{**SMALL, "scenes": 2}, out=tmp_path / "set", workers=1, format="folders")
    scene, same = read_scene(tmp_path / "set" / "000001"), PackedScenes(unbroken).scene(1)
    assert torch.equal(scene.observations.images, same.observations.images)
    assert torch.equal(scene.observations.camera.T_world_camera, same.observations.camera.T_world_camera)
    assert scene.truth is not None
    assert same.truth is not None
    assert len(scene.truth.objects) == len(same.truth.objects)


def test_a_finished_set_is_left_alone(unbroken: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times = {path: path.stat().st_mtime_ns for path in unbroken.rglob("*")}
    generate(**SMALL, out=unbroken, workers=2)
    assert "is already complete: 6 scenes" in capsys.readouterr().out
    assert times == {path: path.stat().st_mtime_ns for path in unbroken.rglob("*")}


def test_other_settings_are_refused(unbroken: Path) -> None:
    before = contents(unbroken)
    with pytest.raises(UserError, match=r"holds another set .*seed 11, asked for 12"):
        generate(**{**SMALL, "seed": 12}, out=unbroken, workers=1)
    assert contents(unbroken) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scenes": 0}, "scenes is 0: it must be from 1 to"),
        ({"views": -1}, "views is -1"),
        ({"size": 8}, "size is 8: it must be from 16"),
        ({"size": 10**9}, "size is 1000000000"),
        ({"seed": -1}, "seed is -1"),
        ({"workers": 0}, "workers is 0"),
        ({"task": "simpel"}, "unknown task 'simpel': did you mean 'simple'"),
        ({"format": "packd"}, "unknown format 'packd': did you mean 'packed'"),
        ({"format": "folders", "depth": True}, "depth is kept in packed sets alone, not in folders"),
    ],
)
def test_bad_values_are_refused_and_nothing_is_written(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        generate(**{**SMALL, "workers": 1, **change}, out=tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_is_told(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match=r"cannot write .*Permission denied"):
        generate(**SMALL, out=tmp_path / "set", workers=1)


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write .*Not a directory"):
        generate(**SMALL, out=tmp_path / "file" / "set", workers=1)


def test_an_error_in_a_worker_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(writer: PackedWriter, task: Task, gripper: Gripper, index: int) -> None:
        raise ZeroDivisionError(f"in scene {index}")

    monkeypatch.setattr(command, "write_slot", failing)
    with pytest.raises(ZeroDivisionError, match="in scene"):
        generate(**SMALL, out=tmp_path / "set", workers=2)


def test_a_lost_worker_is_replaced(unbroken: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_slot, mark = command.write_slot, tmp_path / "died"

    def dying_once(writer: PackedWriter, task: Task, gripper: Gripper, index: int) -> None:
        import os

        if index == 3 and not mark.exists():
            # The other worker is killed with this one, perhaps while it writes.
            (writer.folder / "scenes" / f".000004.json.{os.getpid()}.tmp").write_text("{")
            mark.touch()
            os.kill(os.getpid(), 9)
        write_slot(writer, task, gripper, index)

    monkeypatch.setattr(command, "write_slot", dying_once)
    generate(**SMALL, out=tmp_path / "set", workers=2)
    assert mark.exists()
    assert contents(tmp_path / "set") == contents(unbroken)


def test_workers_that_keep_dying_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deaths = tmp_path / "deaths"
    deaths.mkdir()

    def dying(writer: PackedWriter, task: Task, gripper: Gripper, index: int) -> None:
        import os

        (deaths / str(os.getpid())).touch()
        os.kill(os.getpid(), 9)

    monkeypatch.setattr(command, "write_slot", dying)
    with pytest.raises(UserError, match=r"worker processes died 3 times .*: try fewer workers"):
        generate(**SMALL, out=tmp_path / "set", workers=2)
    assert 3 <= len(list(deaths.iterdir())) <= 6


def test_threads_are_given_back(tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    generate(**{**SMALL, "scenes": 1}, out=tmp_path / "set", workers=1)
    assert torch.get_num_threads() == threads
