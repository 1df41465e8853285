import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nerfgrasp.cli import main
from nerfgrasp.commands import render as command
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera
from nerfgrasp.models import GraspValue, GraspValueConfig, MVNeRF, render_image
from nerfgrasp.models.folder import load_model, save_model
from nerfgrasp.models.scores import image_scores
from nerfgrasp.scenes.folder import read_scene, write_scene
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Observations, Scene, Truth, Workspace

SQUARE = ((-0.05, -0.05), (0.05, -0.05), (0.05, 0.05), (-0.05, 0.05))
WRITTEN = {"render.png", "render.json", "render.rrd"}


@pytest.fixture(scope="module")
def backbone(tmp_path_factory: pytest.TempPathFactory, tiny_network: Callable[..., Any]) -> Path:
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("models") / "backbone"
    save_model(folder, MVNeRF(tiny_network()))
    return folder


@pytest.fixture(scope="module")
def scene(cameras: Callable[..., Camera]) -> Scene:
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(5, 3, 32, 32, generator=generator).mul(255).round() / 255
    return Scene("desk", Observations(images, cameras(5)), Workspace())


@pytest.fixture
def desk(tmp_path: Path, scene: Scene) -> Path:
    write_scene(tmp_path / "desk", scene)
    return tmp_path / "desk"


def arguments(desk: Path, model: Path, *more: str) -> list[str]:
    return ["render", f"--scene={desk}", f"--model={model}", f"--out={desk.parent / 'out'}", *more]


def read(out: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((out / "render.json").read_text())
    return data


def entities(path: Path) -> set[str]:
    rerun_chunk = pytest.importorskip("rerun.chunk")
    return {chunk.entity_path for chunk in rerun_chunk.RrdReader(path).stream()}


def test_the_views_that_are_no_input_are_rendered_and_scored(
    desk: Path, backbone: Path, scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(desk, backbone)) == 0
    out = tmp_path / "out"
    assert {path.name for path in out.iterdir()} == WRITTEN
    data = read(out)
    assert (data["scene"], data["inputs"], data["size"]) == ("desk", [0, 1, 2], 128)
    assert [row["view"] for row in data["views"]] == [3, 4]
    expected = scores_of(backbone, scene, inputs=[0, 1, 2], view=4)
    assert data["views"][1] == pytest.approx({"view": 4, **expected}, rel=1e-4)
    printed = capsys.readouterr().out
    assert f"{expected['psnr']:.2f}" in printed
    assert f"{np.mean([row['psnr'] for row in data['views']]):.2f}" in printed
    assert "LPIPS is left out" in printed
    with Image.open(out / "render.png") as sheet:
        assert sheet.width > 4 * 256  # truth, rendered, error, depth
    named = {f"/world/{name}" for name in ("input_0", "input_1", "input_2", "rendered_3", "rendered_4")}
    assert entities(out / "render.rrd") >= {f"{name}/image" for name in named} | {"/world/rendered_3/depth"}


def scores_of(model: Path, scene: Scene, *, inputs: list[int], view: int) -> dict[str, float]:
    """Renders and scores one view with the pieces themselves."""
    network, seen = load_model(model), scene.observations.select(inputs)
    assert isinstance(network, MVNeRF)
    camera = Camera(seen.camera.intrinsics[None], seen.camera.T_world_camera[None], 32, 32)
    with torch.no_grad():
        features = network.observe(seen.images[None], camera, scene.workspace)
    rgb, _, inside = render_image(network, features, scene.observations.camera[view], scene.workspace)
    nothing = torch.zeros_like(inside)
    scores = image_scores(rgb.movedim(-1, 0), scene.observations.images[view], inside, nothing)
    return {name: float(value) for name, value in scores.items()}


def test_inputs_and_views_are_those_named(desk: Path, backbone: Path, scene: Scene, tmp_path: Path) -> None:
    assert main(arguments(desk, backbone, "--inputs=4,1,3", "--view=3,0")) == 0
    data = read(tmp_path / "out")
    assert data["inputs"] == [4, 1, 3]
    assert [row["view"] for row in data["views"]] == [3, 0]  # one of them an input, seen again
    expected = scores_of(backbone, scene, inputs=[4, 1, 3], view=0)
    assert data["views"][1]["psnr"] == pytest.approx(expected["psnr"], rel=1e-4)


def test_a_grasp_value_renders_with_its_backbone(
    desk: Path, backbone: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: Any
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.setattr(command, "find_spec", lambda name: None)  # as if rerun were not installed
    network = load_model(backbone)
    assert isinstance(network, MVNeRF)
    value = GraspValue(GraspValueConfig(backbone=network.config))
    value.backbone.load_state_dict(network.state_dict())
    save_model(folder := tmp_path_factory.mktemp("models") / "value", value)
    rows = []
    for model in (backbone, folder):
        assert main(arguments(desk, model, "--view=3")) == 0
        rows.append(read(tmp_path / "out")["views"])
    assert rows[0] == rows[1]
    assert {path.name for path in (tmp_path / "out").iterdir()} == WRITTEN - {"render.rrd"}


def test_a_grasp_value_that_never_learned_to_render_is_refused(
    desk: Path, tiny_network: Callable[..., Any], tmp_path: Path, refusal: Callable[[list[str]], str]
) -> None:
    save_model(model := tmp_path / "no3", GraspValue(GraspValueConfig(backbone=tiny_network(), renders=False)))
    line = refusal(arguments(desk, model))
    assert line == f"model {model} never learned to render: it was trained on grasps alone, without a backbone"
    assert not (tmp_path / "out").exists()


def test_an_orbit_is_animated(desk: Path, backbone: Path, tmp_path: Path) -> None:
    assert main(arguments(desk, backbone, "--orbit=3", "--size=16")) == 0
    out = tmp_path / "out"
    assert {path.name for path in out.iterdir()} == WRITTEN | {"orbit.gif"}
    data = read(out)
    assert (data["orbit"], data["size"], "views" in data) == (3, 16, False)
    with Image.open(out / "orbit.gif") as frames:
        assert (frames.n_frames, frames.size) == (3, (512, 256))
        drawn = []
        for frame in range(3):
            frames.seek(frame)
            drawn.append(np.asarray(frames.convert("RGB")).astype(int))
    assert all(np.abs(drawn[0] - other).max() > 10 for other in drawn[1:])
    assert {"/world/orbit/image", "/world/orbit/depth", "/world/input_2/image"} <= entities(out / "render.rrd")


def test_a_smaller_size_shrinks_the_truth_as_well(desk: Path, backbone: Path, tmp_path: Path, scene: Scene) -> None:
    half = scene.observations.images.unflatten(2, (16, 2)).unflatten(4, (16, 2)).mean(dim=(3, 5))
    shrunk = command._shrunk(scene.observations, 16)
    assert shrunk.images.shape == half.shape
    assert float((shrunk.images - half).abs().mean()) < 0.1
    assert torch.allclose(shrunk.camera.intrinsics[:, :2] * 2, scene.observations.camera.intrinsics[:, :2])
    assert command._shrunk(scene.observations, 32) is scene.observations
    assert main(arguments(desk, backbone, "--view=3", "--size=16")) == 0
    assert math.isfinite(read(tmp_path / "out")["views"][0]["psnr"])


def test_of_a_simulated_scene_objects_and_depth_are_known(
    tmp_path: Path, scene: Scene, backbone: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pybullet")
    prism = Prism("box", (SQUARE,), 0.1, (1.0, 0.0, 0.0), 500.0, torch.eye(4))
    write_scene(tmp_path / "desk", replace(scene, truth=Truth("simple", 0, 0, (prism,))))
    found = read_scene(tmp_path / "desk")
    masks, depth = command._simulated(found, found.observations.camera[3:])
    assert 10 < int(masks[0].sum()) < 500
    assert depth is not None
    centre = float(depth[0, 16, 16])
    assert centre == pytest.approx(0.8 - 0.1 / 2, abs=0.1)  # the camera is 0.8 m from the box's foot
    assert main(arguments(tmp_path / "desk", backbone, "--view=3")) == 0
    assert math.isfinite(read(tmp_path / "out")["views"][0]["psnr_objects"])
    with Image.open(tmp_path / "out" / "render.png") as sheet:
        assert sheet.width > 5 * 256  # the true depth as well
    assert "objects" in capsys.readouterr().out


def test_lpips_is_among_the_scores_where_it_is_installed(
    desk: Path, backbone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "load_lpips", lambda: lambda rendered, truth: (rendered - truth).abs().mean())
    assert main(arguments(desk, backbone, "--view=3")) == 0
    assert 0.0 < read(tmp_path / "out")["views"][0]["lpips"] < 1.0
    printed = capsys.readouterr().out
    assert "left out" not in printed
    assert "LPIPS" in printed


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--view=3", "--orbit=4"], "give one of them"),
        (["--view=5"], "--view names view 5: scene desk has views 0 to 4"),
        (["--view=-1"], "--view names view -1"),
        (["--view=three"], "--view is 'three'"),
        (["--inputs=0,1,7"], "--inputs names view 7"),
        (["--inputs=0,1,1"], "--inputs names view 1 twice"),
        (["--inputs=0,1"], "--inputs names 2 of the views: the model sees 3 at once"),
        (["--orbit=0"], "orbit is 0"),
        (["--size=8"], "size is 8"),
        (["--model=nowhere"], "unknown model"),
        (["--device=cuda:77"], "device 'cuda:77' is not there"),
        (["--scene=nowhere"], "unknown scene"),
    ],
)
def test_mistakes_are_told_and_leave_nothing_behind(
    desk: Path, backbone: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(arguments(desk, backbone, *options)) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["desk"]


@pytest.mark.parametrize(
    ("views", "message"), [(2, "needs 3 views, the scene has 2"), (3, "all 3 views of scene desk are inputs")]
)
def test_too_few_views(tmp_path: Path, scene: Scene, backbone: Path, views: int, message: str) -> None:
    write_scene(tmp_path / "desk", replace(scene, observations=scene.observations.select(slice(views))))
    with pytest.raises(UserError, match=message):
        command.render(str(tmp_path / "desk"), model=str(backbone), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_failure_while_rendering_leaves_nothing_behind(
    desk: Path, backbone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(command, "write_json", fail)
    assert main(arguments(desk, backbone, "--view=3")) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["desk"]


def test_a_view_past_the_workspace_has_no_scores(scene: Scene, backbone: Path, tmp_path: Path) -> None:
    away = scene.observations.camera.T_world_camera.clone()
    away[4, :3, :3] = away[4, :3, :3] @ torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # it looks the other way
    camera = replace(scene.observations.camera, T_world_camera=away)
    write_scene(tmp_path / "desk", replace(scene, observations=replace(scene.observations, camera=camera)))
    assert main(arguments(tmp_path / "desk", backbone)) == 0
    seen, unseen = read(tmp_path / "out")["views"]
    assert seen.keys() == {"view", "psnr", "ssim"}
    assert unseen == {"view": 4}


def test_the_table_has_only_the_columns_that_are_known() -> None:
    scores = {3: {"psnr": 20.0, "ssim": 0.5}, 12: {"psnr": 30.0, "ssim": 0.7, "psnr_objects": 10.0}, 13: {}}
    header, first, second, third, mean, _ = command.table(scores)
    assert header.split() == ["view", "PSNR", "objects", "SSIM"]
    assert first.split() == ["3", "20.00", "-", "0.500"]
    assert second.split() == ["12", "30.00", "10.00", "0.700"]
    assert third.split() == ["13", "-", "-", "-"]
    assert mean.split() == ["mean", "25.00", "10.00", "0.600"]
