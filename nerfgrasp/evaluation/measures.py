"""What is counted in the attempts of each task, and over what it is summed before it is compared."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from nerfgrasp.evaluation.results import Row
from nerfgrasp.evaluation.runs import SUCCESS, Run

Attempts = Sequence[Row]
"""Of one scene."""


@dataclass(frozen=True)
class Measure:
    """A rate: what is counted in a scene, out of how many."""

    name: str
    """The column's name."""
    count: Callable[[Attempts], tuple[int, int]]
    """Returns successes and trials of one scene."""


@dataclass(frozen=True)
class TaskReport:
    """What a task's results are judged by."""

    measures: tuple[Measure, ...]
    """The columns."""
    cluster: str
    """What resembles itself: `attempt` (none does: Wilson and McNemar), `scene` or `object` (bootstrap over them)."""


def successes(attempts: Attempts) -> tuple[int, int]:
    """Returns how many attempts succeeded, of how many."""
    return sum(row.outcome == SUCCESS for row in attempts), len(attempts)


def cleared(attempts: Attempts) -> tuple[int, int]:
    """Returns how many objects were lifted out of a scene, of how many."""
    return successes(attempts)[0], len(attempts[0].objects)


def dropped(attempts: Attempts) -> tuple[int, int]:
    """Returns how many objects ended outside of the workspace, of how many."""
    return sum(len(row.dropped) for row in attempts), len(attempts[0].objects)


SUCCESS_RATE = Measure("success", successes)
"""Successes of attempts."""

TASKS = {
    "simple": TaskReport((SUCCESS_RATE,), "attempt"),
    "clutter": TaskReport((SUCCESS_RATE, Measure("cleared", cleared), Measure("dropped", dropped)), "scene"),
    "novel": TaskReport((SUCCESS_RATE,), "object"),
}
"""By name: the tasks and how each is judged."""


def clusters(run: Run, measure: Measure, scenes: Sequence[int]) -> dict[str, tuple[int, int]]:
    """Returns successes and trials by cluster, in an order that two runs over the same scenes share."""
    by_object = TASKS[run.task].cluster == "object"
    counts: dict[str, tuple[int, int]] = {}
    for scene in scenes:
        attempts = run.scenes[scene]
        name = " and ".join(attempts[0].objects) if by_object else str(scene)
        before, more = counts.get(name, (0, 0)), measure.count(attempts)
        counts[name] = (before[0] + more[0], before[1] + more[1])
    return counts
