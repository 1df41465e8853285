"""Training Ψ: its readout on a frozen backbone, or all of it from scratch."""

from typing import Any, Literal

import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy
from torchmetrics import MeanMetric

from nerfgrasp.data.grasps import GraspBatch, GraspData
from nerfgrasp.errors import UserError
from nerfgrasp.models import GraspValue, GraspValueConfig, MVNeRF, MVNeRFConfig
from nerfgrasp.models.folder import load_backbone, weights_hash
from nerfgrasp.training.features import FeatureCache
from nerfgrasp.training.module import ScheduledTraining, seeded
from nerfgrasp.training.schedule import LearningRate

_STATES = {"state_dict", "current_model_state"}
"""Where a checkpoint has weights: the second only beside an average, which then is the first."""


class GraspValueTraining(ScheduledTraining):
    """Cross entropy over poses, Adam. The defaults are the paper's.

    On a pretrained backbone the readout alone learns (the paper's MV1 and MV3). Without one (its NO1 and NO3) all
    that a value depends on does, from the same start as `MVNeRFTraining`'s with the same seed; what only renderings
    read is left as it is.

    Args:
        backbone: the pretrained MVNeRF: a model folder, a shipped model's name or a hub id. It stays frozen.
        network: in its place, the shape of a backbone that is trained along.
        activation_width: see `GraspValueConfig`, as the four that follow.
        pose_width: likewise.
        hidden_width: likewise.
        output_width: likewise.
        symmetric: likewise.
        loss: `softmax` picks the demonstrated grasp among a scene's poses; `binary` judges each pose by itself.
        learning_rate: Adam's.
        encoder_learning_rate: of the encoder, where it is trained.
        schedule: how both change over the steps.
        cache_features: whether the image features of every view are kept in the device's memory once a frozen backbone
            made them.
        seed: of the start.

    Raises:
        UserError: there is no such model, or not one of it and a shape is given.
    """

    def __init__(
        self,
        backbone: str | None = None,
        network: MVNeRFConfig | None = None,
        activation_width: int = 64,
        pose_width: int = 64,
        hidden_width: int = 128,
        output_width: int = 64,
        symmetric: bool = False,
        loss: Literal["softmax", "binary"] = "softmax",
        learning_rate: float = 1e-4,
        encoder_learning_rate: float = 1e-5,
        schedule: LearningRate = LearningRate(warmup_steps=0, decay="constant"),
        cache_features: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__(schedule, {"loss": MeanMetric(), "top1": MeanMetric()})
        pretrained, shape = _start(backbone, network)
        widths = (activation_width, pose_width, hidden_width, output_width)
        config = GraspValueConfig(shape, *widths, symmetric, renders=pretrained is not None, loss=loss)
        self.network = seeded(seed, lambda: GraspValue(config))
        self.backbone_hash = None if pretrained is None else weights_hash(pretrained)
        if pretrained is None:
            for part in self.network.backbone.rendering_parts():
                part.requires_grad_(False)
        else:
            self.network.backbone = pretrained.requires_grad_(False).eval()
        self.loss, self.learning_rate, self.encoder_learning_rate = loss, learning_rate, encoder_learning_rate
        self.features = FeatureCache(self.network.backbone, enabled=cache_features)

    @property
    def frozen(self) -> bool:
        """Whether the backbone is a pretrained one."""
        return self.backbone_hash is not None

    def train(self, mode: bool = True) -> "GraspValueTraining":
        """Sets the mode; a frozen backbone stays in evaluation mode."""
        super().train(mode)
        if self.frozen:
            self.network.backbone.eval()
        return self

    def training_step(self, batch: GraspBatch, batch_idx: int) -> Tensor:
        """Returns the loss of one batch of scenes."""
        values = self.training_values(batch)
        loss = grasp_loss(values, self.loss)
        self.log("train/loss", loss.detach(), prog_bar=True)
        self.log("train/top1", _top1(values), prog_bar=True)
        return loss

    def validation_step(self, batch: GraspBatch, batch_idx: int) -> None:
        """Values a held-out scene's poses."""
        values = self.values(batch)
        self.held_out["loss"].update(grasp_loss(values, self.loss))
        self.held_out["top1"].update(_top1(values))

    def training_values(self, batch: GraspBatch) -> Tensor:
        """Returns the values `[B, P]` of a training batch's poses; a frozen backbone's features are kept in memory."""
        return self.network(self.features(batch), batch.T_world_grasp) if self.frozen else self.values(batch)

    def kept_bytes(self, data: Any, batches: int) -> int:
        """See `ScheduledTraining`: the image features of every view that is seen."""
        if not (self.frozen and self.features.enabled and isinstance(data, GraspData)):
            return 0
        scenes = data.train_set
        there = scenes.scenes * (scenes.views if data.random_views else data.views)
        seen = min(there, batches * data.scenes_per_step * data.views)
        return seen * self.features.view_bytes(scenes.size)

    def values(self, batch: GraspBatch) -> Tensor:
        """Returns the values `[B, P]` of any batch's poses."""
        inputs = batch.inputs
        features = self.network.backbone.observe(inputs.images, inputs.camera(), inputs.workspace(), fine_only=True)
        return self.network(features, batch.T_world_grasp)

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Returns Adam on the readout and, from scratch, on all that it reads."""
        head = [{"params": self.network.head_parameters(), "lr": self.learning_rate}]
        if self.frozen:
            return self.adam(head)
        backbone = self.network.backbone
        field = [parameter for parameter in backbone.fine.parameters() if parameter.requires_grad]
        encoder = {"params": list(backbone.encoder.parameters()), "lr": self.encoder_learning_rate}
        return self.adam([encoder, {"params": field, "lr": self.learning_rate}, *head])

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Leaves a frozen backbone's weights out and keeps their hash instead."""
        if not self.frozen:
            return
        for key in _STATES & checkpoint.keys():
            state = checkpoint[key]
            checkpoint[key] = {name: value for name, value in state.items() if not _of_backbone(name)}
        checkpoint["backbone_sha256"] = self.backbone_hash

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Puts a frozen backbone's weights back.

        Raises:
            UserError: the checkpoint was made on another backbone, or from scratch where this training is not.
        """
        there = checkpoint.get("backbone_sha256")
        if there != self.backbone_hash:
            made = "from scratch" if there is None else f"on another backbone (SHA-256 {there})"
            here = f"this one has {self.backbone_hash}" if self.frozen else "this training is from scratch"
            raise UserError(f"the checkpoint was made {made}; {here}")
        if not self.frozen:
            return
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


def _start(backbone: str | None, network: MVNeRFConfig | None) -> tuple[MVNeRF | None, MVNeRFConfig]:
    """Returns the pretrained backbone, if there is to be one, and the shape."""
    if network is not None and backbone is None:
        return None, network
    if backbone is None or network is not None:
        raise UserError("model.init_args: give backbone (a pretrained one) or network (a shape to train from scratch)")
    pretrained = load_backbone(backbone)
    return pretrained, pretrained.config


def _top1(values: Tensor) -> Tensor:
    return (values.detach().argmax(dim=1) == 0).float().mean()


def _of_backbone(name: str) -> bool:
    return name.startswith("network.backbone.")
