import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from elsewhere import DEVICE, another_device
from lightning.pytorch.utilities import move_data_to_device

from nerfgrasp.data.grasps import GraspData, Negatives
from nerfgrasp.data.streams import SceneSet
from nerfgrasp.errors import UserError
from nerfgrasp.models import GraspValue, GraspValueConfig, MVNeRF
from nerfgrasp.models.folder import load_model, save_model, weights_hash
from nerfgrasp.training import GraspValueTraining, MVNeRFTraining
from nerfgrasp.training.grasp_value import grasp_loss


def save_backbone(folder: Path, config: Any, seed: int) -> Path:
    torch.manual_seed(seed)
    save_model(folder, MVNeRF(config))
    return folder


@pytest.fixture
def backbone(tiny_network: Callable[..., Any], tmp_path: Path) -> Path:
    return save_backbone(tmp_path / "backbone", tiny_network(), 0)


@pytest.fixture
def data(packed_set: Path) -> Callable[[], GraspData]:
    scenes = SceneSet(packed_set, scenes=4, views=6, seed=5, size=32, demonstrations=True)
    negatives = Negatives(uniform=12, near=3)
    return lambda: GraspData(scenes, scenes, scenes_per_step=2, negatives=negatives, random_views=False)


def training(backbone: Path, **changes: Any) -> GraspValueTraining:
    sizes = {"activation_width": 8, "pose_width": 4, "hidden_width": 16, "output_width": 8}
    return GraspValueTraining(str(backbone), **{**sizes, "learning_rate": 3e-3, **changes})


def from_scratch(network: Any, **changes: Any) -> GraspValueTraining:
    sizes = {"activation_width": 8, "pose_width": 4, "hidden_width": 16, "output_width": 8}
    rates = {"learning_rate": 3e-3, "encoder_learning_rate": 2e-3}
    return GraspValueTraining(network=network, **{**sizes, **rates, **changes})


def test_softmax_loss_by_hand() -> None:
    values = torch.tensor([[math.log(3.0), 0.0, 0.0], [0.0, 0.0, math.log(2.0)]])
    assert float(grasp_loss(values, "softmax")) == pytest.approx(0.5 * (math.log(5 / 3) + math.log(4)))


def test_softmax_loss_takes_a_scene_s_values_up_to_a_constant() -> None:
    values = torch.randn(2, 5)
    torch.testing.assert_close(
        grasp_loss(values, "softmax"), grasp_loss(values + torch.tensor([[3.0], [-1.0]]), "softmax")
    )


def test_binary_loss_by_hand() -> None:
    values = torch.tensor([[math.log(3.0), 0.0, -math.log(3.0)]])
    # The demonstrated grasp counts twice, as both others together.
    expected = (2 * math.log(4 / 3) + math.log(2) + math.log(4 / 3)) / 3
    assert float(grasp_loss(values, "binary")) == pytest.approx(expected)


@pytest.mark.parametrize("loss", ["softmax", "binary"])
def test_training_reduces_the_loss_and_leaves_the_backbone(backbone: Path, data, fit, loss: str) -> None:
    module = training(backbone, loss=loss)
    before = weights_hash(module.network.backbone)
    trainer, losses = fit(module, data(), 30)
    values = list(losses.values())
    assert sum(values[-5:]) < 0.85 * sum(values[:5])
    assert weights_hash(module.network.backbone) == before == module.backbone_hash
    assert not any(parameter.requires_grad for parameter in module.network.backbone.parameters())
    assert 0.0 <= float(trainer.callback_metrics["val/top1"]) <= 1.0
    assert math.isfinite(trainer.callback_metrics["val/loss"])


def test_a_resumed_training_is_the_unbroken_one(backbone: Path, data, fit, tmp_path: Path) -> None:
    unbroken = training(backbone)
    _, whole = fit(unbroken, data(), 6)
    trainer, first = fit(training(backbone), data(), 3)
    trainer.save_checkpoint(tmp_path / "3.ckpt")
    resumed = training(backbone, seed=9)
    _, rest = fit(resumed, data(), 6, tmp_path / "3.ckpt")
    assert list(rest) == [4, 5, 6]
    assert {**first, **rest} == whole
    assert weights_hash(unbroken.network) == weights_hash(resumed.network)


def test_checkpoints_do_not_repeat_the_backbone(backbone: Path, data, fit, tmp_path: Path) -> None:
    module = training(backbone)
    trainer, _ = fit(module, data(), 1)
    trainer.save_checkpoint(tmp_path / "1.ckpt")
    checkpoint = torch.load(tmp_path / "1.ckpt", weights_only=True)
    assert checkpoint["backbone_sha256"] == module.backbone_hash
    assert "network.readout.weight" in checkpoint["state_dict"]
    assert not [name for name in checkpoint["state_dict"] if "backbone" in name]


def test_resuming_on_another_backbone_is_refused(backbone: Path, tiny_network, data, fit, tmp_path: Path) -> None:
    trainer, _ = fit(training(backbone), data(), 1)
    trainer.save_checkpoint(tmp_path / "1.ckpt")
    other = save_backbone(tmp_path / "other", tiny_network(), 1)
    with pytest.raises(UserError, match="the checkpoint was made on another backbone"):
        fit(training(other), data(), 2, tmp_path / "1.ckpt")


def test_a_grasp_value_s_backbone_serves_too(tiny_network: Callable[..., Any], tmp_path: Path) -> None:
    model = GraspValue(GraspValueConfig(tiny_network(views=1)))
    save_model(tmp_path / "model", model)
    module = training(tmp_path / "model")
    assert module.backbone_hash == weights_hash(model.backbone)
    assert module.network.views == 1


def test_the_backbone_stays_in_evaluation_mode(backbone: Path) -> None:
    module = training(backbone).train()
    assert module.network.training
    assert not module.network.backbone.training


def test_the_start_is_a_function_of_the_seed(backbone: Path) -> None:
    same = [training(backbone, seed=4).network.fuse.weight for _ in range(2)]
    assert torch.equal(*same)
    assert not torch.equal(same[0], training(backbone, seed=5).network.fuse.weight)


def test_a_backbone_that_is_not_there() -> None:
    with pytest.raises(UserError, match="unknown model"):
        training(Path("nowhere"))


def test_from_scratch_all_that_a_value_reads_learns_and_nothing_else(tiny_network, data, fit) -> None:
    field = replace(tiny_network().fine, blend=4)
    module = from_scratch(tiny_network(fine=field))
    before = {name: value.clone() for name, value in module.network.state_dict().items()}
    _, losses = fit(module, data(), 25)
    values = list(losses.values())
    assert sum(values[-5:]) < 0.85 * sum(values[:5])
    still = {name for name, value in module.network.state_dict().items() if torch.equal(value, before[name])}
    assert still == {name for name in before if re.match(r"backbone\.(coarse|fine\.readout|fine\.blend)\.", name)}
    learning = {id(parameter) for group in module.optimizers().param_groups for parameter in group["params"]}
    assert learning == {id(parameter) for parameter in module.parameters() if parameter.requires_grad}


def test_from_scratch_it_starts_where_a_backbone_does(tiny_network) -> None:
    scratch = from_scratch(tiny_network(), seed=4).network.backbone
    assert weights_hash(scratch) == weights_hash(MVNeRFTraining(tiny_network(), seed=4).network)


def test_from_scratch_a_resumed_training_is_the_unbroken_one(tiny_network, data, fit, tmp_path: Path) -> None:
    unbroken = from_scratch(tiny_network())
    _, whole = fit(unbroken, data(), 4)
    trainer, first = fit(from_scratch(tiny_network()), data(), 2)
    trainer.save_checkpoint(tmp_path / "2.ckpt")
    resumed = from_scratch(tiny_network(), seed=9)
    _, rest = fit(resumed, data(), 4, tmp_path / "2.ckpt")
    assert {**first, **rest} == whole
    assert weights_hash(unbroken.network) == weights_hash(resumed.network)


def test_from_scratch_and_on_a_backbone_do_not_resume_each_other(
    backbone: Path, tiny_network, data, fit, tmp_path: Path
) -> None:
    modules = {"scratch": lambda: from_scratch(tiny_network()), "frozen": lambda: training(backbone)}
    for name, module in modules.items():
        fit(module(), data(), 1)[0].save_checkpoint(tmp_path / f"{name}.ckpt")
    with pytest.raises(UserError, match="was made on another backbone .*; this training is from scratch"):
        fit(modules["scratch"](), data(), 2, tmp_path / "frozen.ckpt")
    with pytest.raises(UserError, match="was made from scratch; this one has "):
        fit(modules["frozen"](), data(), 2, tmp_path / "scratch.ckpt")


def test_what_never_learned_to_render_says_so(backbone: Path, tiny_network) -> None:
    assert training(backbone).network.config.renders
    assert not from_scratch(tiny_network()).network.config.renders


def test_a_backbone_or_a_shape_must_be_given(backbone: Path, tiny_network) -> None:
    for given in ({}, {"backbone": str(backbone), "network": tiny_network()}):
        with pytest.raises(UserError, match="give backbone .* or network"):
            GraspValueTraining(**given)


def test_the_memory_of_features_is_that_of_the_views_that_are_seen(
    backbone: Path, data: Callable[[], GraspData], tiny_network: Callable[..., Any]
) -> None:
    first, every = data(), data()
    every.random_views = True
    kept = training(backbone)
    view = kept.features.view_bytes(32)
    assert view == 2 * 16 * 16 * 16
    assert [kept.kept_bytes(first, 100), kept.kept_bytes(every, 100)] == [4 * 3 * view, 4 * 6 * view]
    assert kept.kept_bytes(every, 1) == 2 * 3 * view
    assert training(backbone, cache_features=False).kept_bytes(every, 100) == 0
    assert from_scratch(tiny_network()).kept_bytes(every, 100) == 0


def test_a_model_folder_says_by_what_loss_it_was_trained(backbone: Path, tmp_path: Path) -> None:
    for loss in ("softmax", "binary"):
        save_model(tmp_path / "head", training(backbone, loss=loss).network)
        assert load_model(tmp_path / "head").config.loss == loss
    file = tmp_path / "head" / "config.json"
    plain = json.loads(file.read_text())
    file.write_text(json.dumps({**plain, "config": {**plain["config"], "loss": "hinge"}}))
    with pytest.raises(UserError, match=r"config.json: loss is 'hinge': it must be one of softmax, binary"):
        load_model(tmp_path / "head")
    del plain["config"]["loss"]
    file.write_text(json.dumps(plain))
    assert load_model(tmp_path / "head").config.loss == "softmax", "older folders do not say"


@pytest.mark.parametrize("pretrained", [True, False])
def test_it_trains_on_another_device(pretrained: bool, backbone: Path, tiny_network: Callable[..., Any], data) -> None:
    def start() -> GraspValueTraining:
        return training(backbone) if pretrained else from_scratch(tiny_network())

    poses = data()
    poses.setup("fit")
    batch = next(iter(poses.train_dataloader()))
    here, module = grasp_loss(start().training_values(batch), "softmax"), start()
    with another_device() as send:
        send(module.network)
        for _ in range(2):  # the second time, from the features that were kept
            there = grasp_loss(module.training_values(move_data_to_device(batch, DEVICE)), "softmax")
            torch.testing.assert_close(there.cpu(), here, rtol=1e-3, atol=1e-3)
        there.backward()
        assert all(parameter.grad is not None for parameter in module.network.head_parameters())
