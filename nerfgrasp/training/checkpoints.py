"""Checkpoints from which a run goes on exactly, whenever it was killed."""

import os
from pathlib import Path
from typing import Any, Literal

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor

from nerfgrasp.files import make_folder, remove_temporaries, replacing


class WholeCheckpoints(TorchCheckpointIO):
    """Writes a checkpoint beside its place and then moves it there.

    Lightning writes to the system's folder for temporary files; where that is another disk, the move is a copy, and
    a process killed meanwhile leaves half a checkpoint under the name of the last one.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Writes to a local path; anything else is Lightning's.

        Raises:
            UserError: it cannot be written.
        """
        if "://" in str(path) or storage_options is not None:
            super().save_checkpoint(checkpoint, path, storage_options)
            return
        file = Path(path)
        make_folder(file.parent)
        remove_temporaries(file.parent)
        with replacing(file) as temporary, temporary.open("wb") as opened:
            torch.save(checkpoint, opened)
            opened.flush()
            os.fsync(opened.fileno())


class StepCheckpoint(ModelCheckpoint):
    """Lightning's, but never between two batches of one step: what they have accumulated is in no checkpoint."""

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Saves after the last batch of a step, if it is time."""
        if (batch_idx + 1) % trainer.accumulate_grad_batches == 0:
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)


class BestCheckpoint(ModelCheckpoint):
    """Keeps `best.ckpt`, of the validation with the best measure.

    Args:
        dirpath: the folder.
        measure: as it is logged, e.g. `val/loss`.
        mode: whether the least or the most of it is best.
    """

    def __init__(self, dirpath: Path | str | None, measure: str, mode: Literal["min", "max"]) -> None:
        super().__init__(
            dirpath,
            filename="best",
            monitor=measure,
            mode=mode,
            save_on_train_epoch_end=False,
            enable_version_counter=False,
        )

    def weights(self) -> dict[str, Tensor]:
        """Returns what the module's `load_state_dict` takes."""
        checkpoint = torch.load(self.best_model_path, map_location="cpu", weights_only=True)
        weights: dict[str, Tensor] = checkpoint["state_dict"]
        return weights
