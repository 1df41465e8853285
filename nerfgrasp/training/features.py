"""Image features of a frozen backbone, made once a view."""

import torch
from torch import Tensor

from nerfgrasp.data.grasps import GraspBatch
from nerfgrasp.models import MVNeRF, SceneFeatures
from nerfgrasp.models.field import ViewMaps


class FeatureCache:
    """Gives the fine field's feature maps of a batch's views; each view is encoded once and kept in float16.

    A view is encoded by itself, so its features do not depend on the batch in which it first appeared, and a
    resumed training sees the same ones.
    """

    def __init__(self, backbone: MVNeRF, *, enabled: bool = True) -> None:
        self.backbone, self.enabled = backbone, enabled
        self._maps: dict[tuple[int, int], Tensor] = {}

    @torch.no_grad()
    def __call__(self, batch: GraspBatch) -> SceneFeatures:
        """Returns the features of the batch's B scenes, for the fine field only."""
        images, camera, box = batch.inputs.images, batch.inputs.camera(), batch.inputs.workspace()
        if not self.enabled:
            return self.backbone.observe(images, camera, box, fine_only=True)
        images, camera = self.backbone.fit_images(images, camera, box)
        keys = [[(int(s), int(v)) for v in views] for s, views in zip(batch.scene, batch.view, strict=True)]
        maps = [
            [self._one(key, image) for key, image in zip(*row, strict=True)] for row in zip(keys, images, strict=True)
        ]
        features = torch.stack([torch.stack(row) for row in maps]).float()
        return SceneFeatures(None, ViewMaps(features, images, camera, box.minimum[..., 2].flatten()))

    def _one(self, key: tuple[int, int], image: Tensor) -> Tensor:
        if key not in self._maps:
            features = self.backbone.encoder(image[None])
            self._maps[key] = self.backbone.fine.project_features(features)[0].half()
        return self._maps[key]
