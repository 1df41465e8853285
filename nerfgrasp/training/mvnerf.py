"""Pretraining an MVNeRF by reconstructing views that it has not seen."""

from dataclasses import replace

import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torchmetrics import MeanMetric

from nerfgrasp.data.rays import ImageBatch, RayBatch
from nerfgrasp.errors import UserError
from nerfgrasp.models import MVNeRF, MVNeRFConfig, render_image
from nerfgrasp.models.folder import load_backbone
from nerfgrasp.models.scores import image_scores
from nerfgrasp.training.module import ScheduledTraining, seeded
from nerfgrasp.training.schedule import LearningRate


class MVNeRFTraining(ScheduledTraining):
    """Mean squared error of the coarse and the fine rendering, Adam. The defaults are the paper's.

    Args:
        network: the network's shape.
        init_from: start from this model instead of at random: a folder, a shipped model's name or a hub id. The
            shape is then its own, and `network` is left out.
        image_size: in place of the network's, where it starts from a model; see `MVNeRFConfig`.
        learning_rate: of the fields.
        encoder_learning_rate: of the encoder.
        schedule: how both change over the steps.
        compile: whether `torch.compile` makes the encoder and the fields faster; slow to start.
        seed: of the network's start and of the samples along rays.

    Raises:
        UserError: there is no such model, or both it and a shape are given.
    """

    best_by = ("val/psnr", "max")

    def __init__(
        self,
        network: MVNeRFConfig = MVNeRFConfig(),
        init_from: str | None = None,
        image_size: int | None = None,
        learning_rate: float = 1e-4,
        encoder_learning_rate: float = 1e-5,
        schedule: LearningRate = LearningRate(),
        compile: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__(schedule, {name: MeanMetric() for name in ("psnr", "psnr_objects", "ssim")})
        self.network = seeded(seed, lambda: MVNeRF(network)) if init_from is None else _pretrained(init_from, network)
        if image_size is not None:
            self.network.config = replace(self.network.config, image_size=image_size)
        if compile:
            for part in (self.network.encoder, self.network.coarse, self.network.fine):
                part.compile()
        self.learning_rate, self.encoder_learning_rate = learning_rate, encoder_learning_rate
        self.seed = seed

    def training_step(self, batch: RayBatch, batch_idx: int) -> Tensor:
        """Returns the loss of one batch of rays."""
        coarse, fine = self.errors(batch, self._generator(batch_idx))
        self.log("train/psnr", -10.0 * fine.detach().log10(), prog_bar=True)
        self.log("train/loss", coarse.detach() + fine.detach())
        return coarse + fine

    def errors(self, batch: RayBatch, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Returns the mean squared errors of the coarse and of the fine rendering, whose sum is the loss."""
        workspace = batch.inputs.workspace()
        features = self.network.observe(batch.inputs.images, batch.inputs.camera(), workspace)
        rendered = self.network.render(features, batch.origins, batch.directions, workspace, generator)
        coarse, fine = ((part.colour - batch.colours).square().mean() for part in rendered)
        return coarse, fine

    def validation_step(self, batch: ImageBatch, batch_idx: int) -> dict[str, Tensor]:
        """Renders a whole held-out view and measures it over the workspace and over the objects.

        Returns:
            `rgb` `[H, W, 3]`, `depth` `[H, W]` and `inside` `[H, W]`, as `render_image` does.
        """
        features = self.network.observe(batch.inputs.images, batch.inputs.camera(), batch.inputs.workspace())
        rgb, depth, inside = render_image(self.network, features, batch.target.camera(), batch.target.workspace())
        for name, value in image_scores(rgb.movedim(-1, 0), batch.target.images, inside, batch.objects).items():
            self.held_out[name].update(value)
        return {"rgb": rgb, "depth": depth, "inside": inside}

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Returns Adam with a rate for the encoder and one for the fields."""
        encoder = list(self.network.encoder.parameters())
        fields = [*self.network.coarse.parameters(), *self.network.fine.parameters()]
        return self.adam(
            [
                {"params": encoder, "lr": self.encoder_learning_rate},
                {"params": fields, "lr": self.learning_rate},
            ]
        )

    def _generator(self, batch_idx: int) -> torch.Generator:
        """Returns the source of a batch's samples along rays: its own for every batch of every process."""
        every = self.trainer.accumulate_grad_batches if self._trainer else 1
        number = self.global_step * every + batch_idx % every
        return torch.Generator().manual_seed(self.seed + 1_000_003 * (number + 1) + 15_485_863 * self.global_rank)


def _pretrained(name: str, config: MVNeRFConfig) -> MVNeRF:
    if config != MVNeRFConfig():
        raise UserError("model.init_args: give network or init_from, not both: a model has its own shape")
    return load_backbone(name).train()
