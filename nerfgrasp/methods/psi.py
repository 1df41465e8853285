"""Ψ with its search: the method `psi`, from observations to grasps."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from nerfgrasp.checks import check_number
from nerfgrasp.devices import find_device
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import sees_box
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper, find_gripper
from nerfgrasp.models.folder import DEFAULT_MODEL, load_model
from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.models.mvnerf import SceneFeatures
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search.ascent import Draw, Trace, search
from nerfgrasp.search.candidates import random_candidates, resample
from nerfgrasp.search.feasibility import Feasibility
from nerfgrasp.search.occupancy import Occupancy, occupancy, occupied_candidates
from nerfgrasp.search.parameterization import DEFAULT_POSE, load_pose
from nerfgrasp.search.ranking import best_first, distinct, finite_first
from nerfgrasp.search.schedule import PoseParameterization
from nerfgrasp.search.strategies import DEFAULT_STRATEGY, GUIDED, Strategy, as_strategy

_DISTANCE, _ANGLE = 0.01, math.radians(15.0)
"""Metres and radians: grasps nearer to a better one in both are not weighed, where not all are."""
_IMAGES = 3
"""How many of a scene's images are used, if it has as many and nobody asks for others."""
_CHUNK = {"cpu": 64}
"""Poses that are evaluated at once, where they fit a processor's cache; ..."""
_CHUNK_ELSEWHERE = 512
"""... and where they keep an accelerator busy."""


@dataclass(frozen=True)
class ObservedScene:
    """What a search needs of a scene, computed once."""

    features: SceneFeatures
    """Of its images, on the model's device."""
    workspace: Workspace
    """Where to search, there too."""
    occupied: dict[float, Occupancy] = field(default_factory=dict, repr=False, compare=False)
    """Where the model sees something in it, by the spacing of the grid; filled by the first search that asks."""


class Psi:
    """Finds grasps by gradient ascent on a learned grasp value."""

    needs: ClassVar[frozenset[str]] = frozenset()
    """It sees RGB alone."""

    def __init__(
        self,
        model: GraspValue,
        *,
        strategy: Strategy = GUIDED,
        pose: str = DEFAULT_POSE,
        images: int | None = None,
        chunk: int | None = None,
        gripper: Gripper = DEFAULT_GRIPPER,
    ) -> None:
        """Wraps a trained value.

        Args:
            model: the value Ψ on its backbone; the search runs on its device.
            strategy: how to search, where a search is not given another.
            pose: the registered name of the parameterization to climb in, likewise.
            images: how many of a scene's images are used, from the front, if the model does not need more; every
                scene must have as many. A model takes them in groups of as many as it sees at once, averages its values
                over the groups (the paper's MV1), and leaves out what does not fill one. None for up to three.
            chunk: how many poses are evaluated at once, which bounds the memory; None chooses by the device.
            gripper: the hand that grasps. The search's limits and feasibility are for this hand.

        Raises:
            UserError: `images` is out of its range.
        """
        check_number("images", images, 1)
        self.model = model.eval().requires_grad_(False)
        self.gripper = gripper
        self.strategy = self.resolve(strategy)
        """What a search is that is not given another."""
        self.pose = pose
        """The parameterization that it climbs in, if it is not given another."""
        self.asked_images = images
        self.images = max(_IMAGES if images is None else images, model.views)
        """How many of a scene's images are used at most."""
        self.chunk = _CHUNK.get(self.device.type, _CHUNK_ELSEWHERE) if chunk is None else chunk

    @classmethod
    def from_pretrained(
        cls,
        folder: str | None = None,
        *,
        strategy: str | Mapping[str, Any] | Strategy = DEFAULT_STRATEGY,
        pose: str = DEFAULT_POSE,
        device: str | torch.device = "cpu",
        images: int | None = None,
        gripper: str | Gripper = DEFAULT_GRIPPER,
    ) -> "Psi":
        """Loads a trained grasp value with its search.

        Args:
            folder: a model folder, a shipped model's name, or a Hugging Face repository id; None for the default model.
            strategy: how to search: a name, the arguments of `find_strategy` (e.g. `{"name": "prune", "keep": 16}`), or
                a strategy.
            pose: the registered name of the pose parameterization to ascend in.
            device: where to compute: `cpu`, `cuda`, `mps`, or a numbered one, e.g. `cuda:1`.
            images: see the class.
            gripper: the hand that grasps: a gripper, a registered name or a YAML file.

        Raises:
            UserError: there is no such model, strategy, parameterization or device, the model is damaged or holds no
                grasp value, the parameterization does not work, or `images` is out of range.
        """
        found, where, hand = as_strategy(strategy), find_device(device), find_gripper(gripper)
        load_pose(pose, Workspace())
        folder = DEFAULT_MODEL if folder is None else folder
        model = load_model(folder)
        if not isinstance(model, GraspValue):
            raise UserError(f"model {folder}: a {type(model).__name__} renders scenes but values no grasps")
        return cls(model.to(where), strategy=found, pose=pose, images=images, gripper=hand)

    @property
    def device(self) -> torch.device:
        """Where the search runs."""
        return next(self.model.parameters()).device

    def resolve(self, strategy: Strategy) -> Strategy:
        """Returns what is run where `strategy` is asked for: how far the model's density is believed, it decides.

        One that cannot render is searched without it; one that sees one view at a time counts half.
        """
        if not self.model.config.renders:
            strategy = strategy.blind()
        elif self.model.views == 1:
            strategy = strategy.one_view()
        return strategy.with_gripper(self.gripper)

    def observe(self, observations: Observations, workspace: Workspace) -> ObservedScene:
        """Encodes a scene's images once, for any number of searches.

        Args:
            observations: at least as many views as the model needs.
            workspace: where to search.

        Raises:
            UserError: too few views, or one of those used sees nothing of the workspace.
        """
        if self.asked_images is not None and len(observations) < self.asked_images:
            raise UserError(f"images is {self.asked_images}: the scene has {len(observations)}")
        used = observations.select(slice(self.images))
        for view in torch.nonzero(~sees_box(used.camera, workspace.minimum, workspace.maximum))[:, 0].tolist():
            low, high = (
                ", ".join(f"{x:g}" for x in corner.tolist()) for corner in (workspace.minimum, workspace.maximum)
            )
            raise UserError(
                f"camera {view} sees nothing of the workspace from ({low}) to ({high}) m: is its pose camera to world, "
                "in metres and the workspace's frame, with axes of the right convention?"
            )
        box = workspace.to(self.device)
        return ObservedScene(self.model.observe(used.to(self.device), box), box)

    def search(
        self,
        scene: Observations | ObservedScene,
        workspace: Workspace | None = None,
        *,
        generator: torch.Generator,
        pose: str | PoseParameterization | None = None,
        strategy: Strategy | None = None,
    ) -> tuple[Grasps, Trace]:
        """Searches grasps and shows how the search went.

        Args:
            scene: what `observe` returned, or what it takes.
            workspace: where to search; of an observed scene, its own.
            generator: the only source of randomness.
            pose: the parameterization to climb in, or its registered name; the method's own if None.
            strategy: how to search; the method's own if None.

        Returns:
            The final poses of the candidates that climbed, best first by Ψ and feasibility together, and the trace of
            their climb, which shows Ψ alone.

        Raises:
            UserError: as for `observe`, a parameterization that is unknown or breaks its word, or no grasp of a finite
                value.
        """
        if isinstance(scene, Observations):
            scene = self.observe(scene, Workspace() if workspace is None else workspace)
        features, box = scene.features, scene.workspace
        how = self.strategy if strategy is None else self.resolve(strategy)
        climbed, trace = search(
            lambda T: self.model.value(features, T),
            load_pose(self.pose if pose is None else pose, box),
            box,
            candidates=how.candidates,
            keep=how.keep,
            rounds=how.rounds,
            climbers=how.climbers,
            draw=self._draw(scene, how.spacing),
            generator=generator,
            schedule=how.climb,
            limits=how.limits,
            chunk=self.chunk,
        )
        return self._weighed(climbed, scene, how, generator), trace

    def propose(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> Grasps:
        """Returns up to `count` different grasps, best first; arguments and errors as for `search`."""
        return self.propose_with_trace(observations, workspace, generator=generator, count=count)[0]

    def propose_with_trace(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> tuple[Grasps, Trace]:
        """Returns the grasps of `propose`, and the trace of the ascent that led to them."""
        grasps, trace = self.search(observations, workspace, generator=generator)
        return distinct(grasps, count=count), trace

    def check_minimum_value(self, value: float) -> None:
        """Checks that grasps can be rejected by a minimum value, a logit.

        Raises:
            UserError: `value` is not finite, or the model was trained by a softmax over a scene's poses: then its
                values may be shifted by another constant in each scene.
        """
        if not math.isfinite(value):
            raise UserError(f"minimum_value is {value}: it must be a finite number")
        if self.model.config.loss != "binary":
            raise UserError(
                f"minimum_value is {value:g}: the model's values compare within one scene only, and reject none; those "
                "of a model trained with the loss 'binary' do"
            )

    def at_least(self, grasps: Grasps, value: float) -> Grasps:
        """Returns the grasps that are worth at least `value`, in their order; there may be none.

        Raises:
            UserError: as for `check_least`.
        """
        self.check_least(value)
        kept = grasps.value >= value
        return Grasps(grasps.T_world_grasp[kept], grasps.value[kept])

    def check_least(self, value: float) -> None:
        """Checks that grasps may be asked to be worth at least `value`, a logit; so before any work.

        Raises:
            UserError: `value` is not finite, or the model was trained by a softmax over a scene's poses: its values may
                be shifted in every scene.
        """
        if not math.isfinite(value):
            raise UserError(f"least_value is {value}: it must be a finite number")
        if self.model.config.loss != "binary":
            raise UserError(
                f"least_value is {value:g}: the model's values compare within one scene only, and reject none; those "
                "of a model trained with the loss 'binary' do"
            )

    def weigh(self, grasps: Grasps, scene: ObservedScene, feasibility: Feasibility) -> Grasps:
        """Returns grasps by value and feasibility together, best first.

        Args:
            grasps: valued by Ψ alone.
            scene: in which they lie.
            feasibility: what is added to their values.

        Raises:
            UserError: none of them has a finite value then.
        """
        added = feasibility(self.model, scene.features, grasps.T_world_grasp, scene.workspace)
        return finite_first(grasps.T_world_grasp, grasps.value + added)

    def polish(self, grasps: Grasps, scene: ObservedScene, strategy: Strategy, generator: torch.Generator) -> Grasps:
        """Returns weighed grasps, the best of them moved to where value and feasibility together are higher.

        After each round the better half of those goes on. Moves that would not bring a grasp there are not told from
        those that make it worse.

        Args:
            grasps: what `weigh` returned.
            scene: in which they lie.
            strategy: tells how many are moved, how, within which limits, and what is added to values.
            generator: the only source of randomness.
        """
        if strategy.feasibility is None:
            return grasps
        count = strategy.polished
        for one in strategy.polish:
            T, value = grasps.T_world_grasp, grasps.value
            goes_on = (count + 1) // 2
            bar = value[:goes_on].amin()  # values only rise, so who stays below it does not go on
            judge = partial(self._judge, scene, strategy.feasibility, bar)
            moved, risen = resample(
                judge, T[:count], value[:count], (one,), scene.workspace, generator, strategy.limits
            )
            grasps = best_first(torch.cat([moved, T[count:]]), torch.cat([risen, value[count:]]))
            count = goes_on
        return grasps

    def _draw(self, scene: ObservedScene, spacing: float | None) -> Draw:
        if spacing is None:
            return random_candidates
        if spacing not in scene.occupied:
            scene.occupied[spacing] = occupancy(self.model, scene.features, scene.workspace, spacing)
        return partial(occupied_candidates, occupied=scene.occupied[spacing])

    def _weighed(self, grasps: Grasps, scene: ObservedScene, how: Strategy, generator: torch.Generator) -> Grasps:
        if how.weighed is not None:
            grasps = distinct(grasps, _DISTANCE, _ANGLE, how.weighed)
        if how.feasibility is None:
            return grasps
        return self.polish(self.weigh(grasps, scene, how.feasibility), scene, how, generator)

    def _judge(
        self, scene: ObservedScene, feasibility: Feasibility, bar: Tensor, T_world_grasp: Tensor, floor: Tensor
    ) -> Tensor:
        """Returns values and feasibility together `[P]`, or −∞ for who is no higher than the floor and the bar.

        What is added is never positive, so who is no higher before need not be weighed.
        """
        value = torch.cat([self.model.value(scene.features, T) for T in T_world_grasp.split(self.chunk)])
        least = floor.clamp(min=bar)
        worth = value > least
        value[worth] += feasibility(
            self.model, scene.features, T_world_grasp[worth], scene.workspace, (least - value)[worth]
        )
        return value.where(value > least, -torch.inf)
