import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from lightning.pytorch.demos.boring_classes import BoringModel
from safetensors import safe_open

from nerfgrasp import cli
from nerfgrasp.commands import fit, generate
from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.errors import UserError
from nerfgrasp.models import GraspValue, MVNeRF
from nerfgrasp.models.folder import load_model, save_model, weights_hash
from nerfgrasp.scenes.folder import write_scene
from nerfgrasp.training import MVNeRFTraining

# Lightning calls what jsonargparse is about to retire.
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Path]:
    """The run's folder; what lies in it may be large, so it goes at once."""
    yield tmp_path / "run"
    shutil.rmtree(tmp_path / "run", ignore_errors=True)


def set_entry(folder: Path, **changes: Any) -> dict[str, Any]:
    return {"folder": str(folder), "scenes": 4, "views": 6, "seed": 5, "size": 32, **changes}


@pytest.fixture
def config(packed_set: Path, tiny_network: Callable[..., Any], run: Path, tmp_path: Path) -> Path:
    """A config that trains a tiny network for two steps."""
    scenes = set_entry(packed_set)
    data = {"train": scenes, "validation": scenes, "rays_per_scene": 8, "validation_scenes": 1}
    content = {
        "model": {
            "class_path": "nerfgrasp.training.MVNeRFTraining",
            "init_args": {"network": asdict(tiny_network())},
        },
        "data": {"class_path": "nerfgrasp.data.rays.RayData", "init_args": data},
        "trainer": {
            "default_root_dir": str(run),
            "accelerator": "cpu",
            "logger": False,
            "max_steps": 2,
            "val_check_interval": 2,
            "enable_model_summary": False,
        },
    }
    path = tmp_path / "tiny.yaml"
    path.write_text(json.dumps(content))
    return path


def refusal(capsys: pytest.CaptureFixture[str], args: list[str]) -> str:
    """Runs a command that must be refused, and returns its one line."""
    capsys.readouterr()
    assert cli.main(args) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if line.startswith("nerfgrasp: error: ")] == lines[-1:]
    assert not any("Traceback" in line for line in lines)
    return lines[-1].removeprefix("nerfgrasp: error: ")


def printed_config(capsys: pytest.CaptureFixture[str], args: list[str]) -> dict[str, Any]:
    with pytest.raises(SystemExit) as done:
        cli.main(["fit", *args, "--print_config"])
    assert done.value.code == 0
    return yaml.safe_load(capsys.readouterr().out)


def test_the_paper_s_own_network_trains(packed_set: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenes = json.dumps(set_entry(packed_set))
    options = {
        "--trainer.max_steps": "2",
        "--trainer.default_root_dir": str(run),
        "--trainer.accelerator": "cpu",
        "--checkpoint.save_last": "false",
        "--model.init_args.network.encoder.pretrained": "false",
        "--model.init_args.network.coarse_samples": "4",
        "--model.init_args.network.fine_samples": "4",
        "--data.init_args.train": scenes,
        "--data.init_args.validation": scenes,
        "--data.init_args.rays_per_scene": "8",
    }
    assert cli.main(["fit", "--config", "mv3.yaml", *(part for option in options.items() for part in option)]) == 0
    assert f"2 steps; data of 0.0002 GB; the run's folder is {run}" in capsys.readouterr().out
    network = json.loads((run / "model" / "config.json").read_text())["config"]
    assert (network["views"], network["encoder"]["vit"]) == (3, "vit_base_patch16_224")
    with safe_open(run / "model" / "model.safetensors", "pt") as weights:
        shapes = {name: tuple(weights.get_slice(name).get_shape()) for name in weights.keys()}  # noqa: SIM118
    assert shapes["encoder.vit.blocks.11.mlp.fc1.weight"] == (3072, 768)
    assert shapes["fine.feature_layer.weight"] == (128, 256, 1, 1)
    assert shapes["fine.fused_trunk.2.second.weight"] == shapes["coarse.view_trunk.2.first.weight"] == (128, 128)


def test_a_run_that_is_resumed_ends_as_an_unbroken_one(config: Path, run: Path) -> None:
    args = ["fit", "--config", str(config)]
    assert cli.main([*args, "--trainer.max_steps", "4"]) == 0
    unbroken = (run / "model" / "model.safetensors").read_bytes()
    shutil.rmtree(run)

    assert cli.main(args) == 0
    half = load_model(run / "model")
    assert isinstance(half, MVNeRF)
    assert (run / "model" / "model.safetensors").read_bytes() != unbroken
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["last.ckpt"]
    assert cli.main([*args, "--trainer.max_steps", "4", "--ckpt_path", "last"]) == 0
    assert (run / "model" / "model.safetensors").read_bytes() == unbroken


@pytest.fixture
def logged(tmp_path: Path) -> Path:
    """An overlay: all that a run which is killed goes through, every loss written down at once."""
    logger = {
        "class_path": "lightning.pytorch.loggers.CSVLogger",
        "init_args": {"save_dir": str(tmp_path / "run"), "flush_logs_every_n_steps": 1},
    }
    content = {
        "ema_decay": 0.5,
        "checkpoint": {"every_n_train_steps": 2},
        "data": {"init_args": {"workers": 1}},
        "trainer": {
            "logger": logger,
            "log_every_n_steps": 1,
            "accumulate_grad_batches": 2,
            "val_check_interval": 6,
            "max_steps": 1_000_000,
        },
    }
    path = tmp_path / "logged.yaml"
    path.write_text(json.dumps(content))
    return path


def losses(log: Path) -> dict[int, str]:
    with log.open() as file:
        return {int(row["step"]): row["train/loss"] for row in csv.DictReader(file) if row.get("train/loss")}


def test_a_run_that_is_killed_goes_on_as_if_it_had_not_been(
    config: Path, logged: Path, run: Path, tmp_path: Path
) -> None:
    args = ["fit", "--config", str(config), "--config", str(logged)]
    logs = [run / "lightning_logs" / f"version_{version}" / "metrics.csv" for version in (0, 1)]
    process = subprocess.Popen(
        [sys.executable, "-m", "nerfgrasp", *args], stdout=subprocess.DEVNULL, start_new_session=True
    )
    try:
        while process.poll() is None and not (logs[0].exists() and len(logs[0].read_text().splitlines()) > 9):
            time.sleep(0.02)
        assert process.poll() is None, "it must be killed at work"
        process.kill()
        process.wait()
    finally:
        with suppress(ProcessLookupError):  # the worker goes by itself, but takes a while
            os.killpg(process.pid, signal.SIGKILL)
    newest = max((run / "checkpoints").glob("last*.ckpt"), key=lambda path: path.stat().st_mtime)
    done = torch.load(newest, weights_only=True)["global_step"]
    killed = losses(logs[0])
    killed.popitem()  # it may be half-written

    steps = ["--trainer.max_steps", str(done + 3)]
    assert cli.main([*args, *steps, "--ckpt_path", "last"]) == 0
    resumed, model = losses(logs[1]), (run / "model" / "model.safetensors").read_bytes()
    assert list(resumed) == [done, done + 1, done + 2]
    shutil.rmtree(run)
    assert cli.main([*args, *steps]) == 0
    unbroken = losses(logs[0])
    assert list(unbroken) == list(range(done + 3))
    assert resumed == {step: unbroken[step] for step in resumed}
    common = killed.keys() & unbroken.keys()
    assert {step: killed[step] for step in common} == {step: unbroken[step] for step in common}
    assert len(set(unbroken.values())) == len(unbroken)
    assert (run / "model" / "model.safetensors").read_bytes() == model

    # What is exported is the average that the checkpoint holds, not the weights that go on learning.
    last = torch.load(max((run / "checkpoints").glob("last*.ckpt")), weights_only=True)
    assert not torch.equal(*(last[key]["network.fine.readout.weight"] for key in ("state_dict", "current_model_state")))


def test_numbers_that_are_not_finite_end_a_run_and_spoil_nothing(
    config: Path, run: Path, make_set: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = ["fit", "--config", str(config), "--checkpoint.every_n_train_steps", "1"]
    assert cli.main(args) == 0
    before = {path: path.read_bytes() for folder in ("checkpoints", "model") for path in (run / folder).iterdir()}
    broken = make_set(tmp_path / "broken")
    np.load(broken / "T_world_camera.npy", mmap_mode="r+")[:] = np.nan
    scenes = json.dumps(set_entry(broken))
    more = ["--trainer.max_steps", "4", "--ckpt_path", "last", "--data.init_args.train", scenes]
    line = refusal(capsys, [*args, *more])
    file = run / "not-finite-step-2.pt"
    assert line == f"step 2: the loss is nan: the training was ended; the batch is in {file}"
    kept = torch.load(file, weights_only=True)
    assert kept["batch"]["origins"].isnan().all()
    assert kept["batch"]["inputs"]["images"].shape == (1, 3, 3, 32, 32)
    after = {path: path.read_bytes() for folder in ("checkpoints", "model") for path in (run / folder).iterdir()}
    assert after == before


def test_half_precision_accumulated(config: Path, run: Path) -> None:
    options = [
        "--trainer.precision",
        "bf16-mixed",
        "--trainer.accumulate_grad_batches",
        "2",
        "--trainer.max_steps",
        "1",
    ]
    assert cli.main(["fit", "--config", str(config), *options]) == 0
    state = torch.load(next((run / "checkpoints").iterdir()), weights_only=True)
    weights = load_model(run / "model").state_dict()
    assert state["global_step"] == 1
    assert all(value.isfinite().all() for value in weights.values())
    with safe_open(run / "model" / "model.safetensors", "pt") as file:
        assert file.get_tensor("fine.readout.weight").dtype == torch.float32


def test_a_checkpoint_is_validated_on_the_held_out_set_alone(
    config: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["fit", "--config", str(config)]) == 0
    nowhere = json.dumps(set_entry(tmp_path / "nowhere"))
    checkpoint = str(run / "checkpoints" / "last.ckpt")
    capsys.readouterr()
    args = ["validate", "--config", str(config), "--data.init_args.train", nowhere, "--ckpt_path", checkpoint]
    assert cli.main(args) == 0
    assert "val/psnr_objects" in capsys.readouterr().out
    assert not (tmp_path / "nowhere").exists()


def test_a_model_goes_on_learning_from_captures(
    config: Path, run: Path, tiny_network: Callable[..., Any], packed_set: Path, tmp_path: Path, capsys: Any
) -> None:
    torch.manual_seed(3)
    start = MVNeRF(tiny_network())
    save_model(tmp_path / "start", start)
    for index, name in enumerate(("cup", "bowl")):
        write_scene(tmp_path / "captures" / name, PackedScenes(packed_set).scene(index))
    captures = str(tmp_path / "captures")
    options = {
        "--data.init_args.train": captures,
        "--data.init_args.validation": captures,
        "--data.init_args.rays_per_scene": "8",
        "--data.init_args.target_views": "1",
        "--data.init_args.image_size": "24",
        "--model.init_args.init_from": str(tmp_path / "start"),
        "--model.init_args.image_size": "24",
        "--trainer.default_root_dir": str(run),
        "--trainer.accelerator": "cpu",
        "--trainer.logger": "false",
        "--trainer.max_steps": "1",
        "--trainer.val_check_interval": "1",
    }
    args = ["fit", "--config", "adapt.yaml", *(part for option in options.items() for part in option)]
    assert cli.main(args) == 0
    model = load_model(run / "model")
    assert isinstance(model, MVNeRF)
    assert model.config == replace(start.config, image_size=24)
    moved = {
        name: float((one - other).abs().max())
        for (name, one), other in zip(model.state_dict().items(), start.state_dict().values(), strict=True)
    }
    assert 0.0 < max(moved.values()) < 1e-3, "one step away from where it started"

    assert "image_size is 32, but the network's is 24" in refusal(capsys, [*args, "--data.init_args.image_size", "32"])
    line = refusal(capsys, [*args, "--data.init_args.scenes_per_step", "3"])
    assert line == "data.init_args.train: 3 scenes are needed at once, the set has 2"
    assert refusal(capsys, [*args, "--data.init_args.train", "nowhere"]) == "nowhere: no such folder"
    given = ["--config", str(config), "--model.init_args.init_from", str(tmp_path / "start")]
    assert refusal(capsys, ["fit", *given]).startswith("model.init_args: give network or init_from, not both")


@pytest.fixture
def grasp_config(config: Path, make_set: Callable[..., Path], tiny_network, tmp_path: Path) -> Path:
    """A config that trains a grasp value for two steps on the backbone in `backbone`."""
    from nerfgrasp.sim.physics import PHYSICS, physics_hash

    folder = make_set(tmp_path / "grasps", demonstrations=True, physics=physics_hash(PHYSICS))
    scenes = set_entry(folder, demonstrations=True)
    content = yaml.safe_load(config.read_text())
    negatives = {"uniform": 5, "near": 2}
    content["model"] = {
        "class_path": "nerfgrasp.training.GraspValueTraining",
        "init_args": {"backbone": str(tmp_path / "backbone"), "pose_width": 4, "hidden_width": 8},
    }
    content["data"] = {
        "class_path": "nerfgrasp.data.grasps.GraspData",
        "init_args": {"train": scenes, "validation": scenes, "negatives": negatives},
    }
    path = tmp_path / "grasp.yaml"
    path.write_text(json.dumps(content))
    torch.manual_seed(0)
    save_model(tmp_path / "backbone", MVNeRF(tiny_network()))
    return path


def test_a_grasp_value_trains_and_does_not_resume_on_another_backbone(
    grasp_config: Path, run: Path, tiny_network, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = ["fit", "--config", str(grasp_config), "--ema_decay", "0.9"]
    assert cli.main(args) == 0
    model = load_model(run / "model")
    assert isinstance(model, GraspValue)
    assert weights_hash(model.backbone) == weights_hash(load_model(tmp_path / "backbone"))
    checkpoint = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    for key in ("state_dict", "current_model_state"):
        assert checkpoint[key]
        assert not any("backbone" in name for name in checkpoint[key])
    assert cli.main([*args, "--trainer.max_steps", "3", "--ckpt_path", "last"]) == 0

    torch.manual_seed(1)
    save_model(tmp_path / "backbone", MVNeRF(tiny_network()))
    line = refusal(capsys, [*args, "--trainer.max_steps", "4", "--ckpt_path", "last"])
    assert line.startswith("the checkpoint was made on another backbone (SHA-256 ")
    line = refusal(capsys, [*args, "--model.init_args.backbone", "mv3-latpop"])
    assert line.startswith("unknown model ")


def test_a_grasp_value_from_scratch_is_resumed_to_the_byte(
    grasp_config: Path, run: Path, tiny_network, tmp_path: Path
) -> None:
    content = json.loads(grasp_config.read_text())
    content["model"]["init_args"] |= {"backbone": None, "network": asdict(tiny_network())}
    (tmp_path / "scratch.yaml").write_text(json.dumps(content))
    args = ["fit", "--config", str(tmp_path / "scratch.yaml")]
    assert cli.main([*args, "--trainer.max_steps", "3"]) == 0
    unbroken = (run / "model" / "model.safetensors").read_bytes()
    shutil.rmtree(run)
    assert cli.main([*args, "--trainer.max_steps", "1", "--trainer.val_check_interval", "1"]) == 0
    # The second time nothing is left to learn: it was killed before it wrote its model.
    for _ in range(2):
        shutil.rmtree(run / "model")
        assert cli.main([*args, "--trainer.max_steps", "3", "--ckpt_path", "last"]) == 0
        assert (run / "model" / "model.safetensors").read_bytes() == unbroken
    model = load_model(run / "model")
    assert isinstance(model, GraspValue)
    assert not model.config.renders


def test_missing_sets_are_made_before_training(
    config: Path, make_set: Callable[..., Path], run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def fake(task: str, *, out: Path, **settings: Any) -> None:
        made.append((task, out.name, settings))
        make_set(out, **{name: settings[name] for name in ("scenes", "views", "seed", "size", "demonstrations")})

    monkeypatch.setattr(generate, "generate", fake)
    sets = [json.dumps(set_entry(tmp_path / name, scenes=2, views=4)) for name in ("new", "new-held-out")]
    args = ["--data.init_args.train", sets[0], "--data.init_args.validation", sets[1]]
    assert cli.main(["fit", "--config", str(config), *args]) == 0
    settings = {"scenes": 2, "views": 4, "seed": 5, "size": 32, "demonstrations": False, "depth": False}
    assert made == [("simple", "new", settings), ("simple", "new-held-out", settings)]


def test_a_network_that_no_model_folder_can_hold_is_refused_before_it_is_trained() -> None:
    with pytest.raises(UserError, match="model: BoringModel has no `network` that a model folder can hold"):
        fit._check_inputs(BoringModel(), None)


def test_an_interrupt_ends_with_status_130(config: Path, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(MVNeRFTraining, "training_step", interrupted)
    handler = signal.getsignal(signal.SIGINT)
    try:
        assert cli.main(["fit", "--config", str(config)]) == 130
    finally:
        signal.signal(signal.SIGINT, handler)
    assert not (run / "model").exists()


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (["--config", "mv33.yaml"], "unknown config 'mv33.yaml': did you mean 'mv3.yaml'"),
        (["--config=laptp/mv3.yaml"], "unknown config 'laptp/mv3.yaml': did you mean 'laptop/mv3.yaml'"),
        (["--trainer.max_stesp", "2"], "--trainer.max_stesp"),
        (["--data.init_args.views", "1"], "data.init_args.views is 1, but the network sees 3 views"),
        (["--data.init_args.scenes_per_step", "5"], "train: 5 scenes are needed at once, the set has 4"),
        (["--data.init_args.workers", "4"], "workers is 4: it must be 0 or 1"),
        (["--ckpt_path", "nowhere.ckpt"], "--ckpt_path: no such file: nowhere.ckpt"),
        (["--model.init_args.network.encoder.vit", "vit_tiny_patch16_24"], "did you mean 'vit_tiny_patch16_224'"),
    ],
)
def test_mistakes_are_one_line(
    config: Path, run: Path, args: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert line in refusal(capsys, ["fit", "--config", str(config), *args])
    assert not run.exists()


def test_a_mistake_of_ours_keeps_its_traceback(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def faulty(self: object) -> None:
        raise ValueError("a bug")

    monkeypatch.setattr(MVNeRFTraining, "configure_optimizers", faulty)
    with pytest.raises(ValueError, match="a bug"):
        cli.main(["fit", "--config", str(config)])


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
    config: Path, tmp_path: Path, overlay: dict[str, Any], near: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "overlay.yaml"
    path.write_text(json.dumps(overlay))
    line = refusal(capsys, ["fit", "--config", str(config), "--config", str(path)])
    assert near in line


def test_a_damaged_checkpoint_is_one_line(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "half.ckpt"
    torch.save({"state_dict": {"a": torch.ones(1000)}}, path)
    path.write_bytes(path.read_bytes()[:-100])
    line = refusal(capsys, ["fit", "--config", str(config), "--ckpt_path", str(path)])
    assert line.endswith("half.ckpt is damaged or no checkpoint")


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
