"""Ψ(p, o): the value of a grasp, read from the scene activations of poses around its tool centre point."""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn
from torch.nn.functional import elu

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera, exact
from nerfgrasp.grippers import DEFAULT_GRIPPER, Probes, find_gripper
from nerfgrasp.models.mvnerf import MVNeRF, MVNeRFConfig, SceneFeatures
from nerfgrasp.models.stored import StoredModule
from nerfgrasp.scenes.scene import Observations, Workspace

LOSSES = ("softmax", "binary")
"""By what a grasp value may be trained."""


@dataclass(frozen=True)
class GraspValueConfig:
    """Ψ's shape. The defaults are the paper's (its supplementary diagrams)."""

    backbone: MVNeRFConfig = field(default_factory=MVNeRFConfig)
    """The network whose scene activations are read."""
    activation_width: int = 64
    """To this each scene activation is reduced."""
    pose_width: int = 64
    """To this the activations of one pose are fused."""
    hidden_width: int = 128
    """The first residual block's inner width."""
    output_width: int = 64
    """The width of what the residual blocks give."""
    symmetric: bool = False
    """Whether the value is the mean over the four orders in which a parallel gripper and its mirror images meet the
    same poses: by construction half-turned grasps are worth the same, and what is learned on one side holds on the
    other."""
    renders: bool = True
    """Whether the backbone has learned to render: if not, its density says nothing, and no search is to heed it."""
    loss: str = "softmax"
    """By what it was trained: `softmax` among a scene's poses, or `binary`, each pose by itself."""
    gripper: str = DEFAULT_GRIPPER.name
    """The gripper whose grasps the model values: a registered name or a YAML file."""
    probes: Probes | None = None
    """Where the scene is read around a TCP; None takes the gripper's probes."""


class GraspValue(StoredModule):
    """The grasp value: a small readout on an MVNeRF.

    Source: the paper, section III-B, and its supplementary diagrams.

    Raises:
        UserError: the config names an unknown loss or gripper.
    """

    kind = "grasp_value"
    config_class = GraspValueConfig
    method = "psi"
    config: GraspValueConfig
    rays: Tensor
    steps: Tensor
    orders: Tensor

    def __init__(self, config: GraspValueConfig) -> None:
        super().__init__()
        if config.loss not in LOSSES:
            raise UserError(f"loss is {config.loss!r}: it must be one of {', '.join(LOSSES)}")
        probes = config.probes
        if probes is None:
            gripper = find_gripper(config.gripper)
            probes = gripper.probes
            if gripper.name != config.gripper:  # from a file, which may not be there when the model is loaded
                config = replace(config, gripper=gripper.name, probes=probes)
        self.config = config
        self.backbone = MVNeRF(config.backbone)
        count, width = self.backbone.fine.activation_count, config.backbone.fine.width
        self.reduce = nn.ModuleList(nn.Linear(width, config.activation_width) for _ in range(count))
        self.fuse = nn.Linear(count * config.activation_width, config.pose_width)
        rays, steps = probes.rays(), probes.steps()
        poses = len(rays) * len(steps)
        self.blocks = nn.Sequential(
            ReadoutBlock(poses * config.pose_width, config.hidden_width, config.output_width),
            ReadoutBlock(config.output_width, config.output_width, config.output_width),
        )
        self.readout = nn.Linear(config.output_width, 1)
        self.register_buffer("rays", rays, persistent=False)
        self.register_buffer("steps", steps, persistent=False)
        orders = probes.mirror_orders() if config.symmetric else torch.arange(len(rays))[None]
        self.register_buffer("orders", orders, persistent=False)

    @property
    def views(self) -> int:
        """How many images the backbone sees at once."""
        return self.config.backbone.views

    def head_parameters(self) -> list[nn.Parameter]:
        """Returns the parameters that are Ψ's own, not the backbone's."""
        return [parameter for name, parameter in self.named_parameters() if not name.startswith("backbone.")]

    @torch.no_grad()
    def observe(self, observations: Observations, workspace: Workspace) -> SceneFeatures:
        """Encodes one scene's images once.

        The views are taken in groups of as many as the backbone sees at once; each group is a batch entry, and
        `value` averages over them (the paper's MV1 sees each of three images by itself). What is left over of
        the last group is not used.

        Args:
            observations: the images and their cameras.
            workspace: what they are to show.

        Raises:
            UserError: there are fewer images than the backbone sees at once.
        """
        observations.require(self.views)
        groups = len(observations) // self.views
        used = observations.select(slice(groups * self.views))
        shape = (groups, self.views)
        camera = Camera(
            used.camera.intrinsics.unflatten(0, shape),
            used.camera.T_world_camera.unflatten(0, shape),
            used.camera.width,
            used.camera.height,
        )
        return self.backbone.observe(used.images.unflatten(0, shape), camera, workspace)

    def value(self, features: SceneFeatures, T_world_grasp: Tensor) -> Tensor:
        """Returns the values `[P]` (logits, comparable within the scene) of grasps `[P, 4, 4]` in one scene."""
        groups = features.fine.images.shape[0]
        return self(features, T_world_grasp.expand(groups, *T_world_grasp.shape)).mean(dim=0)

    def density(self, features: SceneFeatures, points: Tensor, directions: Tensor) -> Tensor:
        """Returns the backbone's density `[R, S]` in 1/m at points `[R, S, 3]`, seen along directions `[R, 3]`.

        Of groups of views it is the mean.
        """
        groups = features.fine.images.shape[0]
        _, density = self.backbone.fine(
            features.fine, points.expand(groups, *points.shape), directions.expand(groups, *directions.shape)
        )
        return density.mean(dim=0)

    def forward(self, features: SceneFeatures, T_world_grasp: Tensor) -> Tensor:
        """Returns the values `[B, P]` of grasps `[B, P, 4, 4]` in B scenes; differentiable in the grasps."""
        points, directions = self._probes(T_world_grasp)
        return self.read(self.backbone.activations(features, points.flatten(1, 2), directions.flatten(1, 2)))

    def read(self, activations: list[Tensor]) -> Tensor:
        """Returns the values `[B, P]` from the scene activations, each `[B, P · 6, 7, width]`, of grasps' probes."""
        reduced = [elu(layer(a)) for layer, a in zip(self.reduce, activations, strict=True)]
        fused = elu(self.fuse(torch.cat(reduced, dim=-1)))
        probes = fused.view(len(fused), -1, len(self.rays), len(self.steps) * self.config.pose_width)
        flat = probes[:, :, self.orders].flatten(-2)
        return self.readout(elu(self.blocks(flat)))[..., 0].mean(dim=-1)

    @exact
    def _probes(self, T_world_grasp: Tensor) -> tuple[Tensor, Tensor]:
        """Points `[B, P, 6, 7, 3]` and directions `[B, P, 6, 3]` around grasps `[B, P, 4, 4]`."""
        T_world_ray = T_world_grasp[:, :, None] @ self.rays
        directions = T_world_ray[..., :3, 2]
        points = T_world_ray[..., None, :3, 3] + directions[..., None, :] * self.steps[:, None]
        return points, directions


class ReadoutBlock(nn.Module):
    """W_s x + W₂ elu(W₁ elu(x)), where W_s is the identity if the width stays."""

    def __init__(self, width_in: int, hidden: int, width_out: int) -> None:
        super().__init__()
        self.first = nn.Linear(width_in, hidden)
        self.second = nn.Linear(hidden, width_out)
        self.skip = nn.Identity() if width_in == width_out else nn.Linear(width_in, width_out)

    def forward(self, x: Tensor) -> Tensor:
        """Maps `[..., width_in]` to `[..., width_out]`."""
        return self.skip(x) + self.second(elu(self.first(elu(x))))
