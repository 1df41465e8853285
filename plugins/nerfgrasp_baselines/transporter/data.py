"""Batches for training the attention: height maps of demonstrated scenes, shifted and turned at random."""

import math
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, default_collate

from nerfgrasp.data.grasps import DemonstrationData, demonstrations
from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.streams import SceneSet
from nerfgrasp.data.views import to_float
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp_baselines.transporter.canvases import planar_pose, upright
from nerfgrasp_baselines.transporter.heights import height_map, within


class HeightBatch(NamedTuple):
    """Height maps of B scenes and where a grasp was demonstrated in each; one scene's has no leading B."""

    maps: Tensor
    """`[B, 4, H, W]`."""
    minimum: Tensor
    """`[B, 3]`: the workspaces' lower corners, metres."""
    maximum: Tensor
    """`[B, 3]`: their upper corners."""
    T_world_canvas: Tensor
    """`[B, 3, 3]`: the first canvas of each, which is what augmentation moves."""
    T_world_grasp: Tensor
    """`[B, 4, 4]`: the demonstrated grasp."""


class HeightMapData(DemonstrationData):
    """Height maps of demonstrated grasps, from packed sets with depth.

    Args:
        train: scenes with demonstrations and depth.
        validation: likewise, kept out of training.
        views: views that are fused.
        scenes_per_step: scenes in a batch.
        random_views: whether a step fuses random views of a scene, or always its first ones.
        pixel: side of a cell in metres; the network's.
        shift: metres, along x and y, by which canvases are moved at most; they are turned by any angle.
        seed: of all draws.
        workers: processes that draw batches, 0 or 1.
    """

    keeps: ClassVar[tuple[str, ...]] = ("demonstrations", "depth")

    def __init__(
        self,
        train: SceneSet,
        validation: SceneSet,
        views: int = 3,
        scenes_per_step: int = 1,
        random_views: bool = True,
        pixel: float = 0.003125,
        shift: float = 0.05,
        seed: int = 0,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.train_set, self.validation_set = train, validation
        self.views, self.scenes_per_step, self.random_views = views, scenes_per_step, random_views
        self.pixel, self.shift = pixel, shift
        self.seed, self.workers = seed, workers

    def grasps_of(self, scenes: PackedScenes) -> dict[int, Tensor]:
        """Returns the demonstrated grasps that lie on the map."""
        return _on_the_map(scenes, self.pixel)

    def draw_scene(self, scenes: PackedScenes, scene: int, generator: np.random.Generator) -> HeightBatch:
        """See `DemonstrationData`."""
        one = read_heights(scenes, scene, self.draw_views(scenes, generator), self.train_grasps[scene], self.pixel)
        half = 0.5 * float((one.maximum - one.minimum)[:2].min())
        moved = moved_canvas(one.T_world_canvas, one.T_world_grasp[:2, 3], self.shift, half, generator)
        return one._replace(T_world_canvas=moved)

    def val_dataloader(self) -> DataLoader:
        """Returns the held-out scenes, by their first views and not moved."""
        return DataLoader(HeldOutHeights(self.held_out, self.views, self.pixel), batch_size=None)

    test_dataloader = val_dataloader


class HeldOutHeights(Dataset[HeightBatch]):
    """The scenes of a set that have a demonstrated grasp, one a batch."""

    def __init__(self, scenes: PackedScenes, views: int, pixel: float) -> None:
        self.scenes, self.views, self.pixel = scenes, views, pixel
        self.grasps = list(_on_the_map(scenes, pixel).items())

    def __len__(self) -> int:
        return len(self.grasps)

    def __getitem__(self, item: int) -> HeightBatch:
        if item >= len(self):
            raise IndexError(item)
        scene, grasp = self.grasps[item]
        one = read_heights(self.scenes, scene, np.arange(self.views), grasp, self.pixel)
        batch: HeightBatch = default_collate([one])
        return batch


def _on_the_map(scenes: PackedScenes, pixel: float) -> dict[int, Tensor]:
    """Returns the demonstrated grasps by scene; those that no cell stands for are left out."""
    found = demonstrations(scenes).items()
    return {scene: grasp for scene, grasp in found if within(grasp[:2, 3], scenes.workspace_of(scene), 2 * pixel)}


def read_heights(scenes: PackedScenes, scene: int, views: np.ndarray, grasp: Tensor, pixel: float) -> HeightBatch:
    """Returns one scene as views `[V]` see it, its first canvas over the workspace's middle."""
    workspace: Workspace = scenes.workspace_of(scene)
    depth = torch.from_numpy(scenes.read_depth(scene, views))
    camera = scenes.camera(scene)[torch.from_numpy(views)]
    maps = height_map(to_float(scenes.read_images(scene, views)), depth, camera, workspace, pixel)
    return HeightBatch(maps, workspace.minimum, workspace.maximum, upright(workspace), grasp)


def moved_canvas(
    T_world_canvas: Tensor, point: Tensor, shift: float, reach: float, generator: np.random.Generator
) -> Tensor:
    """Turns a canvas by any angle and shifts it; to the network the scene moves the other way.

    Args:
        T_world_canvas: `[3, 3]`.
        point: `[2]` in the world, metres: what is to stay on the canvas.
        shift: metres along x and y at most.
        reach: the shift is left out where it would carry the point farther than this from the canvas's middle.
        generator: the source of both draws.
    """
    angle = torch.tensor(generator.uniform(-math.pi, math.pi)).to(T_world_canvas)
    offset = torch.from_numpy(generator.uniform(-shift, shift, 2)).to(T_world_canvas)
    moved = T_world_canvas @ planar_pose(angle, offset)
    if float((point - moved[:2, 2]).norm()) > reach:
        return T_world_canvas @ planar_pose(angle, torch.zeros_like(offset))
    return moved
