"""Batches for training Ψ: a scene's demonstrated grasp among poses that are most likely none."""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import roma
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, default_collate

from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.streams import SceneSet, StepDataModule, check_enough
from nerfgrasp.data.views import Views, read_views
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import DEFAULT_GRIPPER, find_gripper
from nerfgrasp.scenes.scene import Workspace

HELD_OUT_SEED = 0
"""Draws the negatives of held-out scenes, whatever a training's seed, so that `val/loss` compares across seeds."""


@dataclass(frozen=True)
class Negatives:
    """How many negative poses of each kind a scene gets. The defaults are the paper's kinds and shares."""

    uniform: int = 496
    """Anywhere in the workspace, any orientation."""
    near: int = 15
    """Within ±`near_distance` of the demonstrated position, any orientation."""
    upright: int = 0
    """Anywhere in the workspace, turned about the vertical only: what tells a place from a direction."""
    around: int = 0
    """Within ±`around_distance` of the demonstrated position in x and y and a third of that in z, turned about the
    vertical only: the corners and ends of the object, which fit between the fingers but slip out."""
    perturbed: int = 0
    """The demonstrated grasp, moved or turned just too far to be good."""
    cut: int = 0
    """The demonstrated grasp, lowered until the open gripper cuts the table; half of them tilted as well."""
    near_distance: float = 0.01
    """Metres."""
    around_distance: float = 0.06
    """Metres."""
    least_shift: float = 0.006
    """Metres by which a grasp is moved along its closing axis at least; twice that in any other direction."""
    most_shift: float = 0.05
    """Metres by which it is moved at most."""
    least_turn: float = 0.15
    """Radians by which a turned grasp is turned at least."""
    most_turn: float = 1.5
    """Radians by which it is turned at most."""
    most_tilt: float = 1.0
    """Radians by which a grasp that cuts the table is tilted about its closing axis at most."""
    most_cut: float = 0.02
    """Metres by which the gripper's lowest point then lies under the table at most."""
    gripper: str = DEFAULT_GRIPPER.name
    """The gripper that cuts the table: a registered name or a YAML file."""


class GraspBatch(NamedTuple):
    """Poses to be valued in B scenes; one scene's has no leading B."""

    scene: Tensor
    """`[B]`: the scenes' numbers in their set."""
    view: Tensor
    """`[B, V]`: the input views' numbers."""
    inputs: Views
    """Batch shape `[B, V]`."""
    T_world_grasp: Tensor
    """`[B, P, 4, 4]`: the demonstrated grasp first, then the negatives."""


class DemonstrationData(StepDataModule):
    """Batches of scenes with one demonstrated grasp each, from packed sets; subclasses say what is drawn of a scene."""

    keeps: ClassVar[tuple[str, ...]] = ("demonstrations",)
    """What a set must keep to be learned from."""
    train_set: SceneSet
    validation_set: SceneSet
    views: int
    """Input views a scene."""
    scenes_per_step: int
    """Scenes in a batch."""
    random_views: bool
    """Whether a step takes random views of a scene as input, or always its first ones."""

    def check(self, stage: str = "fit") -> None:
        """See `StepDataModule`."""
        super().check(stage)
        for name, scenes in (("train", self.train_set), ("validation", self.validation_set)):
            for kept in self.keeps:
                if not getattr(scenes, kept):
                    raise UserError(f"data.init_args.{name}: {kept} is false: that is what is learned from")
            check_enough(f"data.init_args.{name}", "views", self.views, scenes.views)

    def setup(self, stage: str) -> None:
        """Opens the sets.

        Raises:
            UserError: one is missing or damaged, or too few scenes have a demonstrated grasp.
        """
        self.train_scenes = self.train_set.open() if stage == "fit" else None
        self.train_grasps = self.grasps_of(self.train_scenes) if self.train_scenes is not None else {}
        if self.train_scenes is not None:
            what = "scenes with a demonstrated grasp"
            check_enough(str(self.train_set.folder), what, self.scenes_per_step, len(self.train_grasps))
        self.held_out = self.validation_set.open()

    def grasps_of(self, scenes: PackedScenes) -> dict[int, Tensor]:
        """Returns the demonstrated grasps `[4, 4]` by scene number."""
        return demonstrations(scenes)

    def draw(self, generator: np.random.Generator) -> Any:
        """Returns one training batch."""
        assert self.train_scenes is not None
        chosen = generator.choice(sorted(self.train_grasps), self.scenes_per_step, replace=False)
        return default_collate([self.draw_scene(self.train_scenes, int(scene), generator) for scene in chosen])

    def draw_scene(self, scenes: PackedScenes, scene: int, generator: np.random.Generator) -> Any:
        """Returns one scene of a batch."""
        raise NotImplementedError

    def draw_views(self, scenes: PackedScenes, generator: np.random.Generator) -> np.ndarray:
        """Returns the numbers `[V]` of a scene's input views."""
        every = np.arange(scenes.settings.views)
        return (generator.permutation(every) if self.random_views else every)[: self.views]


class GraspData(DemonstrationData):
    """Demonstrated grasps and negatives from packed sets.

    Args:
        train: scenes with demonstrations.
        validation: scenes with demonstrations, kept out of training.
        views: input views a scene; the backbone's `views`.
        scenes_per_step: scenes in a batch.
        negatives: how the negative poses are drawn.
        random_views: whether a step takes random views of a scene as input, or always its first ones.
        seed: of all draws for training.
        workers: processes that draw batches, 0 or 1.
    """

    def __init__(
        self,
        train: SceneSet,
        validation: SceneSet,
        views: int = 3,
        scenes_per_step: int = 1,
        negatives: Negatives = Negatives(),
        random_views: bool = True,
        seed: int = 0,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.train_set, self.validation_set = train, validation
        self.views, self.scenes_per_step = views, scenes_per_step
        self.negatives, self.random_views = negatives, random_views
        self.seed, self.workers = seed, workers

    def draw_scene(self, scenes: PackedScenes, scene: int, generator: np.random.Generator) -> GraspBatch:
        """See `DemonstrationData`."""
        view = self.draw_views(scenes, generator)
        return _draw_one(scenes, scene, view, self.train_grasps[scene], self.negatives, generator)

    def val_dataloader(self) -> DataLoader:
        """Returns the held-out scenes, each with negatives that are the same every time."""
        return DataLoader(HeldOutGrasps(self.held_out, self.views, self.negatives), batch_size=None)

    test_dataloader = val_dataloader


class HeldOutGrasps(Dataset[GraspBatch]):
    """Held-out scenes by their first views, with a draw of negatives each that is the same in every training."""

    def __init__(self, scenes: PackedScenes, views: int, negatives: Negatives) -> None:
        self.scenes, self.views, self.negatives = scenes, views, negatives
        self.grasps = list(demonstrations(scenes).items())

    def __len__(self) -> int:
        return len(self.grasps)

    def __getitem__(self, item: int) -> GraspBatch:
        if item >= len(self):
            raise IndexError(item)
        scene, grasp = self.grasps[item]
        generator = np.random.default_rng((HELD_OUT_SEED, scene))
        drawn = _draw_one(self.scenes, scene, np.arange(self.views), grasp, self.negatives, generator)
        batch: GraspBatch = default_collate([drawn])
        return batch


def _draw_one(
    scenes: PackedScenes,
    scene: int,
    view: np.ndarray,
    grasp: Tensor,
    negatives: Negatives,
    generator: np.random.Generator,
) -> GraspBatch:
    poses = torch.cat(
        [half_turned(grasp[None], generator), draw_negatives(grasp, scenes.workspace, negatives, generator)]
    )
    return GraspBatch(torch.tensor(scene), torch.from_numpy(view), read_views(scenes, scene, view), poses)


def demonstrations(scenes: PackedScenes) -> dict[int, Tensor]:
    """Returns the demonstrated grasps `[4, 4]` by scene number; scenes without one are left out."""
    truths = ((scene, scenes.truth(scene).demonstration) for scene in range(len(scenes)))
    return {scene: grasp.float() for scene, grasp in truths if grasp is not None}


def half_turned(T_world_grasp: Tensor, generator: np.random.Generator) -> Tensor:
    """Turns half of the grasps `[N, 4, 4]` by 180° about their approach: for a parallel gripper the same grasp."""
    turn = torch.from_numpy(generator.integers(0, 2, len(T_world_grasp))).to(T_world_grasp)
    sign = torch.stack([1 - 2 * turn, 1 - 2 * turn, torch.ones_like(turn), torch.ones_like(turn)], dim=-1)
    return T_world_grasp * sign[:, None, :]


def draw_negatives(grasp: Tensor, workspace: Workspace, negatives: Negatives, generator: np.random.Generator) -> Tensor:
    """Returns `[N, 4, 4]` poses that are most likely no grasps.

    Args:
        grasp: the demonstrated one, `[4, 4]`.
        workspace: where the uniform ones lie; its lower face is the table.
        negatives: how many of each kind.
        generator: the source of all draws.
    """
    kinds = [
        make_pose(_rotations(negatives.uniform, generator), _positions(negatives.uniform, workspace, generator)),
        make_pose(
            _rotations(negatives.near, generator),
            grasp[:3, 3] + _uniform((negatives.near, 3), negatives.near_distance, generator),
        ),
        make_pose(
            _about_vertical(negatives.upright, generator) @ grasp[:3, :3],
            _positions(negatives.upright, workspace, generator),
        ),
        make_pose(
            _about_vertical(negatives.around, generator) @ grasp[:3, :3],
            grasp[:3, 3]
            + _uniform((negatives.around, 3), negatives.around_distance, generator) * torch.tensor([1.0, 1.0, 1 / 3]),
        ),
        _perturbed(grasp, negatives, generator),
        _cut(grasp, workspace, negatives, generator),
    ]
    return torch.cat(kinds)


def _perturbed(grasp: Tensor, negatives: Negatives, generator: np.random.Generator) -> Tensor:
    """Copies a grasp and moves half of the copies, turns the others, small changes as likely as large ones.

    A quarter each moves along the closing axis (the fingers are no longer on either side) and turns about the
    approach (they are no longer parallel to the faces): these are the changes that most surely spoil a grasp. An
    eighth each turns about the other two axes; the last quarter moves in any direction, where the grasp may slide
    along its object and stay good, and so moves farther.
    """
    count = negatives.perturbed
    kind = torch.arange(count) % 8
    axes = torch.eye(3)[torch.tensor([0, 2, 0, 2, 0, 1, 0, 0])][kind]
    axes[kind >= 6] = _directions(int((kind >= 6).sum()), generator)
    axes *= torch.from_numpy(generator.choice([-1.0, 1.0], (count, 1))).float()
    shift = _log_between(count, negatives.least_shift, negatives.most_shift, generator)
    shift = torch.where(kind[:, None] >= 6, shift.clamp(min=2 * negatives.least_shift), shift)
    turn = _log_between(count, negatives.least_turn, negatives.most_turn, generator)
    turned = ((kind % 2 == 1) | (kind == 4))[:, None] & (kind[:, None] < 6)
    zero = torch.zeros(())
    return grasp @ make_pose(
        roma.rotvec_to_rotmat(torch.where(turned, axes * turn, zero)), torch.where(turned, zero, axes * shift)
    )


def _cut(grasp: Tensor, workspace: Workspace, negatives: Negatives, generator: np.random.Generator) -> Tensor:
    """Copies a grasp, tilts every second copy about the closing axis, and sets all as low as they are to be.

    That the fingers still close across the object makes them hard: the table alone spoils them.
    """
    count = negatives.cut
    tilt = _uniform((count, 1), negatives.most_tilt, generator) * (torch.arange(count) % 2)[:, None]
    tilted = grasp @ make_pose(roma.rotvec_to_rotmat(tilt * torch.tensor([1.0, 0.0, 0.0])), torch.zeros(count, 3))
    depth = torch.from_numpy(generator.uniform(0, negatives.most_cut, count)).float()
    if count:
        tilted[:, 2, 3] += workspace.minimum[2] - depth - find_gripper(negatives.gripper).lowest(tilted)
    return tilted


def _rotations(count: int, generator: np.random.Generator) -> Tensor:
    return roma.unitquat_to_rotmat(torch.nn.functional.normalize(_normal((count, 4), generator), dim=-1))


def _about_vertical(count: int, generator: np.random.Generator) -> Tensor:
    angle = _uniform((count, 1), np.pi, generator)
    return roma.rotvec_to_rotmat(angle * torch.tensor([0.0, 0.0, 1.0]))


def _positions(count: int, workspace: Workspace, generator: np.random.Generator) -> Tensor:
    share = torch.from_numpy(generator.random((count, 3))).float()
    return workspace.minimum + (workspace.maximum - workspace.minimum) * share


def _directions(count: int, generator: np.random.Generator) -> Tensor:
    return torch.nn.functional.normalize(_normal((count, 3), generator), dim=-1)


def _log_between(count: int, least: float, most: float, generator: np.random.Generator) -> Tensor:
    return torch.from_numpy(np.exp(generator.uniform(np.log(least), np.log(most), (count, 1)))).float()


def _uniform(shape: tuple[int, ...], most: float, generator: np.random.Generator) -> Tensor:
    return torch.from_numpy(generator.uniform(-most, most, shape)).float()


def _normal(shape: tuple[int, ...], generator: np.random.Generator) -> Tensor:
    return torch.from_numpy(generator.standard_normal(shape)).float()
