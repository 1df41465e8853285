"""Training Ψ's readout on a frozen backbone."""

from typing import Any, Literal

import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy
from torchmetrics import MeanMetric

from nerfgrasp.data.grasps import GraspBatch
from nerfgrasp.errors import UserError
from nerfgrasp.models import GraspValue, GraspValueConfig
from nerfgrasp.models.folder import load_backbone, weights_hash
from nerfgrasp.training.features import FeatureCache
from nerfgrasp.training.module import ScheduledTraining
from nerfgrasp.training.schedule import LearningRate

_STATES = {"state_dict", "current_model_state"}
"""Where a checkpoint has weights: the second only beside an average, which then is the first."""


class GraspValueTraining(ScheduledTraining):
    """Cross entropy over poses, Adam on the readout alone. The defaults are the paper's.

    Args:
        backbone: the pretrained MVNeRF: a model folder, a shipped model's name or a hub id. It stays frozen.
        activation_width: see `GraspValueConfig`, as the four that follow.
        pose_width: likewise.
        hidden_width: likewise.
        output_width: likewise.
        symmetric: likewise.
        loss: `softmax` picks the demonstrated grasp among a scene's poses; `binary` judges each pose by itself.
        learning_rate: Adam's.
        schedule: how it changes over the steps.
        cache_features: whether the image features of every view are kept in memory once they are made.
        seed: of the readout's start.
    """

    def __init__(
        self,
        backbone: str,
        activation_width: int = 64,
        pose_width: int = 64,
        hidden_width: int = 128,
        output_width: int = 64,
        symmetric: bool = False,
        loss: Literal["softmax", "binary"] = "softmax",
        learning_rate: float = 1e-4,
        schedule: LearningRate = LearningRate(warmup_steps=0, decay="constant"),
        cache_features: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__(schedule, {"loss": MeanMetric(), "top1": MeanMetric()})
        pretrained = load_backbone(backbone)
        widths = (activation_width, pose_width, hidden_width, output_width)
        config = GraspValueConfig(pretrained.config, *widths, symmetric)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = GraspValue(config)
        self.network.backbone = pretrained.requires_grad_(False).eval()
        self.backbone_hash = weights_hash(pretrained)
        self.loss, self.learning_rate = loss, learning_rate
        self.features = FeatureCache(self.network.backbone, enabled=cache_features)

    def train(self, mode: bool = True) -> "GraspValueTraining":
        """Sets the mode; the backbone stays in evaluation mode."""
        super().train(mode)
        self.network.backbone.eval()
        return self

    def training_step(self, batch: GraspBatch, batch_idx: int) -> Tensor:
        """Returns the loss of one batch of scenes."""
        values = self.network(self.features(batch), batch.T_world_grasp)
        loss = grasp_loss(values, self.loss)
        self.log("train/loss", loss.detach(), prog_bar=True)
        self.log("train/top1", _top1(values), prog_bar=True)
        return loss

    def validation_step(self, batch: GraspBatch, batch_idx: int) -> None:
        """Values a held-out scene's poses."""
        inputs = batch.inputs
        features = self.network.backbone.observe(inputs.images, inputs.camera(), inputs.workspace(), fine_only=True)
        values = self.network(features, batch.T_world_grasp)
        self.held_out["loss"].update(grasp_loss(values, self.loss))
        self.held_out["top1"].update(_top1(values))

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Returns Adam on the readout."""
        return self.adam([{"params": self.network.head_parameters(), "lr": self.learning_rate}])

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Leaves the frozen backbone's weights out and keeps their hash instead."""
        for key in _STATES & checkpoint.keys():
            state = checkpoint[key]
            checkpoint[key] = {name: value for name, value in state.items() if not _of_backbone(name)}
        checkpoint["backbone_sha256"] = self.backbone_hash

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Puts the backbone's weights back.

        Raises:
            UserError: the checkpoint was made on another backbone.
        """
        if checkpoint.get("backbone_sha256") != self.backbone_hash:
            raise UserError(
                f"the checkpoint was made on another backbone (SHA-256 {checkpoint.get('backbone_sha256')}, "
                f"this one has {self.backbone_hash})"
            )
        own = {name: value for name, value in self.state_dict().items() if _of_backbone(name)}
        for key in _STATES & checkpoint.keys():
            checkpoint[key] = {**checkpoint[key], **own}


def grasp_loss(values: Tensor, kind: str) -> Tensor:
    """Returns the loss of values `[B, P]` whose first pose is the demonstrated grasp.

    `softmax`: −log softmax(values)₀ over a scene's poses. `binary`: each pose's cross entropy, the positive
    weighted as all negatives together.
    """
    first = torch.zeros(len(values), dtype=torch.long, device=values.device)
    if kind == "softmax":
        return cross_entropy(values, first)
    labels = torch.nn.functional.one_hot(first, values.shape[1]).to(values)
    weight = torch.tensor(float(values.shape[1] - 1), device=values.device)
    return binary_cross_entropy_with_logits(values, labels, pos_weight=weight)


def _top1(values: Tensor) -> Tensor:
    return (values.detach().argmax(dim=1) == 0).float().mean()


def _of_backbone(name: str) -> bool:
    return name.startswith("network.backbone.")
