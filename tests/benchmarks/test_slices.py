from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import slices
import torch

from nerfgrasp.models import GraspValue, GraspValueConfig
from nerfgrasp.models.folder import save_model


def row(translation: float | None, rotation: float) -> slices.Row:
    means: dict[str, float | None] = {"rotation": rotation}
    means |= {} if translation is None else {"translation": 0.5}
    return {"slices": {"tx-ty": translation}, "means": means, "below": {}}


def test_summary_and_differences_are_over_scenes() -> None:
    one, other = [row(0.5, 0.9), row(None, 0.7)], [row(0.1, 0.2), row(0.3, 0.4)]
    lines = slices.summary("pretrained", one)
    assert [line.split()[:3] for line in lines[1:3]] == [["mean", "of", "translation"], ["mean", "of", "rotation"]]
    assert "0.500  (-), 1 scenes" in lines[1]
    assert "0.800  (0.100), 2 scenes" in lines[2]
    compared = slices.differences("pretrained", one, "scratch", other)
    assert "0.000  (-), 1 scenes" in compared[1]
    assert "0.500  (0.200), 2 scenes" in compared[2]


def test_a_scene_is_measured(tmp_path: Path, tiny_network: Callable[..., Any]) -> None:
    pytest.importorskip("pybullet")
    torch.manual_seed(0)
    save_model(tmp_path / "model", GraspValue(GraspValueConfig(backbone=tiny_network(image_size=32))))
    settings = {"size": 3, "axes": "grasp", "reach": 0.1, "turn": 90.0}
    found = slices.scene_correlations(str(tmp_path / "model"), "simple", 7, 0, ["tx-ty", "ry-rz"], settings)
    assert set(found["slices"]) == {"tx-ty", "ry-rz"}
    assert set(found["means"]) == {"translation", "rotation"}
    assert all(value is not None and -1 <= value <= 1 for value in found["slices"].values())
    assert len(found["below"]) == len(slices.ERRORS)
    assert all(value is None or value >= 0 for value in found["below"].values())


def test_how_values_fall_off_is_by_the_grasp_error() -> None:
    values = torch.tensor([[5.0, 3.0], [1.0, torch.nan]])
    true = torch.tensor([[-0.0, -0.3], [-0.4, torch.nan]])
    found = slices.falling_off([(values, true), (values + 1, true)])
    assert found["0"] == pytest.approx(0.5)
    assert found["0.25"] == pytest.approx((3 + 5 + 2 + 4) / 4)
    assert found["0.5"] is None
    assert slices.falling_off([]) == {}
