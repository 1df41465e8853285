"""From demonstrations to a model folder, and from the folder to grasps."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

pytest.importorskip("pybullet")

from nerfgrasp_baselines.transporter.canvases import canvas_side, grasp_cell
from nerfgrasp_baselines.transporter.data import HeightMapData, read_heights
from nerfgrasp_baselines.transporter.method import Transporter
from nerfgrasp_baselines.transporter.network import Attention, TransporterConfig
from nerfgrasp_baselines.transporter.training import TransporterTraining, attention_loss

from nerfgrasp import cli
from nerfgrasp.commands.fit import shipped_configs
from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.streams import SceneSet
from nerfgrasp.errors import UserError
from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.methods.loading import find_method, load_method, method_hash
from nerfgrasp.methods.spec import MethodSpec
from nerfgrasp.models.folder import from_plain, load_model, save_model, weights_hash
from nerfgrasp.scenes.scene import Observations, Workspace
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.ranking import grasp_angle
from nerfgrasp.sim.physics import physics_hash

TINY = TransporterConfig(widths=(8, 16), blocks=1, fold=2, skips=True, rotations=6, pixel=0.0125)


@pytest.fixture(scope="module")
def folder(make_set: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set with demonstrations and depth; the last of its three scenes has no demonstration."""
    path = tmp_path_factory.mktemp("transporter") / "set"
    kept = {"demonstrations": True, "depth": True, "physics": physics_hash()}
    return make_set(path, scenes=3, views=4, size=48, **kept)


@pytest.fixture
def scene_set(folder: Path) -> SceneSet:
    return SceneSet(folder, 3, 4, 5, size=48, demonstrations=True, depth=True)


def observations(folder: Path, depth: bool = True) -> Observations:
    scenes = PackedScenes(folder)
    seen = scenes.scene(0).observations
    metres = torch.from_numpy(scenes.read_depth(0, np.arange(4))) if depth else None
    return Observations(seen.images, seen.camera, metres)


def propose(model: Attention, seen: Observations, count: int = 1) -> Any:
    return Transporter(model).propose(seen, Workspace(), generator=torch.Generator(), count=count)


def test_the_loss_picks_the_demonstrated_cell() -> None:
    logits = torch.zeros(2, 3, 3, requires_grad=True)
    with torch.no_grad():
        logits[1, 2, 0] = math.log(3.0)
        logits[0, 0, 0] = -torch.inf
    # 16 cells of weight 1, one of 3, and one that is no choice.
    loss = attention_loss(logits, torch.tensor([1, 2, 0]))
    torch.testing.assert_close(loss, torch.tensor(math.log(19 / 3)))
    loss.backward()
    assert logits.grad is not None
    assert (logits.grad < 0).nonzero().tolist() == [[1, 2, 0]]


def test_one_scene_is_learned_to_the_cell(folder: Path) -> None:
    scenes = PackedScenes(folder)
    grasp = scenes.truth(0).demonstration
    assert grasp is not None
    scene = read_heights(scenes, 0, np.arange(3), grasp, TINY.pixel)
    torch.manual_seed(0)
    network = Attention(TINY)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    losses = []
    for _ in range(60):
        logits, canvases = network.look(scene.maps, Workspace())
        loss = attention_loss(logits, grasp_cell(grasp, canvases, logits.shape[-1], TINY.pixel))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[0] > 7.0
    assert losses[-1] < 2.0
    best = propose(network, observations(folder)).T_world_grasp[0]
    assert (best[:2, 3] - grasp[:2, 3]).abs().max() <= TINY.pixel
    assert grasp_angle(best[:3, :3], grasp[:3, :3]) <= math.pi / TINY.rotations
    # The box is 80 mm high, and a grasp 15 mm below its top.
    assert abs(float(best[2, 3]) - 0.065) < 1e-3


def test_grasps_differ_come_best_first_and_clear_the_table(folder: Path) -> None:
    torch.manual_seed(0)
    grasps = propose(Attention(TINY), observations(folder), count=5)
    assert len(grasps) == 5
    assert grasps.value.tolist() == sorted(grasps.value.tolist(), reverse=True)
    lowest = ROBOTIQ_2F85.lowest(grasps.T_world_grasp)
    assert (lowest >= Limits().clearance - 1e-6).all()
    one = propose(Attention(TINY), observations(folder))
    assert len(one) == 1


def test_no_depth_no_grasp(folder: Path, scene_set: SceneSet) -> None:
    with pytest.raises(UserError, match="method 'transporter' needs depth images, and the scene has none"):
        propose(Attention(TINY), observations(folder, depth=False))
    for lacking in ("depth", "demonstrations"):
        other = SceneSet(**{**vars(scene_set), lacking: False})
        with pytest.raises(UserError, match=f"data.init_args.validation: {lacking} is false"):
            HeightMapData(scene_set, other).check()


def test_fewer_views_than_were_trained_on_are_refused(folder: Path) -> None:
    with pytest.raises(UserError, match="^the model needs 3 views, the scene has 2$"):
        propose(Attention(TINY), observations(folder).select(slice(2)))


def test_a_batch_is_a_function_of_its_generator(scene_set: SceneSet) -> None:
    data = HeightMapData(scene_set, scene_set, scenes_per_step=2, pixel=TINY.pixel)
    data.check()
    data.setup("fit")
    batch, again = (data.draw(np.random.default_rng(7)) for _ in range(2))
    assert batch.maps.shape == (2, 4, 40, 40)
    assert all(torch.equal(one, other) for one, other in zip(batch, again, strict=True))
    assert not torch.equal(batch.T_world_canvas, data.draw(np.random.default_rng(8)).T_world_canvas)
    assert len(list(data.val_dataloader())) == 2, "the scene without a demonstration is left out"


@pytest.fixture
def config(folder: Path, tmp_path: Path) -> Path:
    """What makes tn.yaml train for two steps."""
    scenes = {"folder": str(folder), "scenes": 3, "views": 4, "seed": 5, "size": 48}
    sets = {name: {**scenes, "demonstrations": True, "depth": True} for name in ("train", "validation")}
    network = {**vars(TINY), "widths": list(TINY.widths)}
    trainer = {"default_root_dir": str(tmp_path / "run"), "max_steps": 2, "val_check_interval": 2, "logger": False}
    content = {
        "model": {"init_args": {"network": network}},
        "data": {"init_args": {**sets, "pixel": TINY.pixel}},
        "trainer": {**trainer, "accelerator": "cpu", "enable_model_summary": False},
    }
    path = tmp_path / "tiny.yaml"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")
def test_fit_ends_with_a_model_folder_that_finds_grasps(
    config: Path, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["fit", "--config", "tn.yaml", "--config", str(config)]) == 0
    model = tmp_path / "run" / "model"
    assert sorted(path.name for path in model.iterdir()) == ["config.json", "model.safetensors"]
    assert find_method(str(model)) == MethodSpec("transporter", str(model))
    method: Any = load_method(MethodSpec("transporter", str(model)))
    assert method.model.config == TINY
    assert method_hash(method) == weights_hash(method.model)[:16]
    grasps = method.propose(observations(folder), Workspace(), generator=torch.Generator(), count=2)
    assert len(grasps) == 2
    args = ["fit", "--config", "tn.yaml", "--config", str(config), "--data.init_args.pixel", "0.02"]
    assert cli.main(args) == 2
    assert "data.init_args.pixel is 0.02, but the network's is 0.0125" in capsys.readouterr().err.splitlines()[-1]


def test_models_are_not_mistaken_for_each_other(tiny_network: Callable[..., Any], tmp_path: Path) -> None:
    from nerfgrasp.models import MVNeRF

    save_model(tmp_path / "backbone", MVNeRF(tiny_network()))
    with pytest.raises(UserError, match=r"config.json: no model of a known kind \(transporter\)"):
        Transporter.from_pretrained(str(tmp_path / "backbone"))
    save_model(tmp_path / "tn", Attention(TINY))
    with pytest.raises(UserError, match=r"config.json: no model of a known kind \(grasp_value, mvnerf\)"):
        load_model(tmp_path / "tn")
    again = Transporter.from_pretrained(str(tmp_path / "tn")).model
    assert again.config == TINY
    assert not again.training


@pytest.mark.parametrize("scale", ["", "laptop/"])
def test_tn_learns_from_the_demonstrations_of_mv3(scale: str) -> None:
    paths = shipped_configs([f"--config={scale}{name}.yaml" for name in ("tn", "mv3_grasp")])
    plain, other = (yaml.safe_load(Path(path.removeprefix("--config=")).read_text()) for path in paths)
    for entry in ("train", "validation"):
        scenes, same = (dict(config["data"]["init_args"][entry]) for config in (plain, other))
        assert scenes.pop("depth") is True
        assert scenes.pop("folder") != same.pop("folder")
        assert scenes == same
    with torch.device("meta"):
        network = Attention(from_plain(TransporterConfig, plain["model"].get("init_args", {}).get("network", {})))
    assert canvas_side((160, 160), network.multiple) == 224


def test_the_papers_network_has_43_layers_and_a_readout() -> None:
    with torch.device("meta"):
        network = TransporterTraining().network
        layers = {name for name, module in network.named_modules() if isinstance(module, torch.nn.Conv2d)}
        beside = {name for name in layers if name.endswith(".skip")}
        assert network(torch.zeros(2, 4, 224, 224)).shape == (2, 224, 224)
    assert len(layers) - len(beside) == 43 + 1
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in network.modules())
