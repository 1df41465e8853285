from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ablation import change, train

from nerfgrasp.errors import UserError
from nerfgrasp.models import MVNeRF
from nerfgrasp.models.folder import save_model
from nerfgrasp.training.grasp_value import grasp_loss

pytest.importorskip("pybullet")
import head_ablation

TRAINING, DATA = "nerfgrasp.training.GraspValueTraining", "nerfgrasp.data.grasps.GraspData"


@pytest.fixture
def config(packed_set: Path, tiny_network: Callable[..., Any], tmp_path: Path) -> dict[str, Any]:
    torch.manual_seed(0)
    save_model(tmp_path / "backbone", MVNeRF(tiny_network()))
    scenes = {"folder": str(packed_set), "scenes": 4, "views": 6, "seed": 5, "size": 32, "demonstrations": True}
    widths = {"activation_width": 8, "pose_width": 4, "hidden_width": 16, "output_width": 8}
    negatives = {"uniform": 5, "near": 2, "perturbed": 2}
    return {
        "model": {
            "class_path": TRAINING,
            "init_args": {"backbone": str(tmp_path / "backbone"), "learning_rate": 3e-3, **widths},
        },
        "data": {
            "class_path": DATA,
            "init_args": {"train": scenes, "validation": scenes, "scenes_per_step": 2, "negatives": negatives},
        },
    }


def built(config: dict[str, Any], monkeypatch: pytest.MonkeyPatch, variant: str = "") -> Any:
    monkeypatch.setattr(head_ablation, "make_set", lambda scenes: None)
    training, data = head_ablation.build(change(config, variant))
    data.setup("fit")
    return training, data


def test_a_change_is_one_value_or_a_whole_mapping(config: dict[str, Any]) -> None:
    changed = change(config, "model.loss=binary  data.negatives={uniform: 8, near: 3} data.train.views=4")
    assert changed["model"]["init_args"]["loss"] == "binary"
    assert changed["data"]["init_args"]["negatives"] == {"uniform": 8, "near": 3}
    assert changed["data"]["init_args"]["train"]["views"] == 4
    assert config["data"]["init_args"]["train"]["views"] == 6
    assert change(config, "") == config


def test_a_variant_of_an_unknown_key_is_refused(config: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="losss"):
        built(config, monkeypatch, "model.losss=binary")


def test_features_are_those_of_every_view(config: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    training, data = built(config, monkeypatch)
    shared = head_ablation.features(config["model"]["init_args"]["backbone"], data.train_set.folder)
    assert len(shared) == 4 * 6
    batch = data.draw(np.random.default_rng(0))
    torch.testing.assert_close(
        shared(batch).fine.features, training.features(batch).fine.features, atol=1e-3, rtol=1e-3
    )


def test_a_variant_learns_and_is_measured_on_poses_that_are_not_its_own(
    config: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    training, data = built(config, monkeypatch, "data.negatives={uniform: 1, near: 0}")
    _, common = built(config, monkeypatch)
    asked = []

    def loss(batch: Any, step: int) -> torch.Tensor:
        asked.append(step)
        return grasp_loss(training.training_values(batch), training.loss)

    before = head_ablation.held_out(training, common)
    assert train(training, data, loss, lambda step: step / 20) == 20
    assert asked == list(range(20))
    after = head_ablation.held_out(training, common)
    assert after["loss"] < before["loss"]
    with torch.inference_mode():
        values = [training.values(batch)[0] for batch in common.val_dataloader()]
    assert [len(one) for one in values] == [10, 10, 10]
    assert after["loss"] == pytest.approx(np.mean([-float(one.log_softmax(0)[0]) for one in values]))
    assert after["top1"] == pytest.approx(np.mean([float(one[0] >= one.max()) for one in values]))
    assert after["below"] == pytest.approx(np.mean([float((one[1:] < one[0]).float().mean()) for one in values]))
