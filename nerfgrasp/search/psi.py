"""Ψ with its search: the method `psi`, from observations to grasps."""

from typing import ClassVar

import torch

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.models.folder import DEFAULT_MODEL, load_model
from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.models.mvnerf import SceneFeatures
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search.ascent import Trace, search
from nerfgrasp.search.feasibility import Feasibility
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.ranking import best_first, distinct
from nerfgrasp.search.schedule import CLIMB, PAPER, ROUNDS, PoseParameterization, Schedule

_CHECKED = 16
"""Grasps whose feasibility is found at once."""


class Psi:
    """Finds grasps by gradient ascent on a learned grasp value."""

    needs: ClassVar[frozenset[str]] = frozenset()
    """It sees RGB alone."""

    def __init__(
        self,
        model: GraspValue,
        *,
        candidates: int = 2048,
        keep: int | None = 128,
        images: int = 3,
        schedule: Schedule = CLIMB,
        limits: Limits | None = Limits(),
        feasibility: Feasibility | None = Feasibility(),
        chunk: int = 64,
    ) -> None:
        """Wraps a trained value.

        Args:
            model: the value Ψ on its backbone.
            candidates: how many random poses a search draws.
            keep: how many of them climb; None for all.
            images: how many of a scene's images are used, from the front, if the model does not need more. A
                model that sees one at a time averages its values over them (the paper's MV1).
            schedule: phases of steps, where not all climb.
            limits: what every grasp keeps to; None for the workspace alone.
            feasibility: what is added to the values of the grasps found; None lets Ψ alone judge, as it does where
                the model has not learned to render.
            chunk: how many poses are evaluated at once.
        """
        self.model = model.eval().requires_grad_(False)
        self.images = max(images, model.views)
        self.candidates, self.keep, self.schedule = candidates, keep, schedule
        self.limits, self.chunk = limits, chunk
        self.feasibility = feasibility if model.config.renders else None

    @classmethod
    def from_pretrained(cls, folder: str | None = None) -> "Psi":
        """Loads a model folder, or a shipped model by its name; without either, the default model.

        Raises:
            UserError: there is no such model, it is damaged, or it holds no grasp value.
        """
        folder = DEFAULT_MODEL if folder is None else folder
        model = load_model(folder)
        if not isinstance(model, GraspValue):
            raise UserError(f"model {folder}: a {type(model).__name__} renders scenes but values no grasps")
        return cls(model)

    def search(
        self,
        observations: Observations,
        workspace: Workspace,
        *,
        generator: torch.Generator,
        pose: str | PoseParameterization = "quaternion",
        candidates: int | None = None,
        keep: int | None = None,
    ) -> tuple[Grasps, Trace]:
        """Searches grasps and shows how the search went.

        If all candidates climb, they do so as in the paper's Algorithm 1; else the best are resampled before a
        short climb (measured in docs/results.md).

        Args:
            observations: at least as many views as the model needs.
            workspace: where to search.
            generator: the only source of randomness.
            pose: the parameterization to climb in, or its registered name.
            candidates: how many random poses to draw; the method's own number if None.
            keep: how many of them climb; the method's own number if None.

        Returns:
            The final poses of the candidates that climbed, best first by Ψ and feasibility together, and the trace of
            their climb, which shows Ψ alone.

        Raises:
            UserError: too few views, or an unknown parameterization.
        """
        parameterization = registry.load(registry.POSES, pose)() if isinstance(pose, str) else pose
        features = self.model.observe(observations.select(slice(self.images)), workspace)
        candidates = self.candidates if candidates is None else candidates
        keep = self.keep if keep is None else keep
        all_climb = keep is None or keep >= candidates
        climbed, trace = search(
            lambda T: self.model.value(features, T),
            parameterization,
            workspace,
            candidates=candidates,
            keep=keep,
            rounds=() if all_climb else ROUNDS,
            generator=generator,
            schedule=PAPER if all_climb else self.schedule,
            limits=self.limits,
            chunk=self.chunk,
        )
        return self._weighed(climbed, features, workspace), trace

    def _weighed(self, grasps: Grasps, features: SceneFeatures, workspace: Workspace) -> Grasps:
        if self.feasibility is None:
            return grasps
        added = [self.feasibility(self.model, features, T, workspace) for T in grasps.T_world_grasp.split(_CHECKED)]
        return best_first(grasps.T_world_grasp, grasps.value + torch.cat(added))

    def propose(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> Grasps:
        """Returns up to `count` different grasps, best first; arguments and errors as for `search`."""
        grasps, _ = self.search(observations, workspace, generator=generator)
        return distinct(grasps, count=count)
