from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from lightning import Callback, LightningModule, Trainer
from torch.utils.data import DataLoader

from nerfgrasp.data.rays import RayBatch
from nerfgrasp.errors import UserError
from nerfgrasp.training import callbacks
from nerfgrasp.training.callbacks import ExpectedTime, ExponentialAverage, RayRate, StopOnNotFinite, why_not_finite


class Batch(NamedTuple):
    x: torch.Tensor


class Slope(LightningModule):
    """Learns one number; a batch says how."""

    def __init__(self, loss: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> None:
        super().__init__()
        self.weight, self.loss = torch.nn.Parameter(torch.ones(())), loss

    def training_step(self, batch: Batch, batch_idx: int) -> torch.Tensor:
        return self.loss(self.weight, batch.x)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        pass

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def train(folder: Path, module: Slope, values: list[float], *more: Callback, **options: Any) -> Trainer:
    batches = DataLoader([Batch(torch.tensor(x)) for x in values], batch_size=None)
    trainer = Trainer(
        accelerator="cpu",
        max_epochs=1,
        callbacks=list(more),
        default_root_dir=folder,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        **options,
    )
    trainer.fit(module, batches, batches)
    return trainer


def test_the_expected_time_is_told_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    callback, trainer = ExpectedTime(), SimpleNamespace(global_step=100, max_steps=1921)
    callback.on_train_start(trainer, None)  # type: ignore[arg-type]
    for batch in range(201, 280):  # two batches a step
        trainer.global_step = batch // 2
        monkeypatch.setattr(callbacks.time, "monotonic", lambda now=1.0 * batch: now)
        callback.on_train_batch_end(trainer)  # type: ignore[arg-type]
    assert capsys.readouterr().out == "\n2.00 s a step: about 1.0 hours to go\n"


def test_rays_a_second_are_a_moving_figure_without_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[float] = []
    module = SimpleNamespace(log=lambda name, value, prog_bar: logged.append(value))
    callback, trainer = RayRate(), SimpleNamespace(world_size=2)
    batch = RayBatch(None, torch.zeros(3, 50, 3), None, None)  # type: ignore[arg-type]

    def step(now: float) -> None:
        monkeypatch.setattr(callbacks.time, "monotonic", lambda: now)
        callback.on_train_batch_end(trainer, module, None, batch, 0)  # type: ignore[arg-type]

    callback.on_train_start(trainer, module)  # type: ignore[arg-type]
    for second in range(4):
        step(0.5 * second)
    assert logged == [600.0] * 3  # 2 devices · 3 scenes · 50 rays in half a second
    callback.on_validation_end(trainer, module)  # type: ignore[arg-type]
    step(1000.0)
    assert len(logged) == 3
    for second in range(1, 100):
        step(1000.0 + second)
    assert logged[-1] == 300.0
    callback.on_train_batch_end(trainer, module, None, Batch(torch.zeros(())), 0)  # type: ignore[arg-type]
    assert logged[-1] == 300.0


@pytest.mark.parametrize(
    ("loss", "reason"),
    [
        (lambda weight, x: weight * x.log(), "the loss is nan"),
        (lambda weight, x: weight / x.clamp(min=0), "the loss is inf"),
        # The square root's slope at zero is infinite, and its share is nought.
        (lambda weight, x: (weight * x.clamp(min=0)).sqrt(), "the gradient's norm is nan"),
    ],
)
def test_a_training_that_is_not_finite_ends_before_harm(tmp_path: Path, loss: Any, reason: str) -> None:
    module, weights = Slope(loss), []

    class Notes(Callback):
        def on_train_batch_end(self, trainer: Trainer, module: Any, *_: object) -> None:
            weights.append(float(module.weight.detach()))

    file = tmp_path / "not-finite-step-2.pt"
    with pytest.raises(UserError) as caught:
        train(tmp_path, module, [1.0, 2.0, -1.0, 3.0], StopOnNotFinite(), Notes())
    assert str(caught.value) == f"step 2: {reason}: the training was ended; the batch is in {file}"
    assert len(weights) == 2
    assert float(module.weight.detach()) == weights[-1]
    kept = torch.load(file, weights_only=True)
    assert kept == {"step": 2, "reason": reason, "batch": {"x": torch.tensor(-1.0)}}
    assert list(tmp_path.iterdir()) == [file]
    written = file.stat().st_mtime
    assert why_not_finite(tmp_path, since=written) == f"step 2: {reason}"
    assert why_not_finite(tmp_path, since=written + 1) is None


def test_an_average_by_hand(tmp_path: Path) -> None:
    module, seen, validated = Slope(lambda weight, x: weight * x), [], []

    class Notes(Callback):
        def on_train_batch_end(self, trainer: Trainer, module: Any, *_: object) -> None:
            seen.append(float(module.weight.detach()))

        def on_validation_batch_end(self, trainer: Trainer, module: Any, *_: object) -> None:
            validated.append(float(module.weight.detach()))

    average = ExponentialAverage(0.75)
    trainer = train(tmp_path, module, [1.0, 2.0, 3.0], average, Notes(), limit_val_batches=1)
    assert seen == pytest.approx([0.9, 0.7, 0.4])
    by_hand = 0.75 * (0.75 * 0.9 + 0.25 * 0.7) + 0.25 * 0.4
    assert validated == pytest.approx([by_hand])
    assert float(module.weight.detach()) == pytest.approx(by_hand)
    trainer.save_checkpoint(tmp_path / "end.ckpt")
    state = torch.load(tmp_path / "end.ckpt", weights_only=True)["state_dict"]
    assert float(state["weight"]) == pytest.approx(by_hand)


@pytest.mark.parametrize("decay", [0.0, 1.0, -0.5, float("nan")])
def test_a_decay_out_of_range_is_refused(decay: float) -> None:
    with pytest.raises(UserError, match="ema_decay is .*: it must lie between 0 and 1"):
        ExponentialAverage(decay)
