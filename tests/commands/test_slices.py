import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from nerfgrasp.cli import main
from nerfgrasp.evaluation.slices import rank_correlation, true_values
from nerfgrasp.geometry import make_pose
from nerfgrasp.models import GraspValue, GraspValueConfig, MVNeRF
from nerfgrasp.models.folder import load_model, save_model
from nerfgrasp.scenes.folder import write_scene
from nerfgrasp.scenes.oracle import valid_grasps
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Observations, Scene, Truth, Workspace
from nerfgrasp.scenes.slices import SLICES, cut_slice

BAR = (((-0.02, -0.06), (0.02, -0.06), (0.02, 0.06), (-0.02, 0.06)),)
GRASP = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0.0, 0.04]))


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory, tiny_network: Callable[..., Any]) -> dict[str, Path]:
    """A value that sees three views at once, one that sees one, and a backbone alone."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("models")
    for name, views in (("three", 3), ("one", 1)):
        save_model(folder / name, GraspValue(GraspValueConfig(backbone=tiny_network(views=views))))
    save_model(folder / "backbone", MVNeRF(tiny_network()))
    return {path.name: path for path in folder.iterdir()}


@pytest.fixture(scope="module")
def scene(cameras: Callable[..., Any]) -> Scene:
    images = torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(0)).mul(255).round() / 255
    prism = Prism("box", BAR, 0.06, (1.0, 0.0, 0.0), 500.0, torch.eye(4))
    return Scene("desk", Observations(images, cameras(4)), Workspace(), Truth("simple", 0, 0, (prism,), GRASP))


@pytest.fixture
def desk(tmp_path: Path, scene: Scene) -> Path:
    write_scene(tmp_path / "desk", scene)
    return tmp_path / "desk"


def arguments(desk: Path, *more: str | Path) -> list[str]:
    return ["slices", f"--scene={desk}", f"--out={desk.parent / 'out'}", "--size=4", *map(str, more)]


def read(desk: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((desk.parent / "out" / "slices.json").read_text())
    return data


def test_models_are_compared_with_the_truth_in_every_slice(
    desk: Path, models: dict[str, Path], scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    three, one = models["three"], models["one"]
    assert main(arguments(desk, "--model", three, one)) == 0
    assert {path.name for path in (desk.parent / "out").iterdir()} == {"slices.json", "slices.png"}
    data = read(desk)
    assert (data["scene"], data["size"], data["grasp"]["source"]) == ("desk", 4, "demonstrated")
    assert torch.allclose(torch.tensor(data["grasp"]["T_world_grasp"]), GRASP)
    assert [plane["name"] for plane in data["slices"]] == list(SLICES)
    assert [each["model"] for each in data["models"]] == [str(three), str(one)]
    cut = cut_slice(GRASP, "ty-rz", scene.workspace, size=4)
    expected = rank_correlation(values(three, scene, cut.T_world_grasp), true_values(cut, valid()))
    found = data["models"][0]["slices"]["ty-rz"]
    assert found["correlation"] == pytest.approx(expected)
    translations = [data["models"][1]["slices"][name]["correlation"] for name in ("tx-ty", "tx-tz", "ty-tz")]
    assert data["models"][1]["means"]["translation"] == pytest.approx(sum(translations) / 3)
    printed = capsys.readouterr().out
    assert f"{expected:.2f}" in printed
    assert "mean of rotation" in printed
    with Image.open(desk.parent / "out" / "slices.png") as sheet:
        assert sheet.width > len(SLICES) * 160
        assert sheet.height > 256 + 3 * 160


def values(folder: Path, scene: Scene, poses: torch.Tensor) -> torch.Tensor:
    """Finds a model's values `[N, N]` with the pieces themselves; one of one view by the mean over three."""
    model = load_model(folder)
    assert isinstance(model, GraspValue)
    groups = [[0, 1, 2]] if model.views == 3 else [[0], [1], [2]]
    with torch.no_grad():
        each = [
            model.value(model.observe(scene.observations.select(views), scene.workspace), poses.flatten(0, 1))
            for views in groups
        ]
    return torch.stack(each).mean(dim=0).view(poses.shape[:2])


def valid() -> Any:
    return valid_grasps([Prism("box", BAR, 0.06, (1.0, 0.0, 0.0), 500.0, torch.eye(4))])


def test_a_model_of_one_view_averages_over_three(desk: Path, models: dict[str, Path], scene: Scene) -> None:
    more = ["--slices", "rx-rz", "tx-tz", "--axes=world", "--turn=60"]
    assert main(arguments(desk, "--model", models["one"], *more)) == 0
    turn = torch.deg2rad(torch.tensor(60.0)).item()
    for name in ("rx-rz", "tx-tz"):
        cut = cut_slice(GRASP, name, scene.workspace, size=4, axes="world", turn=turn)
        grid = values(models["one"], scene, cut.T_world_grasp)
        row, column = divmod(int(grid.argmax()), 4)
        found = read(desk)["models"][0]["slices"][name]
        assert found["max"] == pytest.approx(float(grid.max()), abs=1e-5)
        assert found["max_at"] == pytest.approx(
            [a.low + n / 3 * (a.high - a.low) for a, n in ((cut.across, column), (cut.upward, row))]
        )


def test_without_a_demonstration_the_seed_chooses(tmp_path: Path, models: dict[str, Path], scene: Scene) -> None:
    assert scene.truth is not None
    write_scene(tmp_path / "desk", replace(scene, truth=replace(scene.truth, demonstration=None)))
    rows = []
    for seed in (1, 1, 2):
        more = [f"--model={models['three']}", "--slices=tx-ty", f"--seed={seed}"]
        assert main(arguments(tmp_path / "desk", *more)) == 0
        rows.append(read(tmp_path / "desk"))
    assert rows[0] == rows[1]
    assert rows[0]["grasp"]["source"] == "drawn"
    assert rows[0]["grasp"]["T_world_grasp"] != rows[2]["grasp"]["T_world_grasp"]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--size=1"], "size is 1"),
        (["--turn=0"], "turn is 0"),
        (["--turn=181"], "turn is 181"),
        (["--turn=.nan"], "turn is nan"),
        (["--reach=-0.1"], "reach is -0.1"),
        (["--reach=.inf"], "reach is inf"),
        (["--seed=-1"], "seed is -1"),
        (["--seed=18446744073709551616"], "seed is 18446744073709551616: it must be from 0 to 4294967295"),
        (["--slices", "tx-ty", "tx-qy"], "unknown slice 'tx-qy'"),
        (["--slices", "tx-ty", "tx-ty"], "--slices names tx-ty twice"),
        (["--slices=[]"], "--slices names nothing"),
        (["--model", "mv3-laptop", "mv3-laptop"], "--model names mv3-laptop twice"),
        (["--model=nowhere"], "unknown model"),
        (["--device=cuda:77"], "device 'cuda:77' is not there"),
        (["--model=BACKBONE"], "values no grasps"),
        (["--axes=table"], "axes"),
        (["--scene=nowhere"], "unknown scene"),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(
    desk: Path, models: dict[str, Path], capsys: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    given = [option.replace("BACKBONE", str(models["backbone"])) for option in more]
    default = [] if any(option.startswith("--model") for option in given) else [f"--model={models['three']}"]
    assert main(arguments(desk, *default, *given)) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert [path.name for path in desk.parent.iterdir()] == ["desk"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"truth": None}, "scene desk is not simulated"),
        ({"truth": Truth("simple", 0, 0, ())}, "scene desk: the oracle knows no valid grasp"),
    ],
)
def test_a_scene_without_the_truth_is_refused(
    tmp_path: Path,
    models: dict[str, Path],
    scene: Scene,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, Any],
    message: str,
) -> None:
    write_scene(tmp_path / "desk", replace(scene, **changes))
    assert main(arguments(tmp_path / "desk", f"--model={models['three']}")) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["desk"]


def test_a_camera_that_sees_nothing_of_the_workspace_is_told(
    tmp_path: Path, models: dict[str, Path], scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = scene.observations.camera
    away = camera.T_world_camera.clone()
    away[1, :3, 3] += 100.0
    seen = replace(scene.observations, camera=replace(camera, T_world_camera=away))
    write_scene(tmp_path / "desk", replace(scene, observations=seen))
    assert main(arguments(tmp_path / "desk", f"--model={models['three']}")) == 2
    assert "camera 1 sees nothing of the workspace" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["desk"]


def test_too_few_views_write_nothing(
    tmp_path: Path, models: dict[str, Path], scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(tmp_path / "desk", replace(scene, observations=scene.observations.select(slice(2))))
    assert main(arguments(tmp_path / "desk", f"--model={models['three']}")) == 2
    assert "needs 3 views, the scene has 2" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["desk"]
