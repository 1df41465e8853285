"""What `fit` makes of configs that are laid over each other."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from nerfgrasp import cli
from nerfgrasp.commands import fit
from nerfgrasp.errors import UserError

# Lightning calls what jsonargparse is about to retire.
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


def printed_config(capsys: pytest.CaptureFixture[str], args: list[str]) -> dict[str, Any]:
    with pytest.raises(SystemExit) as done:
        cli.main(["fit", *args, "--print_config"])
    assert done.value.code == 0
    return yaml.safe_load(capsys.readouterr().out)


def test_a_later_config_wins_key_by_key(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "overlay.yaml"
    path.write_text(json.dumps({"trainer": {"max_steps": 7}, "data": {"init_args": {"rays_per_scene": 9}}}))
    found = printed_config(capsys, ["--config", str(config), "--config", str(path)])
    assert found["trainer"]["max_steps"] == 7
    assert found["trainer"]["val_check_interval"] == 2
    assert found["data"]["init_args"]["rays_per_scene"] == 9
    assert found["data"]["init_args"]["validation_scenes"] == 1
    path.write_text(json.dumps({"trainer": {"max_steps": 7, "max_epochs": 3}}))
    found = printed_config(capsys, ["--config", str(path), "--config", str(config)])
    assert (found["trainer"]["max_steps"], found["trainer"]["max_epochs"]) == (2, 3)
    found = printed_config(capsys, ["--config", str(config), "--trainer.max_steps", "8"])
    assert found["trainer"]["max_steps"] == 8


def test_a_laptop_config_changes_the_paper_s(capsys: pytest.CaptureFixture[str]) -> None:
    paper = printed_config(capsys, ["--config", "mv3.yaml"])
    laptop = printed_config(capsys, ["--config=mv3.yaml", "-c", "laptop/mv3.yaml"])
    for found in (paper, laptop):
        assert found["model"]["class_path"] == "nerfgrasp.training.MVNeRFTraining"
        assert found["model"]["init_args"]["network"]["views"] == 3
    network, trainer = paper["model"]["init_args"]["network"], paper["trainer"]
    assert (network["fine"]["width"], network["coarse_samples"], network["fine_samples"]) == (128, 64, 128)
    assert (trainer["max_steps"], trainer["gradient_clip_val"]) == (500_000, 1.0)
    assert paper["data"]["init_args"]["rays_per_scene"] == 512
    assert laptop["model"]["init_args"]["network"]["encoder"]["pretrained"] is False
    assert laptop["trainer"]["max_steps"] < 10_000


@pytest.mark.parametrize(
    ("overlay", "near"),
    [
        ({"modle": {"class_path": "nerfgrasp.training.MVNeRFTraining"}}, "'model'"),
        ({"trainer": {"max_stesp": 2}}, "'trainer.max_steps'"),
        ({"data": {"init_args": {"rays_per_scen": 9}}}, "'rays_per_scene'"),
        ({"model": {"init_args": {"network": {"fine": {"widht": 9}}}}}, "widht"),
    ],
)
def test_unknown_keys_in_a_config(
    config: Path, tmp_path: Path, overlay: dict[str, Any], near: str, refusal: Callable[[list[str]], str]
) -> None:
    path = tmp_path / "overlay.yaml"
    path.write_text(json.dumps(overlay))
    line = refusal(["fit", "--config", str(config), "--config", str(path)])
    assert near in line


def test_a_file_here_goes_before_a_shipped_config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = fit.shipped_configs(["--config", "mv3.yaml", "--trainer.max_steps", "2", "--config=laptop/mv3.yaml"])
    assert shipped[0] == "--config"
    assert Path(shipped[1]).parts[-2:] == ("configs", "mv3.yaml")
    assert shipped[2:4] == ["--trainer.max_steps", "2"]
    assert Path(shipped[4].removeprefix("--config=")).is_file()
    (tmp_path / "mv3.yaml").write_text("")
    assert fit.shipped_configs(["-c", "mv3.yaml"]) == ["-c", "mv3.yaml"]
    with pytest.raises(UserError, match="unknown config '/mv3.yaml'"):
        fit.shipped_configs(["--config", "/mv3.yaml"])
