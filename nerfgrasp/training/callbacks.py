"""Lightning callbacks: how long and how fast, averaged weights, and an end to a training that has gone wrong."""

import math
import time
from collections import deque
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.swa_utils import get_ema_multi_avg_fn

from nerfgrasp.data.rays import RayBatch
from nerfgrasp.errors import UserError
from nerfgrasp.files import make_folder, replacing

MEASURED_STEPS = 20
"""So many steps are timed before the run's length is told, and so many make up a moving figure."""


class ExpectedTime(Callback):
    """Prints how long a run will take once its first steps are timed."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Notes where the run starts."""
        self._first, self._begin = trainer.global_step, 0.0
        self._last = trainer.global_step

    def on_train_batch_end(self, trainer: Trainer, *_: object) -> None:
        """Times steps after the first, which is slower than the rest; a step may take several batches."""
        if trainer.global_step == self._last:
            return
        self._last = trainer.global_step
        done = trainer.global_step - self._first
        if done == 1:
            self._begin = time.monotonic()
        elif done == 1 + MEASURED_STEPS and trainer.max_steps > 0:
            step = (time.monotonic() - self._begin) / MEASURED_STEPS
            hours = step * (trainer.max_steps - trainer.global_step) / 3600
            print(f"\n{step:.2f} s a step: about {hours:.1f} hours to go", flush=True)


class RayRate(Callback):
    """Logs `train/rays_per_s`: rays over all devices in the last `MEASURED_STEPS` batches; validation does not count.

    Batches without rays are passed over.
    """

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts counting."""
        self._ends: deque[float] = deque(maxlen=MEASURED_STEPS + 1)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts again, so that the time of validation is left out."""
        self.on_train_start(trainer, pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Notes when a batch was done."""
        if not isinstance(batch, RayBatch):
            return
        self._ends.append(time.monotonic())
        passed = self._ends[-1] - self._ends[0]
        if passed > 0:
            rays = batch.origins.shape[:-1].numel() * trainer.world_size
            pl_module.log("train/rays_per_s", rays * (len(self._ends) - 1) / passed, prog_bar=True)


class ExponentialAverage(WeightAveraging):
    """Keeps an exponential moving average of the weights: validated, checkpointed and, in the end, the result.

    Args:
        decay: w̄ ← decay · w̄ + (1 − decay) · w after every step.

    Raises:
        UserError: `decay` is not between 0 and 1.
    """

    def __init__(self, decay: float) -> None:
        if not 0.0 < decay < 1.0:
            raise UserError(f"ema_decay is {decay}: it must lie between 0 and 1")
        # This form leaves weights that do not change exactly as they are: a frozen backbone's.
        super().__init__(multi_avg_fn=get_ema_multi_avg_fn(decay))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leaves the weights alone: the last checkpoint is yet to be written, and holds both."""

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Puts the average in the weights' place."""
        super().on_train_end(trainer, pl_module)


NOT_FINITE = "not-finite-step-{}.pt"
"""Where in a run's folder `StopOnNotFinite` keeps a batch, by the step (`N-rank-R` of several devices)."""


class StopOnNotFinite(Callback):
    """Ends a training whose loss or gradient is not finite, before the weights take harm, and keeps the batch.

    It goes to `not-finite-step-N.pt` in the run's folder, to be read by `torch.load`: a dict of `step`, `reason` and
    `batch`, plain dicts of tensors. Gradients are left to the scaler where float16 needs one: it skips such steps.
    """

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Remembers the batch."""
        self._batch = batch

    def on_before_backward(self, trainer: Trainer, pl_module: LightningModule, loss: Tensor) -> None:
        """Looks at the loss.

        Raises:
            UserError: it is not finite.
        """
        self._check(trainer, "loss", float(loss.detach()))

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        """Looks at the gradient.

        Raises:
            UserError: it is not finite.
        """
        if getattr(trainer.precision_plugin, "scaler", None) is None:
            gradients = [weight.grad for weight in pl_module.parameters() if weight.grad is not None]
            self._check(trainer, "gradient's norm", float(torch.nn.utils.get_total_norm(gradients)))

    def _check(self, trainer: Trainer, what: str, value: float) -> None:
        if math.isfinite(value):
            return
        rank = f"-rank-{trainer.global_rank}" if trainer.world_size > 1 else ""
        path = Path(trainer.default_root_dir) / NOT_FINITE.format(f"{trainer.global_step}{rank}")
        reason = f"the {what} is {value}"
        make_folder(path.parent)
        with replacing(path) as temporary:
            torch.save({"step": trainer.global_step, "reason": reason, "batch": _plain(self._batch)}, temporary)
        raise UserError(f"step {trainer.global_step}: {reason}: the training was ended; the batch is in {path}")


def why_not_finite(run: Path, since: float) -> str | None:
    """Returns where and why `StopOnNotFinite` ended a training, e.g. `step 7: the loss is nan`; None if it did not.

    Args:
        run: the run's folder.
        since: what is older does not count; seconds since the epoch.
    """
    for path in run.glob(NOT_FINITE.format("*")):
        if path.stat().st_mtime >= since:
            kept = torch.load(path, map_location="cpu", weights_only=True)
            return f"step {kept['step']}: {kept['reason']}"
    return None


def _plain(batch: Any) -> Any:
    """Returns (nested) named tuples of tensors as dicts, on the CPU, to be loaded without this package's classes."""
    if isinstance(batch, Tensor):
        return batch.detach().cpu()
    return {name: _plain(value) for name, value in batch._asdict().items()}
