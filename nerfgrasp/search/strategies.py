"""Whole searches by name: how many candidates are drawn, which of them climb, how, and within which limits."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from nerfgrasp.checks import check_number
from nerfgrasp.errors import UserError, choices_hint, unknown_name
from nerfgrasp.grippers import Gripper
from nerfgrasp.search.feasibility import ONE_VIEW, Feasibility
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.schedule import (
    CLIMB,
    FEW_ROUNDS,
    HALVING,
    JOINT,
    PAPER,
    POLISH,
    ROUNDS,
    SHORT_CLIMB,
    Round,
    Schedule,
)

SEARCH_VERSION = 1
"""Raised when a change of the code makes the same strategy find other grasps: results then say so."""


@dataclass(frozen=True)
class Strategy:
    """What `--strategy` names: everything that a search does, but for the seed and the pose parameterization."""

    name: str
    """As results call it."""
    candidates: int
    """Random poses that are drawn."""
    keep: int | None
    """How many of them, the best by value, go on; None for all, unvalued."""
    climb: Schedule
    """How those climb."""
    rounds: tuple[Round, ...] = ()
    """How those are resampled before they climb."""
    climbers: int | None = None
    """How many of those, different ones, climb; None for all."""
    spacing: float | None = None
    """Metres between the points at which the model's density is asked, to draw candidates where it is; None draws them
    anywhere in the workspace."""
    limits: Limits | None = field(default_factory=Limits)
    """What every pose keeps to; None for the workspace alone."""
    feasibility: Feasibility | None = field(default_factory=Feasibility)
    """What is added to the values of the grasps found; None lets Ψ alone judge."""
    weighed: int | None = None
    """How many of those, different ones and the best by value, are weighed so and returned; None for all."""
    polish: tuple[Round, ...] = POLISH
    """How the best of those are resampled by value and feasibility together, the better half of them again."""
    polished: int = 8
    """How many of them in the first round."""

    def __post_init__(self) -> None:
        """Checks the numbers; one out of its range is a UserError."""
        for name in ("candidates", "keep", "climbers", "weighed", "polished"):
            check_number(name, getattr(self, name), 1)
        check_number("spacing", self.spacing, 0, above=True)

    @property
    def climbing(self) -> int:
        """How many climb at most."""
        return min(count for count in (self.candidates, self.keep, self.climbers) if count is not None)

    def blind(self) -> "Strategy":
        """Returns a search for a model that has not learned to render: its density means nothing and is not asked.

        Candidates that lie anywhere are too few where `guided` draws them, so `alone` takes its place; what differs
        from its own numbers, because somebody gave it, is kept.
        """
        base = self
        if self.name == GUIDED.name and self.spacing is not None:
            values = {one.name: getattr(self, one.name) for one in fields(self) if one.name not in ("name", "spacing")}
            base = replace(ALONE, **{name: v for name, v in values.items() if v != getattr(GUIDED, name)})
        return replace(base, spacing=None, feasibility=None)

    def one_view(self) -> "Strategy":
        """Returns a search for a model that sees one view at a time: density counts half, if nobody gave weights."""
        return replace(self, feasibility=ONE_VIEW) if self.feasibility == Feasibility() else self

    def with_gripper(self, gripper: Gripper) -> "Strategy":
        """Returns the same search with limits and feasibility for another gripper."""
        limits = None if self.limits is None else replace(self.limits, gripper=gripper)
        feasibility = None if self.feasibility is None else replace(self.feasibility, gripper=gripper)
        return replace(self, limits=limits, feasibility=feasibility)

    @property
    def identity(self) -> str:
        """Name and hash of all that it does, e.g. `guided-0123456789abcdef`; `SEARCH_VERSION` counts too."""
        settings = asdict(self)
        for part in ("limits", "feasibility"):
            if settings[part] is not None:
                settings[part]["gripper"] = getattr(self, part).gripper.settings()
        text = json.dumps([SEARCH_VERSION, settings], sort_keys=True)
        return f"{self.name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"

    def settings(self) -> dict[str, Any]:
        """Returns as JSON data what a user may have set."""
        limits = self.limits
        tilt = None if limits is None or limits.max_tilt >= math.pi else round(math.degrees(limits.max_tilt), 6)
        clearance = None if limits is None else limits.clearance
        keep = self.candidates if self.keep is None else min(self.keep, self.candidates)
        counts = {"candidates": self.candidates, "keep": keep}
        return {"strategy": self.name, **counts, "max_tilt_degrees": tilt, "clearance": clearance}

    def __str__(self) -> str:
        climbing = self.climbing
        return f"{self.candidates} candidates, {'all' if climbing == self.candidates else f'the best {climbing}'} climb"


GUIDED = Strategy(
    "guided", candidates=512, keep=64, spacing=0.015, rounds=FEW_ROUNDS, climbers=32, climb=SHORT_CLIMB, weighed=24
)
"""Candidates where the model sees something, so that few will do; then as `resample`, with less of everything."""
RESAMPLE = Strategy("resample", candidates=2048, keep=128, rounds=ROUNDS, climb=CLIMB)
"""Resampling rounds around the best, then a short climb of both groups (measured in docs/results.md)."""
ALONE = replace(RESAMPLE, name="alone", climbers=32, feasibility=None)
"""As `resample`, but Ψ alone judges: all that can be done for a model that never learned to render. One that did can be
compared with it so. A quarter as many climb, which finds values as high in two thirds of the time (docs/trials.md)."""
JOINT_SEARCH = Strategy("joint", candidates=512, keep=None, climb=JOINT)
"""All climb, both groups at once, each at its own pace and until all have converged."""
PRUNE = Strategy("prune", candidates=4096, keep=128, climb=JOINT)
"""Many are evaluated once; the best climb jointly."""
PAPER_SEARCH = Strategy("paper", candidates=4096, keep=None, climb=PAPER, limits=None, feasibility=None)
"""Algorithm 1 as the paper has it: positions, then orientations, of all candidates, and Ψ alone judges."""
HALVING_SEARCH = replace(PAPER_SEARCH, name="halving", climb=HALVING)
"""As `paper`, but who falls behind is left behind, and each ends at the best pose that it has seen."""

STRATEGIES = {
    strategy.name: strategy for strategy in (GUIDED, RESAMPLE, ALONE, JOINT_SEARCH, PRUNE, PAPER_SEARCH, HALVING_SEARCH)
}
"""By name; the first is the default."""
DEFAULT_STRATEGY = GUIDED.name


def find_strategy(
    name: str = DEFAULT_STRATEGY,
    *,
    candidates: int | None = None,
    keep: int | None = None,
    max_tilt: float | None = None,
    clearance: float | None = None,
) -> Strategy:
    """Returns a search by its name, with what is given in place of its own.

    Example:
        >>> print(find_strategy("prune", keep=16))
        4096 candidates, the best 16 climb

    Args:
        name: one of `STRATEGIES`.
        candidates: how many random poses are drawn.
        keep: how many of them go on.
        max_tilt: by how much an approach may differ from straight down at most, degrees; 180 for any.
        clearance: to keep free between the open gripper and the table, metres.

    Raises:
        UserError: there is no search of that name, or a number is out of its range.
    """
    if name not in STRATEGIES:
        raise unknown_name("strategy", name, STRATEGIES)
    strategy = STRATEGIES[name]
    limits = strategy.limits
    if max_tilt is not None or clearance is not None:
        limits = Limits(max_tilt=math.pi, clearance=None) if limits is None else limits
    if limits is not None and max_tilt is not None:
        if not 0 <= max_tilt <= 180:
            raise UserError(f"max_tilt is {max_tilt}: it must be from 0 to 180 degrees")
        limits = replace(limits, max_tilt=math.radians(max_tilt))
    if limits is not None and clearance is not None:
        limits = replace(limits, clearance=clearance)
    strategy = replace(strategy, limits=limits)
    strategy = strategy if candidates is None else replace(strategy, candidates=candidates)
    return strategy if keep is None else replace(strategy, keep=keep)


def as_strategy(given: str | Mapping[str, Any] | Strategy) -> Strategy:
    """Returns the strategy that a name, the arguments of `find_strategy` or a strategy stand for.

    Example:
        >>> print(as_strategy({"name": "prune", "keep": 16}))
        4096 candidates, the best 16 climb

    Raises:
        UserError: as for `find_strategy`, or it has no such argument.
    """
    if isinstance(given, Strategy):
        return given
    arguments = {"name": given} if isinstance(given, str) else dict(given)
    for name in arguments:
        if name not in _ARGUMENTS:
            raise UserError(f"strategy has no {name!r}: {choices_hint(name, _ARGUMENTS)}")
    return find_strategy(**arguments)


_ARGUMENTS = ("name", "candidates", "keep", "max_tilt", "clearance")
