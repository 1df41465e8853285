"""MVNeRF: a radiance field conditioned on the images of one or several views."""

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor, nn

from nerfgrasp.geometry import Camera, box_intersection, crop_to_box
from nerfgrasp.models.encoder import Encoder, EncoderConfig
from nerfgrasp.models.field import Field, FieldConfig, ViewMaps
from nerfgrasp.models.rendering import Rendering, importance, render_rays, stratified
from nerfgrasp.models.stored import StoredModule
from nerfgrasp.scenes.scene import Workspace


@dataclass(frozen=True)
class MVNeRFConfig:
    """The network's shape. The defaults are the paper's."""

    views: int = 3
    """Images that the network sees at once: 3 is the paper's MV3, 1 its MV1 (VisionNeRF)."""
    image_size: int | None = None
    """Side in pixels of the images that the network knows: others are cut to the workspace and resampled to it. None
    takes images as they are."""
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """The image encoder."""
    coarse: FieldConfig = field(default_factory=FieldConfig)
    """The field that tells where to look closer."""
    fine: FieldConfig = field(default_factory=FieldConfig)
    """The field whose colours count and whose activations describe the scene."""
    coarse_samples: int = 64
    """Samples a ray of the coarse field."""
    fine_samples: int = 128
    """Further samples a ray of the fine field, drawn where the coarse one found something."""
    reuse_coarse_samples: bool = True
    """Whether the fine field is evaluated at the coarse samples too."""
    margin: float = 0.03
    """Metres by which the box between whose faces rays are sampled exceeds the workspace."""
    depth_range: tuple[float, float] | None = None
    """Fixed near and far distances in metres (the paper's: 0.3, 1.3) in place of the box's."""


@dataclass(frozen=True)
class SceneFeatures:
    """All that a network needs of the images of B scenes; made once, queried often."""

    coarse: ViewMaps | None
    """For the coarse field; None where only the fine one is queried."""
    fine: ViewMaps
    """For the fine field."""


class RayRenderings(NamedTuple):
    """The same rays by both fields."""

    coarse: Rendering
    """By the coarse field."""
    fine: Rendering
    """By the fine field."""


class MVNeRF(StoredModule):
    """Multi-view VisionNeRF.

    Source: the paper, section III-A, its supplementary diagrams, and VisionNeRF (Lin et al. 2023).
    """

    kind = "mvnerf"
    config_class = MVNeRFConfig
    config: MVNeRFConfig

    def __init__(self, config: MVNeRFConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.encoder)
        self.coarse = Field(config.coarse, self.encoder.channels)
        self.fine = Field(config.fine, self.encoder.channels)

    def observe(
        self, images: Tensor, camera: Camera, workspace: Workspace, *, fine_only: bool = False
    ) -> SceneFeatures:
        """Encodes the views of B scenes.

        Args:
            images: `[B, V, 3, H, W]`, RGB in [0, 1].
            camera: batch shape `[B, V]`, of the images' size.
            workspace: the box that the images are to show; corners `[3]` or `[B, 1, 3]`.
            fine_only: leave out what only rendering needs.
        """
        images, camera = self.fit_images(images, camera, workspace)
        features = self.encoder(images.flatten(0, 1))
        table = workspace.minimum[..., 2].flatten().expand(len(images))

        def maps(network: Field) -> ViewMaps:
            return ViewMaps(network.project_features(features).unflatten(0, images.shape[:2]), images, camera, table)

        return SceneFeatures(None if fine_only else maps(self.coarse), maps(self.fine))

    def fit_images(self, images: Tensor, camera: Camera, workspace: Workspace) -> tuple[Tensor, Camera]:
        """Brings images to the size that the network knows, as `MVNeRFConfig.image_size` says; arguments as above."""
        size = self.config.image_size
        if size is None or images.shape[-2:] == (size, size):
            return images, camera
        shape = images.shape[:2]
        flat = Camera(camera.intrinsics.flatten(0, 1), camera.T_world_camera.flatten(0, 1), camera.width, camera.height)
        low, high = (corner.expand(*shape, 3).flatten(0, 1) for corner in (workspace.minimum, workspace.maximum))
        cropped, near = crop_to_box(images.flatten(0, 1), flat, low, high, size)
        intrinsics, poses = near.intrinsics.unflatten(0, shape), near.T_world_camera.unflatten(0, shape)
        return cropped.unflatten(0, shape), Camera(intrinsics, poses, size, size)

    def bounds(self, minimum: Tensor, maximum: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the corners `[..., 3]` of the box in which rays are sampled, from the workspace's."""
        return minimum - self.config.margin, maximum + self.config.margin

    def render(
        self,
        features: SceneFeatures,
        origins: Tensor,
        directions: Tensor,
        workspace: Workspace,
        generator: torch.Generator | None = None,
    ) -> RayRenderings:
        """Renders rays of B scenes.

        Args:
            features: of the B scenes, from `observe`.
            origins: `[B, R, 3]` in metres, world frame.
            directions: `[B, R, 3]`, unit.
            workspace: the box; corners `[3]` or `[B, 1, 3]`.
            generator: draws the samples in training; without one they are evenly spaced.
        """
        if features.coarse is None:
            raise ValueError("these features were made with fine_only: they cannot be rendered")
        coarse_maps = features.coarse
        near, far = self._range(origins, directions, workspace)
        distances = stratified(near, far, self.config.coarse_samples, generator)
        coarse = render_rays(lambda x, q: self.coarse(coarse_maps, x, q), origins, directions, distances)
        drawn = importance(coarse, self.config.fine_samples, generator)
        if self.config.reuse_coarse_samples:
            drawn = torch.cat([drawn, distances], dim=-1)
        closer = drawn.sort(dim=-1).values
        fine = render_rays(lambda x, q: self.fine(features.fine, x, q), origins, directions, closer)
        return RayRenderings(coarse, fine)

    def activations(self, features: SceneFeatures, points: Tensor, directions: Tensor) -> list[Tensor]:
        """Returns the scene activations: of the fine field, each `[B, R, S, width]`; see `Field.activations`."""
        return self.fine.activations(features.fine, points, directions)

    def rendering_parts(self) -> list[nn.Module]:
        """Returns the parts that only renderings depend on, and no scene activation."""
        return [part for part in (self.coarse, self.fine.readout, self.fine.blend) if part is not None]

    def _range(self, origins: Tensor, directions: Tensor, workspace: Workspace) -> tuple[Tensor, Tensor]:
        if self.config.depth_range is not None:
            near, far = (torch.full_like(origins[..., 0], distance) for distance in self.config.depth_range)
            return near, far
        near, far = box_intersection(origins, directions, *self.bounds(workspace.minimum, workspace.maximum))
        return near, torch.maximum(far, near + 1e-3)
