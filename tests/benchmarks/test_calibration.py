import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("pybullet")
import calibration
import proposals

from nerfgrasp.models import GraspValue, GraspValueConfig
from nerfgrasp.models.folder import save_model
from nerfgrasp.scenes.oracle import valid_grasps


def test_reliability_by_hand() -> None:
    predicted = torch.tensor([0.1, 0.12, 0.92, 1.0], dtype=torch.float64)
    found = calibration.reliability(predicted, torch.tensor([False, True, True, True]))
    assert [(one["count"], one["observed"]) for one in found["curve"]] == [(2, 0.5), (2, 1.0)]
    assert [one["predicted"] for one in found["curve"]] == pytest.approx([0.11, 0.96])
    assert found["ece"] == pytest.approx(0.5 * 0.39 + 0.5 * 0.04)
    assert found["brier"] == pytest.approx((0.1**2 + 0.88**2 + 0.08**2) / 4)
    assert all(one["low"] < one["observed"] <= one["high"] for one in found["curve"])


def test_platt_s_scaling_finds_the_logit() -> None:
    generator = torch.Generator().manual_seed(0)
    values = 5 + 3 * torch.randn(20_000, generator=generator, dtype=torch.float64)
    success = torch.rand(20_000, generator=generator, dtype=torch.float64) < (0.5 * values - 2).sigmoid()
    slope, shift = calibration.platt(values, success)
    assert slope == pytest.approx(0.5, abs=0.03)
    assert shift == pytest.approx(-2, abs=0.15)


def test_platt_s_scaling_stays_finite_where_values_separate() -> None:
    values = torch.linspace(-1, 1, 20, dtype=torch.float64)
    slope, _ = calibration.platt(values, values > 0)
    assert 1 < slope < 100


def test_auc_counts_pairs_however_large_the_values() -> None:
    assert calibration.auc(torch.tensor([100.0, 102.0]), torch.tensor([101.0])) == 0.5
    assert calibration.auc(torch.tensor([100.0, 102.0]), torch.tensor([-3.0, 99.0])) == 1.0
    assert calibration.auc(torch.tensor([]), torch.tensor([1.0])) is None


def test_no_scene_too_wide_has_a_valid_grasp() -> None:
    scenes = [calibration.too_wide_scene(index) for index in range(8)]
    assert all(len(valid_grasps(scene.objects)) == 0 for scene in scenes)
    assert len({scene.objects[0].height for scene in scenes}) == 8


def row(scene: int, values: list[float], success: list[bool], best: tuple[float, float, float]) -> dict[str, Any]:
    found = {kind: {"alone": value, "weighed": -value} for kind, value in zip(calibration.KINDS, best, strict=True)}
    return {"scene": scene, "models": {"m": {"values": values, "success": success, "best": found}}}


def test_one_half_fits_and_the_other_is_measured() -> None:
    even, odd = [1.0, -1.0] * 50, [2.0, -2.0] * 50
    good = [True, False] * 50
    rows = [row(0, even, good, (3, 1, 2)), row(1, odd, good, (4, 0, 5))]
    found = calibration.measure(rows, "m", 96)
    assert found["auc_of_poses"] == 1.0
    assert found["slope"] > 2
    curves = {name: reading["curve"] for name, reading in found["readings"].items()}
    assert [one["count"] for one in curves["raw"]] == [50, 50]
    assert curves["raw"][1]["predicted"] == pytest.approx(1 / (1 + math.exp(-2)))
    assert curves["prior"][0]["predicted"] == pytest.approx(
        (1 / (1 + 96 * math.exp(-2)) + 1 / (1 + 96 * math.exp(2))) / 2
    )
    assert found["readings"]["scaled"]["ece"] < found["readings"]["raw"]["ece"]
    assert found["rejection"]["alone"] == {"empty": 1.0, "too wide": 0.5}
    assert found["rejection"]["weighed"] == {"empty": 0.0, "too wide": 0.5}
    assert "AUC 1.000" in calibration.summary("m", found)[0]
    assert len(calibration.draw({"m": found}).axes) == 1


def test_a_scene_is_tried(tmp_path: Path, tiny_network: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        proposals, "UNWEIGHED", replace(proposals.UNWEIGHED, candidates=8, keep=2, spacing=None, rounds=())
    )
    torch.manual_seed(0)
    save_model(tmp_path / "model", GraspValue(GraspValueConfig(backbone=tiny_network(image_size=32))))
    name = str(tmp_path / "model")
    found = calibration.scene_row([name], 0, proposals=1, perturbed=2)["models"][name]
    assert found["proposed"] == 1
    assert len(found["values"]) == len(found["success"]) == 3
    assert set(found["best"]) == set(calibration.KINDS)
    assert found["best"]["graspable"]["alone"] == found["values"][0]
