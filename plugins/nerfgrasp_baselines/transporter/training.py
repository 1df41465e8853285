"""Training the attention: softmax cross entropy over pixels × rotations."""

import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torch.nn.functional import cross_entropy
from torchmetrics import MeanMetric

from nerfgrasp.errors import UserError
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.ranking import grasp_angle
from nerfgrasp.training.module import ScheduledTraining, seeded
from nerfgrasp.training.schedule import LearningRate
from nerfgrasp_baselines.transporter.canvases import cell_grasps, grasp_cell
from nerfgrasp_baselines.transporter.data import HeightBatch
from nerfgrasp_baselines.transporter.network import Attention, TransporterConfig

CLOSE = 0.01, 0.26
"""Metres and radians (15°): a best cell this near to the demonstrated grasp counts as that grasp."""


class TransporterTraining(ScheduledTraining):
    """Softmax cross entropy of the demonstrated cell among all cells of all rotations, Adam.

    Source: Zeng et al. 2020, "Transporter Networks", section 4; the defaults are its.

    Args:
        network: the network's shape.
        learning_rate: Adam's.
        schedule: how it changes over the steps.
        seed: of the network's start.
    """

    def __init__(
        self,
        network: TransporterConfig = TransporterConfig(),
        learning_rate: float = 1e-4,
        schedule: LearningRate = LearningRate(warmup_steps=0, decay="constant"),
        seed: int = 0,
    ) -> None:
        super().__init__(schedule, {"loss": MeanMetric(), "close": MeanMetric()})
        self.network = seeded(seed, lambda: Attention(network))
        self.learning_rate = learning_rate

    def setup(self, stage: str) -> None:
        """Compares the cells of the data with the network's.

        Raises:
            UserError: they are of different sizes.
        """
        pixel = self.network.config.pixel
        asked = getattr(getattr(self.trainer, "datamodule", None), "pixel", pixel)
        if asked != pixel:
            raise UserError(f"data.init_args.pixel is {asked}, but the network's is {pixel}")

    def training_step(self, batch: HeightBatch, batch_idx: int) -> Tensor:
        """Returns the mean loss of a batch of scenes."""
        loss, close = self._score(batch)
        self.log("train/loss", loss.detach(), prog_bar=True)
        self.log("train/close", close, prog_bar=True)
        return loss

    def validation_step(self, batch: HeightBatch, batch_idx: int) -> None:
        """Scores held-out scenes. Their best grasp may be a good one that was not demonstrated: `close` is a floor."""
        loss, close = self._score(batch)
        self.held_out["loss"].update(loss)
        self.held_out["close"].update(close)

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Returns Adam on all weights."""
        return self.adam([{"params": list(self.network.parameters()), "lr": self.learning_rate}])

    def _score(self, batch: HeightBatch) -> tuple[Tensor, Tensor]:
        scores = [self._score_scene(HeightBatch(*parts)) for parts in zip(*batch, strict=True)]
        losses, close = zip(*scores, strict=True)
        return torch.stack(losses).mean(), torch.stack(close).float().mean()

    def _score_scene(self, scene: HeightBatch) -> tuple[Tensor, Tensor]:
        """Returns the loss of one scene, and whether its best cell is the demonstrated grasp."""
        workspace = Workspace(scene.minimum, scene.maximum)
        logits, canvases = self.network.look(scene.maps, workspace, scene.T_world_canvas)
        loss = attention_loss(logits, self._cell(scene.T_world_grasp, canvases, logits))
        best = torch.stack(torch.unravel_index(logits.detach().argmax(), logits.shape))
        T = cell_grasps(best[None], canvases, logits.shape[-1], self.network.config.pixel)[0]
        distance = (T[:2, 3] - scene.T_world_grasp[:2, 3]).norm()
        angle = grasp_angle(T[:3, :3], scene.T_world_grasp[:3, :3])
        return loss, (distance <= CLOSE[0]) & (angle <= CLOSE[1])

    def _cell(self, grasp: Tensor, canvases: Tensor, logits: Tensor) -> Tensor:
        return grasp_cell(grasp, canvases, logits.shape[-1], self.network.config.pixel)


def attention_loss(logits: Tensor, cell: Tensor) -> Tensor:
    """Returns −log softmax(logits)[cell] over all cells of all canvases.

    Args:
        logits: `[K, S, S]`, minus infinity where a cell is no choice.
        cell: `[3]` (canvas, row, column), long.
    """
    rows, columns = logits.shape[1:]
    index = (cell[0] * rows + cell[1]) * columns + cell[2]
    return cross_entropy(logits.flatten()[None], index[None])
