"""Trainings that are killed, fail and go on."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfgrasp import cli
from nerfgrasp.models import GraspValue, MVNeRF
from nerfgrasp.models.folder import load_model, save_model, weights_hash

# Lightning calls what jsonargparse is about to retire.
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


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
    config: Path,
    run: Path,
    make_set: Callable[..., Path],
    tmp_path: Path,
    refusal: Callable[[list[str]], str],
    set_entry: Callable[..., dict[str, Any]],
) -> None:
    args = ["fit", "--config", str(config), "--checkpoint.every_n_train_steps", "1"]
    assert cli.main(args) == 0
    before = {path: path.read_bytes() for folder in ("checkpoints", "model") for path in (run / folder).iterdir()}
    broken = make_set(tmp_path / "broken")
    np.load(broken / "T_world_camera.npy", mmap_mode="r+")[:] = np.nan
    scenes = json.dumps(set_entry(broken))
    more = ["--trainer.max_steps", "4", "--ckpt_path", "last", "--data.init_args.train", scenes]
    line = refusal([*args, *more])
    file = run / "not-finite-step-2.pt"
    assert line == f"step 2: the loss is nan: the training was ended; the batch is in {file}"
    kept = torch.load(file, weights_only=True)
    assert kept["batch"]["origins"].isnan().all()
    assert kept["batch"]["inputs"]["images"].shape == (1, 3, 3, 32, 32)
    after = {path: path.read_bytes() for folder in ("checkpoints", "model") for path in (run / folder).iterdir()}
    assert after == before


def test_a_grasp_value_trains_and_does_not_resume_on_another_backbone(
    grasp_config: Path, run: Path, tiny_network, tmp_path: Path, refusal: Callable[[list[str]], str]
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
    line = refusal([*args, "--trainer.max_steps", "4", "--ckpt_path", "last"])
    assert line.startswith("the checkpoint was made on another backbone (SHA-256 ")
    line = refusal([*args, "--model.init_args.backbone", "mv3-latpop"])
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


def test_a_damaged_checkpoint_is_one_line(config: Path, tmp_path: Path, refusal: Callable[[list[str]], str]) -> None:
    path = tmp_path / "half.ckpt"
    torch.save({"state_dict": {"a": torch.ones(1000)}}, path)
    path.write_bytes(path.read_bytes()[:-100])
    line = refusal(["fit", "--config", str(config), "--ckpt_path", str(path)])
    assert line.endswith("half.ckpt is damaged or no checkpoint")
