"""What the trainings share: scores over held-out scenes, and Adam under a schedule."""

from collections.abc import Callable
from typing import Any, ClassVar, Literal, TypeVar

import torch
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torchmetrics import Metric, MetricCollection

from nerfgrasp.training.schedule import LearningRate

Network = TypeVar("Network")


class ScheduledTraining(LightningModule):
    """A LightningModule whose `validation_step` updates `held_out` and that steps its schedule with its optimizer.

    Args:
        schedule: how the learning rates change over the steps.
        held_out: metrics by name; logged under `val/`.
    """

    best_by: ClassVar[tuple[str, Literal["min", "max"]]] = ("val/loss", "min")
    """The measure by which validations are compared, and whether the least or the most of it is best."""

    def __init__(self, schedule: LearningRate, held_out: dict[str, Metric]) -> None:
        super().__init__()
        self.schedule = schedule
        # No compute groups: they would let metrics share what each counts by itself.
        self.held_out = MetricCollection(held_out, prefix="val/", compute_groups=False)  # type: ignore[arg-type]

    def test_step(self, batch: Any, batch_idx: int) -> None:
        """Does what `validation_step` does."""
        self.validation_step(batch, batch_idx)

    def on_validation_epoch_end(self) -> None:
        """Logs the metrics over the held-out scenes; none that nothing was measured for."""
        # Processes reduce a metric together or not at all: one may have seen an object where another has not.
        together = self.trainer.world_size > 1
        measured = {name: one for name, one in self.held_out.items() if together or one.update_called}
        self.log_dict({name: one.compute() for name, one in measured.items()}, prog_bar=True)
        self.held_out.reset()

    on_test_epoch_end = on_validation_epoch_end

    def kept_bytes(self, data: Any, batches: int) -> int:
        """Returns how much memory at most a process will come to keep of its data.

        Args:
            data: the data module.
            batches: training batches in all.
        """
        return 0

    def adam(self, groups: list[dict[str, Any]]) -> OptimizerLRScheduler:
        """Returns Adam on groups of `params`, each with its `lr`, under the schedule."""
        optimizer = torch.optim.Adam(groups)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, self.schedule)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}


def seeded(seed: int, build: Callable[[], Network]) -> Network:
    """Returns what `build` makes on the CPU with random numbers of the seed; the process's own are left as they are."""
    with torch.random.fork_rng(devices=[]):
        # Not `torch.manual_seed`: it would seed the generators of all CUDA devices as well.
        torch.default_generator.manual_seed(seed)
        return build()
