import json
from dataclasses import replace
from pathlib import Path

import pytest
import roma
import torch
from PIL import Image

from nerfgrasp.cli import main
from nerfgrasp.commands import optimize as command
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera, look_at, make_pose
from nerfgrasp.models.encoder import EncoderConfig
from nerfgrasp.models.field import FieldConfig
from nerfgrasp.models.folder import save_model
from nerfgrasp.models.grasp_value import GraspValue, GraspValueConfig
from nerfgrasp.models.mvnerf import MVNeRF, MVNeRFConfig
from nerfgrasp.scenes.folder import write_scene
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Grasps, Observations, Scene, Truth, Workspace
from nerfgrasp.search.ranking import grasp_angle
from nerfgrasp.search.strategies import STRATEGIES

SQUARE = ((-0.02, -0.02), (0.02, -0.02), (0.02, 0.02), (-0.02, 0.02))


def tiny_backbone() -> MVNeRFConfig:
    """A network of the real kind that renders in a moment."""
    encoder = EncoderConfig(
        vit="vit_tiny_patch16_224",
        pretrained=False,
        vit_size=32,
        vit_options={"depth": 4},
        taps=(0, 1, 2, 3),
        tap_channels=8,
        vit_channels=8,
        stem_channels=8,
        conv_channels=8,
        conv_blocks=1,
    )
    field = FieldConfig(width=8)
    return MVNeRFConfig(encoder=encoder, coarse=field, fine=field, coarse_samples=4, fine_samples=4)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("models") / "tiny"
    save_model(folder, GraspValue(GraspValueConfig(backbone=tiny_backbone())))
    return folder


@pytest.fixture(scope="module")
def scene() -> Scene:
    eye = torch.tensor([[0.6, 0.0, 0.5], [0.0, 0.6, 0.5], [-0.6, 0.0, 0.5], [0.4, 0.4, 0.5]])
    intrinsics = torch.tensor([[30.0, 0.0, 16.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]]).expand(4, 3, 3)
    images = torch.rand(4, 3, 24, 32, generator=torch.Generator().manual_seed(0))
    camera = Camera(intrinsics, look_at(eye, torch.zeros(3)), width=32, height=24)
    return Scene("desk", Observations(images, camera), Workspace())


@pytest.fixture
def desk(tmp_path: Path, scene: Scene) -> Path:
    write_scene(tmp_path / "desk", scene)
    return tmp_path / "desk"


def arguments(desk: Path, model: Path, out: Path, *more: str) -> list[str]:
    options = {"scene": desk, "model": model, "out": out, "candidates": 12, "keep": 4, "count": 3}
    return ["optimize", *(f"--{name}={value}" for name, value in options.items()), *more]


def nothing_is_left(tmp_path: Path) -> bool:
    return sorted(path.name for path in tmp_path.iterdir()) == ["desk"]


def test_optimize_writes_grasps_picture_and_recording(
    desk: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(desk, model, tmp_path / "out")) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"grasps.json", "picture.png", "optimization.rrd"}
    data = json.loads((tmp_path / "out" / "grasps.json").read_text())
    assert (data["scene"], data["pose"], data["seed"], data["candidates"]) == ("desk", "quaternion", 0, 12)
    assert (data["strategy"], data["keep"], data["max_tilt_degrees"]) == ("guided", 4, 60.0)
    assert "one scene only" in data["note"]
    values = [grasp["value"] for grasp in data["grasps"]]
    assert 1 <= len(values) <= 3
    assert values == sorted(values, reverse=True)
    for grasp in data["grasps"]:
        T = torch.tensor(grasp["T_world_grasp"])
        rotation = roma.unitquat_to_rotmat(torch.tensor(grasp["quaternion"]))
        assert torch.allclose(make_pose(rotation, torch.tensor(grasp["position"])), T, atol=1e-5)
        assert "outcome" not in grasp
    with Image.open(tmp_path / "out" / "picture.png") as picture:
        assert picture.width > 3 * 300
    printed = capsys.readouterr().out
    assert "one scene only" in printed
    assert "wrote grasps.json, optimization.rrd, picture.png" in printed


def test_what_a_model_that_never_learned_to_render_imagines_is_left_out(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_model(tmp_path / "no3", GraspValue(GraspValueConfig(backbone=tiny_backbone(), renders=False)))
    assert main(arguments(desk, tmp_path / "no3", tmp_path / "out")) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"grasps.json", "picture.png", "optimization.rrd"}
    with Image.open(tmp_path / "out" / "picture.png") as picture:
        assert picture.height * 2 < picture.width  # the input views' row alone
    # Nor can it be searched by its density: what is printed and recorded is the search that was run.
    data = json.loads((tmp_path / "out" / "grasps.json").read_text())
    assert (data["strategy"], data["candidates"], data["keep"]) == ("alone", 12, 4)
    printed = capsys.readouterr().out
    assert "never learned to render, so guided cannot guide its search" in printed
    assert "searching desk: alone, 12 candidates, the best 4 climb" in printed


def test_only_a_value_that_is_anchored_rejects_a_scene(
    desk: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(0)
    binary = GraspValue(GraspValueConfig(backbone=tiny_backbone(), loss="binary"))
    save_model(tmp_path / "model" / "binary", binary)
    assert main(arguments(desk, tmp_path / "model" / "binary", tmp_path / "out")) == 0
    values = [grasp["value"] for grasp in json.loads((tmp_path / "out" / "grasps.json").read_text())["grasps"]]
    few = arguments(desk, tmp_path / "model" / "binary", tmp_path / "few", f"--least_value={values[0]}")
    assert main(few) == 0
    assert len(json.loads((tmp_path / "few" / "grasps.json").read_text())["grasps"]) == 1
    capsys.readouterr()
    none = arguments(desk, tmp_path / "model" / "binary", tmp_path / "none", f"--least_value={values[0] + 1}")
    assert main(none) == 1
    asked = f"worth {values[0]:.2f}, less than the {values[0] + 1:g} asked for"
    assert asked in capsys.readouterr().err
    assert main(arguments(desk, model, tmp_path / "none", "--least_value=0")) == 2
    told = capsys.readouterr()
    assert "least_value is 0: the model's values compare within one scene only" in told.err
    assert "searching" not in told.out
    assert not (tmp_path / "none").exists()


def test_the_same_seed_writes_the_same_bytes(
    desk: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "find_spec", lambda name: None)  # as if rerun were not installed
    outs = [tmp_path / name for name in ("first", "again", "other")]
    for out, seed in zip(outs, (7, 7, 8), strict=True):
        assert main(arguments(desk, model, out, f"--seed={seed}")) == 0
    first, again, other = ((out / "grasps.json").read_bytes() for out in outs)
    assert first == again
    assert first != other
    assert sorted(path.name for path in outs[0].iterdir()) == ["grasps.json", "picture.png"]


def test_schedule_and_constraints_are_kept_and_recorded(
    desk: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    box = [-0.1, -0.1, 0.0, 0.0, 0.1, 0.15]
    options = ["--schedule=paper", "--max_tilt=15", "--clearance=0.01", f"--workspace={box}", "--count=12"]
    assert main(arguments(desk, model, tmp_path / "out", *options)) == 0
    data = json.loads((tmp_path / "out" / "grasps.json").read_text())
    assert (data["strategy"], data["max_tilt_degrees"], data["clearance"]) == ("paper", 15.0, 0.01)
    assert [*data["workspace"]["minimum"], *data["workspace"]["maximum"]] == pytest.approx(box)
    found = torch.tensor([grasp["T_world_grasp"] for grasp in data["grasps"]])
    assert (
        (found[:, :2, 3] >= torch.tensor(box[:2]) - 1e-5) & (found[:, :2, 3] <= torch.tensor(box[3:5]) + 1e-5)
    ).all()
    assert all(command.tilt_degrees(T) < 15.1 for T in found)
    alike = torch.cdist(found[:, :3, 3], found[:, :3, 3]) < 0.02
    angles = grasp_angle(found[:, None, :3, :3].expand(-1, len(found), 3, 3), found[None, :, :3, :3])
    assert not (alike & (angles < 0.52)).fill_diagonal_(False).any()


def test_execute_reports_the_outcome(
    tmp_path: Path, scene: Scene, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pybullet")
    prism = Prism("box", (SQUARE,), 0.05, (1.0, 0.0, 0.0), 500.0, torch.eye(4))
    write_scene(tmp_path / "desk", replace(scene, truth=Truth("simple", 0, 0, (prism,))))
    assert main(arguments(tmp_path / "desk", model, tmp_path / "out", "--execute=true")) == 0
    best, *others = json.loads((tmp_path / "out" / "grasps.json").read_text())["grasps"]
    assert best["outcome"]
    assert best["outcome"] in capsys.readouterr().out
    assert all("outcome" not in grasp for grasp in others)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--pose=quaternoin"], "did you mean 'quaternion'"),
        (["--model=nowhere"], "unknown model"),
        (["--scene=nowhere"], "unknown scene"),
        (["--execute=true"], "simulated"),
        (["--candidates=0"], "candidates is 0"),
        (["--keep=0"], "keep is 0"),
        (["--schedule=join"], "unknown strategy 'join': did you mean 'joint'"),
        (["--max_tilt=-3"], "max_tilt is -3.0"),
        (["--max_tilt=.nan"], "max_tilt is nan"),
        (["--clearance=-0.01"], "clearance is -0.01"),
        (["--device=cuda:77"], "device 'cuda:77' is not there"),
        (["--workspace=[0,0,0,1,1]"], "workspace is 5 numbers: it takes six"),
        (["--workspace=[0,0,0,1,-1,1]"], "workspace is empty"),
        (["--workspace=[0,0,0,1,.nan,1]"], "workspace: a corner holds a number that is not finite"),
        (["--workspace=[7,7,0,7.5,7.5,0.2]"], "camera 0 sees nothing of the workspace from (7, 7, 0) to"),
        (["--count=-1"], "count is -1"),
        (["--seed=-1"], "seed is -1"),
        (["--images=0"], "images is 0: it must be from 1 to 1000"),
        (["--images=7"], "images is 7: the scene has 4"),
        (["--seed=18446744073709551616"], "seed is 18446744073709551616: it must be from 0 to 4294967295"),
    ],
)
def test_mistakes_are_told_before_the_search(
    desk: Path,
    model: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    message: str,
) -> None:
    assert main(arguments(desk, model, tmp_path / "out", *options)) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert "searching" not in captured.out
    assert nothing_is_left(tmp_path)


def test_every_schedule_is_listed() -> None:
    readme = Path(__file__).parents[2] / "README.md"
    texts = [command.optimize.__doc__ or "", *([readme.read_text("utf-8")] if readme.exists() else [])]
    for text in texts:
        described = text[text.index("how to search") :][:300]
        assert all(f"`{name}`" in described for name in STRATEGIES)


def test_an_out_that_cannot_be_written_is_told_before_the_search(
    desk: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(desk, model, desk / "transforms.json" / "out")) == 2
    captured = capsys.readouterr()
    assert "cannot write" in captured.err
    assert "searching" not in captured.out


def test_too_few_views_name_both_numbers(
    tmp_path: Path, scene: Scene, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(tmp_path / "desk", replace(scene, observations=scene.observations.select(slice(2))))
    assert main(arguments(tmp_path / "desk", model, tmp_path / "out")) == 2
    assert "needs 3 views, the scene has 2" in capsys.readouterr().err
    assert nothing_is_left(tmp_path)


def test_a_backbone_alone_finds_no_grasps(desk: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    backbone = tmp_path_factory.mktemp("models") / "backbone"
    save_model(backbone, MVNeRF(tiny_backbone()))
    with pytest.raises(UserError, match="names no grasping method"):
        command.optimize(str(desk), model=str(backbone), out=tmp_path / "out")
    assert nothing_is_left(tmp_path)


@pytest.mark.parametrize(("turn", "tilt"), [(torch.pi, 0.0), (torch.pi / 2, 90.0), (0.0, 180.0), (-3.0, 8.113)])
def test_tilt_is_the_angle_from_straight_down(turn: float, tilt: float) -> None:
    T = make_pose(roma.rotvec_to_rotmat(torch.tensor([turn, 0.0, 0.0])), torch.zeros(3))
    assert command.tilt_degrees(T) == pytest.approx(tilt, abs=0.05)


def test_the_table_is_ranked() -> None:
    T = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([[0.1, -0.2, 0.05], [0.0, 0.0, 0.1]]))
    header, first, second, note = command.table(Grasps(T, torch.tensor([3.25, 1.0])))
    assert "rank" in header
    assert first.split() == ["1", "0.100", "-0.200", "0.050", "0.0", "3.25"]
    assert second.split()[0] == "2"
    assert "one scene only" in note
