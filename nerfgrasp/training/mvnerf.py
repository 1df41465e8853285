"""Pretraining an MVNeRF by reconstructing views that it has not seen."""

import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torchmetrics import MeanMetric

from nerfgrasp.data.rays import ImageBatch, RayBatch
from nerfgrasp.models import MVNeRF, MVNeRFConfig, render_image
from nerfgrasp.models.scores import image_scores
from nerfgrasp.training.module import ScheduledTraining
from nerfgrasp.training.schedule import LearningRate


class MVNeRFTraining(ScheduledTraining):
    """Mean squared error of the coarse and the fine rendering, Adam. The defaults are the paper's.

    Args:
        network: the network's shape.
        learning_rate: of the fields.
        encoder_learning_rate: of the encoder.
        schedule: how both change over the steps.
        seed: of the network's start and of the samples along rays.
    """

    def __init__(
        self,
        network: MVNeRFConfig = MVNeRFConfig(),
        learning_rate: float = 1e-4,
        encoder_learning_rate: float = 1e-5,
        schedule: LearningRate = LearningRate(),
        seed: int = 0,
    ) -> None:
        super().__init__(schedule, {name: MeanMetric() for name in ("psnr", "psnr_objects", "ssim")})
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = MVNeRF(network)
        self.learning_rate, self.encoder_learning_rate = learning_rate, encoder_learning_rate
        self.seed = seed

    def training_step(self, batch: RayBatch, batch_idx: int) -> Tensor:
        """Returns the loss of one batch of rays."""
        generator = torch.Generator().manual_seed(self.seed + 1_000_003 * (self.global_step + 1))
        workspace = batch.inputs.workspace()
        features = self.network.observe(batch.inputs.images, batch.inputs.camera(), workspace)
        rendered = self.network.render(features, batch.origins, batch.directions, workspace, generator)
        coarse = (rendered.coarse.colour - batch.colours).square().mean()
        fine = (rendered.fine.colour - batch.colours).square().mean()
        self.log("train/psnr", -10.0 * fine.detach().log10(), prog_bar=True)
        self.log("train/loss", coarse.detach() + fine.detach())
        return coarse + fine

    def validation_step(self, batch: ImageBatch, batch_idx: int) -> None:
        """Renders a whole held-out view and measures it over the workspace and over the objects."""
        features = self.network.observe(batch.inputs.images, batch.inputs.camera(), batch.inputs.workspace())
        rgb, _, inside = render_image(self.network, features, batch.target.camera(), batch.target.workspace())
        for name, value in image_scores(rgb.movedim(-1, 0), batch.target.images, inside, batch.objects).items():
            self.held_out[name].update(value)

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
