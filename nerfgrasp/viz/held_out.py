"""Renders of held-out views as a training goes on, beside its curves."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from nerfgrasp.data.rays import ImageBatch
from nerfgrasp.files import make_folder
from nerfgrasp.geometry import depth_along_axis
from nerfgrasp.viz.figures import to_image
from nerfgrasp.viz.renderings import RenderedView, panels


class HeldOutRenders(Callback):
    """Logs what validation renders: truth, render, error and depth of the first held-out views, side by side.

    They go to TensorBoard as `held_out/N`, or, with a logger that keeps no pictures, to `renders/STEP-N.png` beside
    its files; and, where rerun is installed, to `renders.rrd` there. Without a logger nothing is kept.

    Args:
        count: of how many views.
    """

    def __init__(self, count: int = 4) -> None:
        self.count = count
        self._recording: Any = None

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Logs one view; `outputs` is what `MVNeRFTraining.validation_step` returns."""
        wanted = isinstance(batch, ImageBatch) and batch_idx < self.count and not trainer.sanity_checking
        if not wanted or not trainer.loggers or not trainer.is_global_zero:
            return
        pictures = _pictures(batch, outputs)
        beside = torch.cat(list(pictures.values()), dim=1)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                name = f"held_out/{batch_idx}"
                logger.experiment.add_image(name, beside, trainer.global_step, dataformats="HWC")
            elif logger.log_dir is not None:
                folder = Path(logger.log_dir) / "renders"
                make_folder(folder)
                to_image(beside).save(folder / f"{trainer.global_step:07d}-{batch_idx}.png")
        self._record(trainer, batch_idx, pictures)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Puts the recording on the disk."""
        if self._recording is not None:
            self._recording.flush()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Ends the recording."""
        if self._recording is not None:
            self._recording.disconnect()
            self._recording = None

    def _record(self, trainer: Trainer, number: int, pictures: Mapping[str, Tensor]) -> None:
        if find_spec("rerun") is None or trainer.log_dir is None:
            return
        from nerfgrasp.viz.recording import log_pictures, record_pictures

        if self._recording is None:
            make_folder(Path(trainer.log_dir))
            self._recording = record_pictures(Path(trainer.log_dir) / "renders.rrd")
        log_pictures(self._recording, f"held_out_{number}", pictures, trainer.global_step)


def _pictures(batch: ImageBatch, outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns pictures `[H, W, 3]` in [0, 1] by their names."""
    camera = batch.target.camera().to("cpu")
    rgb, distance, inside = (outputs[name].cpu() for name in ("rgb", "depth", "inside"))
    truth = batch.target.images.movedim(0, -1).cpu()
    view = RenderedView(camera, rgb.float(), depth_along_axis(camera, distance.float()), inside, truth)
    return {name: panel.image for name, panel in panels(view).items()}
