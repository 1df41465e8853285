"""Image features of a frozen backbone, made once a view."""

from typing import NamedTuple

import torch
from torch import Tensor

from nerfgrasp.data.grasps import GraspBatch
from nerfgrasp.data.views import Views
from nerfgrasp.geometry import Camera
from nerfgrasp.models import MVNeRF, SceneFeatures
from nerfgrasp.models.field import ViewMaps
from nerfgrasp.scenes.scene import Workspace


class KeptView(NamedTuple):
    """What is kept of a view."""

    features: Tensor
    """`[h, w, width]`, float16."""
    image: Tensor | None
    """`[3, H, W]`: the image as the network sees it; None if that is the batch's own."""
    intrinsics: Tensor | None
    """`[3, 3]`, that image's."""


class FeatureCache:
    """Gives the fine field's feature maps of a batch's views; each view is encoded once and kept in float16.

    A view is encoded by itself, so its features do not depend on the batch in which it first appeared, and a
    resumed training sees the same ones. Where images are cut to the size that the network knows, that is done once too.
    """

    def __init__(self, backbone: MVNeRF, *, enabled: bool = True) -> None:
        self.backbone, self.enabled = backbone, enabled
        self._kept: dict[tuple[int, int], KeptView] = {}

    def __len__(self) -> int:
        """How many views are kept."""
        return len(self._kept)

    @torch.no_grad()
    def __call__(self, batch: GraspBatch) -> SceneFeatures:
        """Returns the features of the batch's B scenes, for the fine field only."""
        images, camera, box = batch.inputs.images, batch.inputs.camera(), batch.inputs.workspace()
        if not self.enabled:
            return self.backbone.observe(images, camera, box, fine_only=True)
        keys = [[(int(s), int(v)) for v in views] for s, views in zip(batch.scene, batch.view, strict=True)]
        kept = [self._one(key, batch.inputs, b, n) for b, row in enumerate(keys) for n, key in enumerate(row)]
        shape = batch.view.shape
        features = torch.stack([one.features for one in kept]).unflatten(0, shape).float()
        cut = [(one.image, one.intrinsics) for one in kept if one.image is not None and one.intrinsics is not None]
        if cut:
            images, intrinsics = (torch.stack(parts).unflatten(0, shape) for parts in zip(*cut, strict=True))
            camera = Camera(intrinsics, camera.T_world_camera, images.shape[-1], images.shape[-2])
        return SceneFeatures(None, ViewMaps(features, images, camera, box.minimum[..., 2].flatten()))

    def view_bytes(self, size: int) -> int:
        """Returns how much memory a view takes once it is kept, from images of `size` × `size` pixels."""
        side = self.backbone.config.image_size or size
        height, width = self.backbone.encoder.map_size(side, side)
        floats = 3 * side**2 + 9 if side != size else 0
        return 2 * height * width * self.backbone.fine.config.width + 4 * floats

    def _one(self, key: tuple[int, int], inputs: Views, scene: int, view: int) -> KeptView:
        """Returns the view at `[scene, view]` of the inputs."""
        if key not in self._kept:
            here = slice(scene, scene + 1), slice(view, view + 1)
            image, box = inputs.images[here], Workspace(inputs.minimum[here[0]], inputs.maximum[here[0]])
            seen, camera = self.backbone.fit_images(image, inputs.camera()[here], box)
            features = self.backbone.fine.project_features(self.backbone.encoder(seen[0]))[0].half()
            cut = (None, None) if seen is image else (seen[0, 0], camera.intrinsics[0, 0])
            self._kept[key] = KeptView(features, *cut)
        return self._kept[key]
