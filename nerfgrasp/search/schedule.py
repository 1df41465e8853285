"""What a search climbs on and for how long: pose parameterizations, phases, rounds and the schedules made of them."""

from dataclasses import dataclass, replace
from typing import Protocol

from torch import Tensor

from nerfgrasp.checks import check_number
from nerfgrasp.errors import UserError
from nerfgrasp.scenes.scene import Workspace

WHOLE = "pose"
"""The group of a parameterization that does not decouple position and orientation."""
GROUPS = (frozenset({"position", "orientation"}), frozenset({WHOLE}))
"""The parameter groups that a pose parameterization may have."""


class PoseParameterization(Protocol):
    """How a grasp pose is written as free parameters (entry-point group `nerfgrasp.poses`)."""

    def encode(self, T: Tensor) -> dict[str, Tensor]:
        """Maps poses `[..., 4, 4]` to parameters `[..., D]` by group: `position` and `orientation`, or `pose`."""
        ...

    def decode(self, params: dict[str, Tensor]) -> Tensor:
        """Maps parameters to poses `[..., 4, 4]`, differentiably."""
        ...

    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        """Returns valid parameters near `params`, with the position inside the workspace (post-processing)."""
        ...


@dataclass(frozen=True)
class Plateau:
    """When a candidate whose value no longer rises takes shorter steps, and when it has converged.

    Each candidate has a pace of its own, so others change nothing for it. Once it has converged, and at the end of the
    phase, it goes back to the best pose that it has seen.
    """

    patience: int = 3
    """So many steps in a row may pass without a rise."""
    rise: float = 0.02
    """By how much the value must exceed the best one before to count as risen, in its own unit (Ψ's is a logit)."""
    factor: float = 0.5
    """What a plateau makes of the candidate's learning rate."""
    least: float = 0.05
    """The share of the phase's learning rate below which a candidate has converged."""

    def __post_init__(self) -> None:
        """Checks the numbers; one out of its range is a UserError."""
        check_number("a plateau's patience", self.patience, 0)
        check_number("a plateau's rise", self.rise, 0)
        check_number("a plateau's factor", self.factor, 0, 1, above=True)
        check_number("a plateau's least share", self.least, 0, 1)


@dataclass(frozen=True)
class Rung:
    """Where a part of the candidates is left behind: it stops where it is, and is not evaluated again.

    Source: successive halving (Karnin et al. 2013, "Almost optimal exploration in multi-armed bandits").
    """

    after: int
    """So many steps of its phase have been taken."""
    share: float = 0.5
    """Of those who still climb, the best share that goes on; rounded, one candidate at least."""
    window: int = 4
    """Candidates are ranked by the highest of their last so many values: steps of centimetres overshoot, and the value
    of one moment says less of what a candidate can reach."""

    def __post_init__(self) -> None:
        """Checks the numbers; one out of its range is a UserError."""
        check_number("a rung's after", self.after, 0)
        check_number("a rung's share", self.share, 0, 1, above=True)
        check_number("a rung's window", self.window, 1)


@dataclass(frozen=True)
class Phase:
    """A run of Adam steps on some of the parameter groups."""

    groups: tuple[str, ...]
    """The groups that move; a whole-transform parameterization's `pose` moves in every phase."""
    steps: int
    """How many steps."""
    learning_rate: float
    """Of the first step; in metres for positions, since Adam's steps are about as long as their rate."""
    decay: float = 1.0
    """The factor on the learning rate after each step."""
    plateau: Plateau | None = None
    """Ends the phase early, once all candidates have converged; None takes every step alike."""
    rungs: tuple[Rung, ...] = ()
    """Where only the best go on, in this phase and those after it."""

    def __post_init__(self) -> None:
        """Checks the numbers; one out of its range, or a rung that would never be reached, is a UserError."""
        check_number("a phase's steps", self.steps, 0)
        check_number("a phase's learning_rate", self.learning_rate, 0, above=True)
        check_number("a phase's decay", self.decay, 0, above=True)
        if any(rung.after >= self.steps for rung in self.rungs):
            raise UserError(f"a rung of {self.rungs} comes after the phase's {self.steps} steps")

    def moves(self, group: str) -> bool:
        """Says whether `group` moves in this phase."""
        return group in self.groups or group == WHOLE


@dataclass(frozen=True)
class Schedule:
    """The phases of an ascent, in order."""

    phases: tuple[Phase, ...]
    """Each starts with a fresh optimizer."""
    clip: float = 1.0
    """Gradients are clipped to ±clip, element by element."""
    go_back: bool = False
    """Whether each candidate ends at the best pose that it has seen; the paper's ends at its last one."""

    def __post_init__(self) -> None:
        """Checks the clipping; one out of its range is a UserError."""
        check_number("a schedule's clip", self.clip, 0, above=True)

    @property
    def steps(self) -> int:
        """The number of steps in all."""
        return sum(phase.steps for phase in self.phases)


PAPER = Schedule(
    (
        Phase(groups=("position",), steps=16, learning_rate=0.05, decay=0.9),
        Phase(groups=("orientation",), steps=16, learning_rate=0.05, decay=0.99),
    )
)
"""The schedule of "Grasping from NeRFs", section "Grasp pose optimization"."""

HALVING = Schedule(
    (replace(PAPER.phases[0], rungs=(Rung(6), Rung(10))), replace(PAPER.phases[1], rungs=(Rung(0), Rung(8)))),
    go_back=True,
)
"""As `PAPER`, but after 6, 10, 16 and 24 steps the better half goes on alone, and each ends at its best pose."""


@dataclass(frozen=True)
class Round:
    """A round of resampling: each pose is surrounded by copies, and gives way to the best of them."""

    copies: int
    """Copies of each pose."""
    distance: float
    """Standard deviation of their shifts along each axis, metres."""
    angle: float
    """Standard deviation of their turns, radians."""

    def __post_init__(self) -> None:
        """Checks the numbers; one out of its range is a UserError."""
        check_number("a round's copies", self.copies, 1)
        check_number("a round's distance", self.distance, 0)
        check_number("a round's angle", self.angle, 0)


ROUNDS = (Round(10, 0.04, 1.2), Round(10, 0.03, 0.8), Round(8, 0.02, 0.5), Round(8, 0.012, 0.3), Round(8, 0.006, 0.15))
"""From the size of an object and any direction down to what a gradient's step repairs."""

CLIMB = Schedule((Phase(groups=("position", "orientation"), steps=16, learning_rate=0.005, decay=0.85),))
"""A short ascent of both groups at once, from poses that resampling has brought near a maximum."""

FEW_ROUNDS = (Round(6, 0.02, 0.8), Round(6, 0.012, 0.4), Round(6, 0.006, 0.2))
"""As `ROUNDS`, from candidates that lie on objects."""

POLISH = (Round(6, 0.008, 0.2), Round(6, 0.005, 0.12), Round(6, 0.003, 0.08))
"""Around grasps that have climbed: small moves that give the hand room."""

SHORT_CLIMB = Schedule((Phase(groups=("position", "orientation"), steps=12, learning_rate=0.004, decay=0.82),))
"""As `CLIMB`, shorter."""

JOINT = Schedule((Phase(groups=("position", "orientation"), steps=64, learning_rate=0.02, plateau=Plateau()),))
"""Both groups at once from afar: as long as it rises, then shorter steps, until they are 1 mm long."""
