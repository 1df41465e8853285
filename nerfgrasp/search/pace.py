"""A learning rate for each candidate: who no longer rises slows down, and in the end stands still."""

from collections.abc import Sequence

import torch
from torch import Tensor

from nerfgrasp.search.schedule import Plateau


class Pace:
    """The pace of P candidates in one phase, and the best pose that each has seen.

    Adam's step is proportional to its rate, so a candidate's own rate is a share of the common step.

    Args:
        plateau: when to slow down, and when to stand still.
        params: where they start, by group, `[P, ...]` each.
    """

    def __init__(self, plateau: Plateau, params: dict[str, Tensor]) -> None:
        first = next(iter(params.values()))
        self.plateau = plateau
        self.share = torch.ones(len(first), device=first.device, dtype=first.dtype)
        """`[P]`: of the phase's learning rate; 0 for who has converged."""
        self.stale = torch.zeros(len(first), device=first.device, dtype=torch.long)
        """`[P]`: steps since the last rise."""
        self.best_value = torch.full_like(self.share, -torch.inf)
        """`[P]`"""
        self.best = {group: param.detach().clone() for group, param in params.items()}
        """The parameters of those values."""

    def step(
        self, optimizer: torch.optim.Optimizer, moving: Sequence[Tensor], params: dict[str, Tensor], value: Tensor
    ) -> None:
        """Takes each candidate's share of the optimizer's step.

        Args:
            optimizer: whose parameters are `moving`, their gradients set.
            moving: those of `params` that it moves.
            params: by group, changed in place.
            value: `[P]`, of where `params` are before the step.
        """
        self._note(value, params)
        before = [param.detach().clone() for param in moving]
        optimizer.step()
        with torch.no_grad():
            for param, old in zip(moving, before, strict=True):
                param.copy_(old + along(self.share, param) * (param - old))
        self.go_back(params, self.share == 0)

    @torch.no_grad()
    def go_back(self, params: dict[str, Tensor], who: Tensor | None = None) -> None:
        """Puts candidates, all or those of a mask `[P]`, in place where each one's value was highest."""
        chosen = torch.ones_like(self.stale, dtype=torch.bool) if who is None else who
        for group, param in params.items():
            param.copy_(torch.where(along(chosen, param), self.best[group], param))

    @torch.no_grad()
    def _note(self, value: Tensor, params: dict[str, Tensor]) -> None:
        better, risen = value > self.best_value, value > self.best_value + self.plateau.rise
        self.best_value = torch.where(better, value, self.best_value)
        for group, param in params.items():
            self.best[group] = torch.where(along(better, param), param, self.best[group])
        self.stale = torch.where(risen, torch.zeros_like(self.stale), self.stale + 1)
        slower = self.stale > self.plateau.patience
        self.stale = torch.where(slower, torch.zeros_like(self.stale), self.stale)
        share = torch.where(slower, self.share * self.plateau.factor, self.share)
        self.share = torch.where(share < self.plateau.least, torch.zeros_like(share), share)


def along(of_candidates: Tensor, param: Tensor) -> Tensor:
    """Views `[P]` so that it broadcasts with `[P, ...]`."""
    return of_candidates.view(-1, *[1] * (param.ndim - 1))
