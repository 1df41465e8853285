"""Grasp pose optimization by gradient ascent (Algorithm 1 of "Grasping from NeRFs")."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfgrasp.scenes.scene import Grasps, Workspace
from nerfgrasp.search.candidates import random_candidates, resample
from nerfgrasp.search.climb import Climb, Projection, Value
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.ranking import best_first, distinct, finite_first
from nerfgrasp.search.schedule import PAPER, PoseParameterization, Round, Schedule

Draw = Callable[[int, Workspace, torch.Generator, float], Tensor]
"""Draws so many poses in a workspace, tilted no more than that; see `random_candidates`."""


@dataclass(frozen=True)
class Trace:
    """How the candidates moved: iteration 0 is the start, the last one the end."""

    T_world_grasp: Tensor
    """`[I, P, 4, 4]`, I = steps + 1."""
    value: Tensor
    """`[I, P]`: the value of each of those poses."""

    def to(self, device: torch.device | str) -> "Trace":
        """Returns the same trace on `device`."""
        return Trace(self.T_world_grasp.to(device), self.value.to(device))


def ascend(
    value: Value,
    start: Tensor,
    pose: PoseParameterization,
    workspace: Workspace,
    schedule: Schedule = PAPER,
    *,
    limits: Limits | None = None,
    chunk: int = 256,
) -> tuple[Grasps, Trace]:
    """Lets every candidate climb the value by Adam, post-processing its parameters after each step.

    Candidates are independent, but for a schedule's rungs: the gradient of the sum of values holds each one's own
    gradient, and Adam works element by element. So they are evaluated in chunks, which bounds the memory and changes
    nothing else.

    Args:
        value: the function to climb; its own parameters stay as they are.
        start: `T_world_grasp` `[P, 4, 4]`.
        pose: the parameterization to climb in.
        workspace: where the positions are kept.
        schedule: phases of steps.
        limits: what every pose keeps to; None for the workspace alone, which is the paper's way.
        chunk: how many candidates are evaluated at once.

    Returns:
        The final poses, best first, and the trace of all of them in the order of `start`.

    Raises:
        UserError: no final pose has a finite value.
    """
    climb = Climb(value, start, pose, _projection(pose, workspace, limits), chunk)
    trace = Trace(*climb.run(schedule))
    return finite_first(trace.T_world_grasp[-1], trace.value[-1]), trace


def search(
    value: Value,
    pose: PoseParameterization,
    workspace: Workspace,
    *,
    candidates: int,
    generator: torch.Generator,
    keep: int | None = None,
    rounds: Sequence[Round] = (),
    climbers: int | None = None,
    schedule: Schedule = PAPER,
    limits: Limits | None = None,
    draw: Draw = random_candidates,
    chunk: int = 256,
) -> tuple[Grasps, Trace]:
    """Draws random candidates, resamples around the best of them, and lets these climb.

    Args:
        value: the function to climb.
        pose: the parameterization to climb in.
        workspace: where to search.
        candidates: how many random poses to draw.
        generator: the only source of randomness.
        keep: how many of them go on; None for all, which is the paper's way.
        rounds: how those are resampled, see `resample`.
        climbers: how many of those, different ones, climb in the end; None for all.
        schedule: phases of steps.
        limits: see `ascend`.
        draw: what draws the candidates.
        chunk: how many candidates are evaluated at once.

    Returns:
        What `ascend` returns for those that climb. They stand in the trace in the order in which they were drawn, if
        all climb at once; else, best first, in that of their values before the rounds, or with `climbers` after them.

    Raises:
        UserError: no pose has a finite value, or the workspace has no room within the limits.
    """
    if limits is not None:
        limits.check_room(workspace)
    start = draw(candidates, workspace, generator, math.pi if limits is None else limits.max_tilt)
    if rounds or (keep is not None and keep < candidates) or (climbers is not None and climbers < candidates):
        start = start if limits is None else limits.enforce(start, workspace)
        best = finite_first(start, _values(value, start, chunk))
        kept = best.T_world_grasp[:keep], best.value[:keep]
        start, values = resample(
            lambda poses, floor: _values(value, poses, chunk), *kept, rounds, workspace, generator, limits
        )
        if climbers is not None:
            start = distinct(best_first(start, values), count=climbers).T_world_grasp
    return ascend(value, start, pose, workspace, schedule, limits=limits, chunk=chunk)


def _projection(pose: PoseParameterization, workspace: Workspace, limits: Limits | None) -> Projection:
    """Returns the post-processing of parameters."""

    def project(params: dict[str, Tensor]) -> dict[str, Tensor]:
        inside = pose.project(params, workspace)
        return inside if limits is None else limits.project(pose, inside, workspace)

    return project


@torch.no_grad()
def _values(value: Value, poses: Tensor, chunk: int) -> Tensor:
    return torch.cat([value(part) for part in poses.split(chunk)])
