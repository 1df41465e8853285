"""Batches for training an MVNeRF: input views of scenes and rays of other views with their colours."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, default_collate

from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.streams import SceneSet, StepDataModule, check_enough
from nerfgrasp.data.views import Views, read_views
from nerfgrasp.geometry import box_intersection, pixel_rays


class RayBatch(NamedTuple):
    """Rays to be rendered from B scenes; one scene's has no leading B."""

    inputs: Views
    """Batch shape `[B, V]`."""
    origins: Tensor
    """`[B, R, 3]`, metres, world frame."""
    directions: Tensor
    """`[B, R, 3]`, unit."""
    colours: Tensor
    """`[B, R, 3]`: what other views of the scenes show there, RGB in [0, 1]."""


class ImageBatch(NamedTuple):
    """One scene's input views and one other view of it, whole."""

    inputs: Views
    """Batch shape `[1, V]`."""
    target: Views
    """The other view, batch shape `[]`."""
    objects: Tensor
    """`[H, W]` bool: where the other view shows an object."""


class RayData(StepDataModule):
    """Rays for MVNeRF from packed sets of simulated scenes.

    Args:
        train: the scenes to learn from.
        validation: scenes kept out of training; their first views are the input, the next ones the truth.
        views: input views a scene; the network's `views`.
        scenes_per_step: scenes in a batch.
        rays_per_scene: rays in each.
        target_views: other views of a scene over which its rays are spread.
        object_share: share of the rays drawn from object pixels; the rest is uniform over the workspace.
        validation_scenes: how many of the validation scenes are rendered.
        validation_targets: views rendered of each.
        seed: of all draws.
        workers: processes that draw batches, 0 or 1.
    """

    def __init__(
        self,
        train: SceneSet,
        validation: SceneSet,
        views: int = 3,
        scenes_per_step: int = 1,
        rays_per_scene: int = 512,
        target_views: int = 1,
        object_share: float = 0.0,
        validation_scenes: int = 8,
        validation_targets: int = 1,
        seed: int = 0,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.train_set, self.validation_set = train, validation
        self.views, self.scenes_per_step, self.rays_per_scene = views, scenes_per_step, rays_per_scene
        self.target_views, self.object_share = target_views, object_share
        self.validation_scenes, self.validation_targets = validation_scenes, validation_targets
        self.seed, self.workers = seed, workers

    def check(self) -> None:
        """See `StepDataModule`."""
        super().check()
        check_enough("data.init_args.train", "scenes", self.scenes_per_step, self.train_set.scenes)
        check_enough("data.init_args.train", "views", self.views + self.target_views, self.train_set.views)
        held_out_views = self.views + self.validation_targets
        check_enough("data.init_args.validation", "views", held_out_views, self.validation_set.views)

    def setup(self, stage: str) -> None:
        """Opens the sets."""
        self.train_scenes = self.train_set.open() if stage == "fit" else None
        self.held_out = self.validation_set.open()

    def draw(self, generator: np.random.Generator) -> RayBatch:
        """Returns one training batch."""
        assert self.train_scenes is not None
        chosen = generator.choice(len(self.train_scenes), self.scenes_per_step, replace=False)
        drawn = [self._draw_scene(self.train_scenes, int(scene), generator) for scene in chosen]
        batch: RayBatch = default_collate(drawn)
        return batch

    def _draw_scene(self, scenes: PackedScenes, scene: int, generator: np.random.Generator) -> RayBatch:
        order = generator.permutation(scenes.images.shape[1])
        inputs, targets = order[: self.views], order[self.views : self.views + self.target_views]
        view, y, x = self._draw_pixels(scenes, scene, targets, generator)
        pixels = torch.from_numpy(np.stack([x, y], axis=-1) + 0.5).float()
        camera = scenes.camera(scene)[torch.from_numpy(view)]
        origins, directions = (part[:, 0] for part in pixel_rays(camera, pixels[:, None]))
        colours = torch.from_numpy(scenes.images[scene][view, y, x].astype(np.float32) / 255.0)
        return RayBatch(read_views(scenes, scene, inputs), origins, directions, colours)

    def _draw_pixels(
        self, scenes: PackedScenes, scene: int, targets: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draws (view, y, x), each `[rays_per_scene]`: from objects first, then from all over the workspace."""
        on_objects = np.stack(np.nonzero(scenes.masks[scene][targets]), axis=-1)
        count = round(self.object_share * self.rays_per_scene) if len(on_objects) else 0
        chosen = on_objects[generator.integers(len(on_objects), size=count)] if count else np.zeros((0, 3), int)
        missing = self.rays_per_scene - count
        height, width = scenes.images.shape[2:4]
        # Rays that pass the workspace by teach nothing: draw several times too many and keep those that meet it.
        candidates = generator.integers((len(targets), height, width), size=(4 * missing, 3))
        camera = scenes.camera(scene)[torch.from_numpy(targets[candidates[:, 0]])]
        pixels = torch.from_numpy(candidates[:, None, :0:-1] + 0.5).float()
        origins, directions = pixel_rays(camera, pixels)
        near, far = box_intersection(origins, directions, scenes.workspace.minimum, scenes.workspace.maximum)
        meets = (far > near)[:, 0].numpy()
        ordered = np.concatenate([candidates[meets], candidates[~meets]])[:missing]
        view, y, x = np.concatenate([chosen, ordered]).T
        return targets[view], y, x

    def val_dataloader(self) -> DataLoader:
        """Returns whole images of held-out scenes."""
        scenes = min(self.validation_scenes, len(self.held_out))
        return DataLoader(HeldOutViews(self.held_out, scenes, self.views, self.validation_targets), batch_size=None)

    test_dataloader = val_dataloader


class HeldOutViews(Dataset[ImageBatch]):
    """Views of held-out scenes, each beside its scene's first views as input."""

    def __init__(self, scenes: PackedScenes, count: int, views: int, targets: int, skip: int | None = None) -> None:
        """Takes `targets` views after the first `skip` (default `views`) of each of the first `count` scenes."""
        self.scenes, self.count, self.views, self.targets = scenes, count, views, targets
        self.skip = views if skip is None else skip

    def __len__(self) -> int:
        return self.count * self.targets

    def __getitem__(self, item: int) -> ImageBatch:
        if item >= len(self):
            raise IndexError(item)
        scene, target = divmod(item, self.targets)
        target += self.skip
        inputs = default_collate([read_views(self.scenes, scene, np.arange(self.views))])
        views = read_views(self.scenes, scene, np.array([target]))
        objects = torch.from_numpy(self.scenes.masks[scene, target] > 0)
        return ImageBatch(inputs, Views(*(part[0] for part in views)), objects)
