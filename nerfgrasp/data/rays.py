"""Batches for training an MVNeRF: input views of scenes and rays of other views with their colours."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, default_collate

from nerfgrasp.data.sources import SceneSource, check_apart, check_source, one_folder, open_source
from nerfgrasp.data.streams import SceneSet, StepDataModule
from nerfgrasp.data.views import Views, read_views
from nerfgrasp.geometry import box_intersection, crop_to_box, pixel_rays


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
    """Rays for MVNeRF from sets of simulated scenes or from folders of captured ones.

    A folder is a scene (`transforms.json` and its images) or holds scenes; it may also be a packed set. Rays pass
    the pixels of the images as they are, whatever their size. Where `train` and `validation` are one folder, the
    last `validation_targets` views of its scenes are kept out of training.

    Args:
        train: the scenes to learn from.
        validation: scenes kept out of training; their first views are the input, the next ones the truth.
        views: input views a scene; the network's `views`.
        scenes_per_step: scenes in a batch.
        rays_per_scene: rays in each.
        target_views: other views of a scene over which its rays are spread.
        object_share: share of the rays drawn from object pixels; the rest is uniform over the workspace. Captured
            scenes have no masks: there it changes nothing.
        image_size: side of the squares to which input views and those rendered in validation are cut; the
            network's `image_size`. None leaves images as they are.
        validation_scenes: how many of the validation scenes are rendered.
        validation_targets: views rendered of each.
        seed: of all draws.
        workers: processes that draw batches, 0 or 1.
    """

    def __init__(
        self,
        train: SceneSet | Path,
        validation: SceneSet | Path,
        views: int = 3,
        scenes_per_step: int = 1,
        rays_per_scene: int = 512,
        target_views: int = 1,
        object_share: float = 0.0,
        image_size: int | None = None,
        validation_scenes: int = 8,
        validation_targets: int = 1,
        seed: int = 0,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.train_set, self.validation_set = train, validation
        self.views, self.scenes_per_step, self.rays_per_scene = views, scenes_per_step, rays_per_scene
        self.target_views, self.object_share, self.image_size = target_views, object_share, image_size
        self.validation_scenes, self.validation_targets = validation_scenes, validation_targets
        self.seed, self.workers = seed, workers
        captured = not (isinstance(train, SceneSet) and isinstance(validation, SceneSet))
        self.kept_out = validation_targets if captured and one_folder(train, validation) else 0

    def check(self, stage: str = "fit") -> None:
        """See `StepDataModule`."""
        super().check(stage)
        if stage == "fit":
            alike = self.image_size is None and self.scenes_per_step > 1
            views = self.views + self.target_views + self.kept_out
            check_source("data.init_args.train", self.train_set, self.scenes_per_step, views, alike)
            check_apart(self.train_set, self.validation_set)
        views = self.views + self.validation_targets
        check_source("data.init_args.validation", self.validation_set, 1, views, alike=False)

    def setup(self, stage: str) -> None:
        """Opens the sets."""
        self.train_scenes = open_source(self.train_set) if stage == "fit" else None
        self.held_out = open_source(self.validation_set)

    def draw(self, generator: np.random.Generator) -> RayBatch:
        """Returns one training batch."""
        assert self.train_scenes is not None
        chosen = generator.choice(len(self.train_scenes), self.scenes_per_step, replace=False)
        drawn = [self._draw_scene(self.train_scenes, int(scene), generator) for scene in chosen]
        batch: RayBatch = default_collate(drawn)
        return batch

    def _draw_scene(self, scenes: SceneSource, scene: int, generator: np.random.Generator) -> RayBatch:
        every = scenes.camera(scene)
        order = generator.permutation(len(every) - self.kept_out)
        inputs, targets = order[: self.views], order[self.views : self.views + self.target_views]
        view, y, x = self._draw_pixels(scenes, scene, targets, generator)
        pixels = torch.from_numpy(np.stack([x, y], axis=-1) + 0.5).float()
        origins, directions = (part[:, 0] for part in pixel_rays(every[torch.from_numpy(view)], pixels[:, None]))
        colours = torch.from_numpy(scenes.read_colours(scene, view, y, x).astype(np.float32) / 255.0)
        return RayBatch(read_views(scenes, scene, inputs, self.image_size), origins, directions, colours)

    def _draw_pixels(
        self, scenes: SceneSource, scene: int, targets: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draws (view, y, x), each `[rays_per_scene]`: from objects first, then from all over the workspace."""
        chosen = self._draw_object_pixels(scenes, scene, targets, generator)
        missing = self.rays_per_scene - len(chosen)
        camera, workspace = scenes.camera(scene), scenes.workspace_of(scene)
        # Rays that pass the workspace by teach nothing: draw several times too many and keep those that meet it.
        candidates = generator.integers((len(targets), camera.height, camera.width), size=(4 * missing, 3))
        pixels = torch.from_numpy(candidates[:, None, :0:-1] + 0.5).float()
        origins, directions = pixel_rays(camera[torch.from_numpy(targets[candidates[:, 0]])], pixels)
        near, far = box_intersection(origins, directions, workspace.minimum, workspace.maximum)
        meets = (far > near)[:, 0].numpy()
        ordered = np.concatenate([candidates[meets], candidates[~meets]])[:missing]
        view, y, x = np.concatenate([chosen, ordered]).T
        return targets[view], y, x

    def _draw_object_pixels(
        self, scenes: SceneSource, scene: int, targets: np.ndarray, generator: np.random.Generator
    ) -> np.ndarray:
        """Draws (target, y, x) `[N, 3]`; none where no object is seen."""
        count = round(self.object_share * self.rays_per_scene)
        seen = np.stack(np.nonzero(scenes.read_masks(scene, targets)), axis=-1) if count else np.zeros((0, 3), int)
        return seen[generator.integers(len(seen), size=count)] if len(seen) else seen

    def val_dataloader(self) -> DataLoader:
        """Returns whole images of held-out scenes."""
        scenes = min(self.validation_scenes, len(self.held_out))
        skip = -self.kept_out if self.kept_out else None
        views = HeldOutViews(self.held_out, scenes, self.views, self.validation_targets, skip, self.image_size)
        return DataLoader(views, batch_size=None)

    test_dataloader = val_dataloader


class HeldOutViews(Dataset[ImageBatch]):
    """Views of held-out scenes, each beside its scene's first views as input.

    Args:
        scenes: where from.
        count: the first so many scenes.
        views: the first so many views of each are the input.
        targets: the other views of each.
        skip: they follow the first `skip` (default `views`); a negative number counts from the last view.
        size: see `read_views`.
    """

    def __init__(
        self,
        scenes: SceneSource,
        count: int,
        views: int,
        targets: int,
        skip: int | None = None,
        size: int | None = None,
    ) -> None:
        self.scenes, self.count, self.views, self.targets = scenes, count, views, targets
        self.skip = views if skip is None else skip
        self.size = size

    def __len__(self) -> int:
        return self.count * self.targets

    def __getitem__(self, item: int) -> ImageBatch:
        if item >= len(self):
            raise IndexError(item)
        scene, number = divmod(item, self.targets)
        camera = self.scenes.camera(scene)
        target = np.arange(len(camera))[self.skip :][number : number + 1]
        inputs = default_collate([read_views(self.scenes, scene, np.arange(self.views), self.size)])
        view = Views(*(part[0] for part in read_views(self.scenes, scene, target, self.size)))
        return ImageBatch(inputs, view, self._objects(scene, target))

    def _objects(self, scene: int, target: np.ndarray) -> Tensor:
        """Returns where a view shows an object, bool `[H, W]`, cut as the view is."""
        mask = torch.from_numpy(self.scenes.read_masks(scene, target) > 0)
        if self.size is None or mask.shape[-2:] == (self.size, self.size):
            return mask[0]
        camera, box = self.scenes.camera(scene)[torch.from_numpy(target)], self.scenes.workspace_of(scene)
        return crop_to_box(mask[None].float(), camera, box.minimum, box.maximum, self.size)[0][0, 0] > 0.5
