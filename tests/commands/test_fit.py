"""`nerfgrasp fit` and `validate` from the data to the model folder, and what they refuse."""

import json
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.demos.boring_classes import BoringModel
from safetensors import safe_open

from nerfgrasp import cli
from nerfgrasp.commands import fit, generate
from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.errors import UserError
from nerfgrasp.models import MVNeRF
from nerfgrasp.models.folder import load_model, save_model
from nerfgrasp.scenes.folder import write_scene
from nerfgrasp.training import MVNeRFTraining
from nerfgrasp.training.module import ScheduledTraining
from nerfgrasp.training.schedule import LearningRate

# Lightning calls what jsonargparse is about to retire.
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


def test_the_paper_s_own_network_trains(
    packed_set: Path, run: Path, capsys: pytest.CaptureFixture[str], set_entry: Callable[..., dict[str, Any]]
) -> None:
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


def test_the_best_weights_are_kept(config: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["fit", "--config", str(config), "--keep", "best", "--trainer.val_check_interval", "1"]
    worse = ["--model.init_args.learning_rate", "0.3", "--model.init_args.schedule", '{"warmup_steps": 1}']
    assert cli.main([*args, *worse, "--trainer.max_steps", "2"]) == 0
    assert cli.main([*args, *worse, "--trainer.max_steps", "4", "--ckpt_path", "last"]) == 0
    best, last = (torch.load(run / "checkpoints" / f"{name}.ckpt", weights_only=True) for name in ("best", "last"))
    assert best["global_step"] < last["global_step"] == 4
    for name, weight in load_model(run / "model").state_dict().items():
        assert torch.equal(weight, best["state_dict"][f"network.{name}"])
    assert "as it was where val/psnr was best" in capsys.readouterr().out


def test_the_best_of_no_validation_is_refused(config: Path, refusal: Callable[[list[str]], str]) -> None:
    args = ["fit", "--config", str(config), "--keep", "best", "--trainer.val_check_interval", "3"]
    assert refusal(args) == "keep is best, but trainer.val_check_interval (3) is more than max_steps (2)"


def test_a_checkpoint_is_validated_on_the_held_out_set_alone(
    config: Path,
    run: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    set_entry: Callable[..., dict[str, Any]],
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
    config: Path,
    run: Path,
    tiny_network: Callable[..., Any],
    packed_set: Path,
    tmp_path: Path,
    refusal: Callable[[list[str]], str],
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

    assert "image_size is 32, but the network's is 24" in refusal([*args, "--data.init_args.image_size", "32"])
    line = refusal([*args, "--data.init_args.scenes_per_step", "3"])
    assert line == "data.init_args.train: 3 scenes are needed at once, the set has 2"
    assert refusal([*args, "--data.init_args.train", "nowhere"]) == "nowhere: no such folder"
    given = ["--config", str(config), "--model.init_args.init_from", str(tmp_path / "start")]
    assert refusal(["fit", *given]).startswith("model.init_args: give network or init_from, not both")


def test_missing_sets_are_made_before_training(
    config: Path,
    make_set: Callable[..., Path],
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    set_entry: Callable[..., dict[str, Any]],
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
    config: Path, run: Path, args: list[str], line: str, refusal: Callable[[list[str]], str]
) -> None:
    assert line in refusal(["fit", "--config", str(config), *args])
    assert not run.exists()


def test_a_mistake_of_ours_keeps_its_traceback(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def faulty(self: object) -> None:
        raise ValueError("a bug")

    monkeypatch.setattr(MVNeRFTraining, "configure_optimizers", faulty)
    with pytest.raises(ValueError, match="a bug"):
        cli.main(["fit", "--config", str(config)])


def test_features_that_do_not_fit_into_memory_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Keeps(ScheduledTraining):
        def kept_bytes(self, data: Any, batches: int) -> int:
            return 1000 * batches

    trainer = Trainer(accelerator="cpu", max_steps=2_000_000, accumulate_grad_batches=2, logger=False)
    monkeypatch.setattr(fit, "memory_bytes", lambda device: 4_000_000_000)
    fit._check_memory(Keeps(LearningRate(), {}), None, trainer)
    assert capsys.readouterr().out.endswith("the views' image features are kept: 4 GB of the memory of cpu\n")
    monkeypatch.setattr(fit, "memory_bytes", lambda device: 3_900_000_000)
    with pytest.raises(UserError, match=r"features take 4 GB of memory, cpu has 3.9 GB: give --model.init_args.cache_"):
        fit._check_memory(Keeps(LearningRate(), {}), None, trainer)
