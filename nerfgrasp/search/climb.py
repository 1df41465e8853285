"""Candidates climb a value together, by Adam, along the phases of a schedule."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from nerfgrasp.search.pace import Pace, along
from nerfgrasp.search.schedule import Phase, PoseParameterization, Rung, Schedule

Value = Callable[[Tensor], Tensor]
"""Maps `T_world_grasp` `[P, 4, 4]` to values `[P]`, differentiably and each pose by itself."""
Projection = Callable[[dict[str, Tensor]], dict[str, Tensor]]
"""Maps parameters to permitted ones nearby."""


class Climb:
    """P candidates on their way up.

    All of them take a step before any takes the next, so that rungs can rank them. Their evaluation alone goes in
    chunks, since it alone takes memory; whoever rests is not evaluated.

    Args:
        value: the function to climb.
        start: `T_world_grasp` `[P, 4, 4]`.
        pose: the parameterization to climb in.
        project: the post-processing after each step.
        chunk: how many candidates are evaluated at once.
    """

    def __init__(
        self, value: Value, start: Tensor, pose: PoseParameterization, project: Projection, chunk: int
    ) -> None:
        self.function, self.pose, self.project, self.chunk = value, pose, project, chunk
        with torch.no_grad():
            params = project(pose.encode(start))
        self.params = {group: param.detach().clone() for group, param in params.items()}
        """By group, `[P, D]` each: where they are."""
        self.value = torch.full_like(start[:, 0, 0], -torch.inf)
        """`[P]`: the last value known of each."""
        self.iterations: list[tuple[Tensor, Tensor]] = []
        """Poses `[P, 4, 4]` and values `[P]`, the start's first."""
        self.climbing = torch.ones_like(self.value, dtype=torch.bool)
        """`[P]`: who has not been left behind at a rung."""

    @torch.no_grad()
    def run(self, schedule: Schedule) -> tuple[Tensor, Tensor]:
        """Climbs, and returns the poses `[I, P, 4, 4]` and values `[I, P]` of every iteration, the start's first."""
        for phase in schedule.phases:
            self._take(phase, schedule.clip)
        self._evaluate(self.climbing)
        self._note()
        poses, values = (torch.stack(every) for every in zip(*self.iterations, strict=True))
        if schedule.go_back:
            best = values.nan_to_num(nan=-torch.inf).argmax(dim=0), torch.arange(len(self.value), device=values.device)
            poses[-1], values[-1] = poses[best], values[best]
        return poses, values

    def _take(self, phase: Phase, clip: float) -> None:
        """Takes one phase's steps."""
        groups = [group for group in self.params if phase.moves(group)]
        free = [self.params[group] for group in groups]
        optimizer = torch.optim.Adam(free, lr=phase.learning_rate, maximize=True)
        rate = torch.optim.lr_scheduler.ExponentialLR(optimizer, phase.decay)
        pace = None if phase.plateau is None else Pace(phase.plateau, self.params)
        rungs = {rung.after: rung for rung in phase.rungs}
        for step in range(phase.steps):
            moving = self.climbing if pace is None else self.climbing & (pace.share > 0)
            if not bool(moving.any()):
                break
            for param, gradient in zip(free, self._evaluate(moving, groups), strict=True):
                param.grad = gradient.clamp(-clip, clip)
            self._note()
            if step in rungs:
                self._leave_behind(rungs[step])
            self._move(optimizer, free, pace, moving & self.climbing)
            rate.step()
        if pace is not None:
            pace.go_back(self.params, self.climbing)

    def _evaluate(self, who: Tensor, groups: Sequence[str] = ()) -> list[Tensor]:
        """Values candidates, a mask `[P]`, and returns the gradients `[P, D]` in the groups, 0 for the others."""
        gradients = [torch.zeros_like(self.params[group]) for group in groups]
        for rows in torch.nonzero(who)[:, 0].split(self.chunk):
            params = {group: param[rows] for group, param in self.params.items()}
            free = [params[group].requires_grad_() for group in groups]
            with torch.set_grad_enabled(bool(groups)):
                values = self.function(self.pose.decode(params))
                parts = torch.autograd.grad(values.sum(), free) if groups else ()
            self.value[rows] = values.detach()
            for gradient, part in zip(gradients, parts, strict=True):
                gradient[rows] = part
        return gradients

    def _leave_behind(self, rung: Rung) -> None:
        """Lets the best of those who climb go on."""
        recent = torch.stack([values for _, values in self.iterations[-rung.window :]])
        climbing = torch.nonzero(self.climbing)[:, 0]
        best = recent.nan_to_num(nan=-torch.inf).amax(dim=0)[climbing]
        order = climbing[best.sort(descending=True, stable=True).indices]
        self.climbing[order[max(1, round(rung.share * len(order))) :]] = False

    def _move(
        self, optimizer: torch.optim.Optimizer, free: Sequence[Tensor], pace: Pace | None, moving: Tensor
    ) -> None:
        """Takes a step. Adam knows of no rows: it moves all, and those who rest are put back."""
        before = {group: param.clone() for group, param in self.params.items()}
        if pace is None:
            optimizer.step()
        else:
            pace.step(optimizer, free, self.params, self.value)
            self.value = torch.where(moving & (pace.share == 0), pace.best_value, self.value)
        for group, projected in self.project(self.params).items():
            self.params[group].copy_(torch.where(along(moving, projected), projected, before[group]))

    def _note(self) -> None:
        """Notes where they are; copies, since a decoded pose may share memory with the parameters."""
        self.iterations.append((self.pose.decode(self.params).clone(), self.value.clone()))
