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
        if not self.enabled:
            return self.backbone.observe(batch.inputs.images, batch.inputs.camera(), fine_only=True)
        scenes = range(len(batch.scene))
        views = range(batch.view.shape[1])
        maps = torch.stack([torch.stack([self._one(batch, scene, view) for view in views]) for scene in scenes])
        return SceneFeatures(None, ViewMaps(maps.float(), batch.inputs.images, batch.inputs.camera()))

    def _one(self, batch: GraspBatch, scene: int, view: int) -> Tensor:
        key = (int(batch.scene[scene]), int(batch.view[scene, view]))
        if key not in self._maps:
            camera = batch.inputs.camera()[scene : scene + 1, view : view + 1]
            image = batch.inputs.images[scene : scene + 1, view : view + 1]
            self._maps[key] = self.backbone.observe(image, camera, fine_only=True).fine.features[0, 0].half()
        return self._maps[key]
