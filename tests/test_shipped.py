"""What is shipped works together: the main job on the demo scene, with the default model."""

import json
import math
from pathlib import Path

import pytest

from nerfgrasp.cli import main
from nerfgrasp.methods.loading import find_method, load_method
from nerfgrasp.models import GraspValue
from nerfgrasp.models.folder import DEFAULT_MODEL, find_model, load_model, shipped_models
from nerfgrasp.scenes.folder import read_scene
from nerfgrasp.scenes.shipped import find_scene


@pytest.mark.parametrize("model", shipped_models())
def test_the_shipped_models_are_small_and_can_be_tried(model: str) -> None:
    folder = find_model(model)
    assert sum(path.stat().st_size for path in folder.iterdir()) < 8e6
    assert (folder / "README.md").is_file()
    assert callable(load_method(find_method(model)).propose)


def test_the_default_model_is_a_grasp_value() -> None:
    assert DEFAULT_MODEL in shipped_models()
    assert isinstance(load_model(DEFAULT_MODEL), GraspValue)


def test_the_demo_scene_is_drawn_from_a_seed_of_no_training_set() -> None:
    truth = read_scene(find_scene("demo")).truth
    assert truth is not None
    configs = (Path(__file__).parents[1] / "configs").rglob("*.yaml")
    assert all(f"seed: {truth.seed}" not in config.read_text() for config in configs)


def test_the_best_grasp_in_the_demo_scene_succeeds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pybullet")
    out = tmp_path / "demo"
    assert main(["optimize", "--scene", "demo", "--execute", "--out", str(out)]) == 0
    assert "success" in capsys.readouterr().out
    best = json.loads((out / "grasps.json").read_text())["grasps"][0]
    assert best["outcome"] == "success"
    assert math.isfinite(best["value"])
    assert {path.name for path in out.iterdir()} == {"grasps.json", "picture.png", "optimization.rrd"}
