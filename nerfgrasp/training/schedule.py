"""Learning-rate schedules as factors of the step."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class LearningRate:
    """How learning rates change over a training. The defaults are the paper's for MVNeRF."""

    warmup_steps: int = 10_000
    """Steps over which the rate rises from zero."""
    decay: Literal["step", "cosine", "constant"] = "step"
    """`step`: times `factor` after `decay_steps`; `cosine`: down to zero at `decay_steps`."""
    decay_steps: int = 450_000
    """See `decay`."""
    factor: float = 0.1
    """See `decay`."""

    def __call__(self, step: int) -> float:
        """Returns the factor on the learning rate at `step`.

        Example:
            >>> rate = LearningRate(warmup_steps=10, decay="cosine", decay_steps=110)
            >>> [round(rate(step), 2) for step in (0, 9, 60, 110)]
            [0.1, 1.0, 0.5, 0.0]
        """
        warm = min(1.0, (step + 1) / max(1, self.warmup_steps))
        return warm * _DECAYS[self.decay](self, step)


def _cosine(rate: LearningRate, step: int) -> float:
    share = (step - rate.warmup_steps) / max(1, rate.decay_steps - rate.warmup_steps)
    return 0.5 * (1.0 + math.cos(math.pi * min(1.0, max(0.0, share))))


_DECAYS: dict[str, Callable[[LearningRate, int], float]] = {
    "step": lambda rate, step: rate.factor if step >= rate.decay_steps else 1.0,
    "cosine": _cosine,
    "constant": lambda rate, step: 1.0,
}
