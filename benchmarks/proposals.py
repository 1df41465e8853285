"""What a search proposes in a scene, judged by Ψ alone and with feasibility, and what becomes of it in physics."""

from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

from search import observe
from torch import Tensor

from nerfgrasp.evaluation.trials import pose_errors, proposal_generator
from nerfgrasp.methods.psi import ObservedScene, Psi
from nerfgrasp.scenes.scene import Grasps, Truth
from nerfgrasp.search.strategies import GUIDED
from nerfgrasp.sim.attempt import Outcome, attempt_grasp
from nerfgrasp.sim.tasks import workspace

UNWEIGHED = replace(GUIDED, feasibility=None)
"""The default search, judged by Ψ alone."""
NO_ERRORS = {"distance_mm": None, "angle_deg": None}
"""Where there is no grasp, or no valid one to hold it against."""


class Proposals(NamedTuple):
    """The best different grasps of one search, best first."""

    alone: Grasps
    """By Ψ alone."""
    weighed: Grasps
    """The same by Ψ and feasibility together, the best polished; as they are if the model's density means nothing."""


@lru_cache(maxsize=2)
def load(model: str) -> Psi:
    """Returns a model with its search, read once a process.

    It stands here because worker processes do not find what is cached in a script itself.
    """
    return Psi.from_pretrained(model)


def observed(method: Psi, truth: Truth) -> ObservedScene:
    """Returns what a method needs of a scene, seen by the cameras of an evaluation."""
    return method.observe(observe(truth, method.images), workspace)


def propose(method: Psi, scene: ObservedScene, truth: Truth) -> Proposals:
    """Searches a scene once, with the draws of an evaluation's first attempt."""
    generator = proposal_generator(truth.seed, truth.index, 0)
    alone, _ = method.search(scene, generator=generator, strategy=UNWEIGHED)
    how = method.resolve(GUIDED)
    if how.feasibility is None:
        return Proposals(alone, alone)
    weighed = method.weigh(alone, scene, how.feasibility)
    return Proposals(alone, method.polish(weighed, scene, how, generator))


def succeeds(truth: Truth, T_world_grasp: Tensor) -> bool:
    """Returns whether a grasp `[4, 4]` lifts an object in physics."""
    return attempt_grasp(truth, T_world_grasp).outcome == Outcome.SUCCESS


def tried(truth: Truth, grasps: Grasps) -> dict[str, Any]:
    """Carries the best of some grasps out; returns whether it succeeds, and its errors to the nearest valid grasp."""
    if len(grasps) == 0:
        return {"success": False, **NO_ERRORS}
    best = grasps.T_world_grasp[0]
    return {"success": succeeds(truth, best), **(pose_errors(truth, best) or NO_ERRORS)}
