"""Searches compared in the same simple scenes: rows that outlive a killed run, what they hold, and the tables of them.

`poses.py` and `schedules.py` share it.
"""

import json
import os
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar
from unittest.mock import patch

import numpy as np
import torch
from proposals import NO_ERRORS, load, observed
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.statistics import difference_interval, mcnemar, wilson_interval
from nerfgrasp.evaluation.tables import Table, format_tables
from nerfgrasp.evaluation.trials import pose_errors
from nerfgrasp.methods.psi import ObservedScene, Psi
from nerfgrasp.models import GraspValue
from nerfgrasp.models.mvnerf import SceneFeatures
from nerfgrasp.parallel import run_all
from nerfgrasp.scenes.scene import Grasps, Truth
from nerfgrasp.search.ascent import Trace
from nerfgrasp.sim.attempt import Outcome, attempt_grasp
from nerfgrasp.sim.physics import physics_hash
from nerfgrasp.sim.tasks import find_task

REPORTED_SEED = 100
"""Of the scenes that figures are reported of."""
CONVERGED = 0.1
"""A candidate has converged once the best value that it has seen is so near to the best it will see, logits."""
GRADIENT = 2
"""Evaluations that one with a gradient counts as."""

Row = dict[str, Any]
"""What became of one case in one scene."""


class Case(Protocol):
    """One of the things that are compared."""

    @property
    def label(self) -> str:
        """What rows and tables call it: no two cases share one."""


C = TypeVar("C", bound=Case)


@dataclass(frozen=True)
class Seen:
    """A scene as a search meets it."""

    truth: Truth
    """What physics builds."""
    psi: Psi
    """The method, its model loaded once a process."""
    scene: ObservedScene
    """What the model makes of the images."""


@dataclass
class Spent:
    """What a search costs."""

    evaluations: int = 0
    """Of the grasp value; one with a gradient counts as two. The model's density is asked besides, and not counted."""


def run(
    measure: Callable[..., list[Row]],
    cases: Sequence[C],
    *,
    model: str,
    seed: int,
    attempts: bool,
    out: Path,
    scenes: int,
    workers: int | None,
    **settings: Any,
) -> list[Row]:
    """As `compare`, with `measure(scene, cases)` given the model, the seed, whether to carry grasps out, and settings.

    Args:
        measure: as there, with these as further arguments, by name.
        cases: what is compared.
        model: folder or shipped name of a grasp value.
        seed: of the scenes.
        attempts: whether grasps are carried out.
        out: JSON lines.
        scenes: how many.
        workers: see `compare`.
        settings: JSON data that the rows depend on beside these.
    """
    job = partial(measure, model=model, seed=seed, attempts=attempts, **settings)
    shared = {"model": model, "seed": seed, **settings, "physics": physics_hash() if attempts else None}
    return compare(job, cases, shared, out=out, scenes=scenes, workers=workers)


def compare(
    measure: Callable[[int, Sequence[C]], list[Row]],
    cases: Sequence[C],
    settings: Row,
    *,
    out: Path,
    scenes: int,
    workers: int | None,
) -> list[Row]:
    """Measures every case in every scene, but for what `out` holds already, to which each scene's rows are added.

    Args:
        measure: returns the rows of cases in a scene, in their order.
        cases: what is compared.
        settings: JSON data that the rows of all cases depend on.
        out: JSON lines.
        scenes: how many, from the first.
        workers: processes of one thread each; one a core if None.

    Returns:
        The rows of these cases and scenes, scene by scene, in the order of the cases.

    Raises:
        UserError: `out` holds rows of other settings, or is damaged.
    """
    done = {(row["scene"], row["case"]): row for row in read_rows(out, settings)}

    def left(scene: int) -> list[C]:
        return [case for case in cases if (scene, case.label) not in done]

    todo = {scene: left(scene) for scene in range(scenes)}

    def job(scene: int) -> list[Row]:
        measured = zip(todo[scene], measure(scene, todo[scene]), strict=True)
        return [{**settings, "scene": scene, "case": case.label, **row} for case, row in measured]

    def keep(rows: list[Row]) -> None:
        with out.open("a") as file:
            file.write("".join(json.dumps(row, allow_nan=False) + "\n" for row in rows))
        done.update({(row["scene"], row["case"]): row for row in rows})

    run_all(
        job,
        lambda: [scene for scene in range(scenes) if left(scene)],
        scenes,
        workers=workers,
        describe=out.name,
        unit="scene",
        keep=keep,
    )
    return [done[scene, case.label] for scene in range(scenes) for case in cases]


def read_rows(out: Path, settings: Row) -> list[Row]:
    """Reads what an earlier run left; a last line torn by a kill is cut off, and no file is no rows.

    Raises:
        UserError: a line is damaged, or of other settings.
    """
    if not out.exists():
        return []
    data = out.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if len(whole) < len(data):
        os.truncate(out, len(whole))
    rows = []
    for number, line in enumerate(whole.splitlines(), start=1):
        try:
            rows.append(json.loads(line))
        except ValueError as error:
            raise UserError(f"{out}, line {number}: {error}") from error
        if other := [key for key, value in settings.items() if rows[-1].get(key) != value]:
            raise UserError(
                f"{out}, line {number}: {other[0]} is {rows[-1].get(other[0])!r}, not {settings[other[0]]!r}: "
                "give another --out"
            )
    return rows


def look(model: str, seed: int, index: int) -> Seen:
    """Renders a scene as `nerfgrasp evaluate` does, and encodes its images."""
    truth, psi = find_task("simple").draw(seed, index), load(model)
    return Seen(truth, psi, observed(psi, truth))


@contextmanager
def counting(model: GraspValue) -> Iterator[Spent]:
    """Yields what is spent on a model's values inside of the block."""
    value, spent = model.value, Spent()

    def counted(features: SceneFeatures, T_world_grasp: Tensor) -> Tensor:
        spent.evaluations += len(T_world_grasp) * (GRADIENT if T_world_grasp.requires_grad else 1)
        return value(features, T_world_grasp)

    with patch.object(model, "value", counted):
        yield spent


def climb_measures(trace: Trace) -> Row:
    """Returns what a climb came to, by Ψ alone: values in logits, steps from the start."""
    values = trace.value.nan_to_num(nan=-torch.inf)
    best = values.cummax(dim=0).values
    steps = (best < best[-1] - CONVERGED).sum(dim=0)
    final = values[-1]
    return {
        "start": float(values[0].max()),
        "value": float(final.max()),
        "mean": float(final[final.isfinite()].mean()),
        "steps": int(steps[final.argmax()]),
        "median_steps": float(steps.double().quantile(0.5)),
        "fell": float((final < values[0]).double().mean()),
    }


def attempt_measures(truth: Truth, grasps: Grasps) -> Row:
    """Carries the first of the grasps out, and returns the outcome and its errors to the nearest valid grasp."""
    grasp = grasps.T_world_grasp[0].double()
    outcome = str(attempt_grasp(truth, grasp).outcome)
    return {"weighed": float(grasps.value[0]), "outcome": outcome, **(pose_errors(truth, grasp) or NO_ERRORS)}


def best(cases: Sequence[C], rows: Sequence[Row]) -> C:
    """Returns the case of the highest mean value over scenes; of equals, the first."""
    return max(cases, key=lambda case: statistics.fmean(_column(rows, case.label, "value")))


def on_edge(cases: Sequence[C], rows: Sequence[Row]) -> str:
    """Returns a remark where the best of cases, in the order of what is tuned, is the first or the last."""
    return ", at the edge of its grid" if best(cases, rows) in (cases[0], cases[-1]) else ""


def print_comparison(rows: Sequence[Row]) -> None:
    """Prints all tables of rows with attempts."""
    print(format_tables([table(rows) for table in (climbs_table, attempts_table, differences_table)]), end="")


def climbs_table(rows: Sequence[Row]) -> Table:
    """Returns a line a case of what the climbs came to: means over scenes with standard errors, or medians."""
    lines = []
    for case in _cases(rows):
        column = {name: _column(rows, case, name) for name in rows[0] if isinstance(rows[0][name], float | int)}
        lines.append(
            (
                case,
                str(len(column["value"])),
                *(_mean(column[name]) for name in ("start", "value", "mean")),
                *(f"{statistics.median(column[name]):g}" for name in ("steps", "median_steps")),
                f"{statistics.fmean(column['fell']):.3f}",
                f"{statistics.fmean(column['evaluations']):.0f}",
            )
        )
    header = ("case", "scenes", "best start", "best value", "mean value", "steps", "of all", "fell", "evaluations")
    note = (
        f"Means over scenes (standard errors), Ψ alone; medians of the steps to within {CONVERGED:g} of the best, of "
        "the best candidate and of the median one; the share that ended lower than it began."
    )
    return Table("Climbs", header, tuple(lines), (note,))


def attempts_table(rows: Sequence[Row]) -> Table:
    """Returns a line a case of what became of the grasps."""
    lines = []
    for case in _cases(rows):
        won = _successes(rows, case)
        low, high = wilson_interval(int(won.sum()), len(won))
        errors = (f"{statistics.median(_column(rows, case, name)):.1f}" for name in ("distance_mm", "angle_deg"))
        lines.append((case, f"{int(won.sum())} of {len(won)}", f"{won.mean():.3f} [{low:.3f}, {high:.3f}]", *errors))
    header = ("case", "successes", "success [95 % interval]", "median mm", "median °")
    note = "The best by Ψ and feasibility, carried out; Wilson's intervals; errors to the nearest valid grasp."
    return Table("Attempts", header, tuple(lines), (note,))


def differences_table(rows: Sequence[Row]) -> Table:
    """Returns each case less the first, scene by scene, in success and in the best value."""
    first, *others = _cases(rows)
    one, value = _successes(rows, first), np.array(_column(rows, first, "value"))
    lines = []
    for case in others:
        other = _successes(rows, case)
        only_other, only_first = int((other & ~one).sum()), int((one & ~other).sum())
        rise = _mean((np.array(_column(rows, case, "value")) - value).tolist())
        p = f"{mcnemar(only_other, only_first):.3f}"
        lines.append((case, _difference(other, one), str(only_other), str(only_first), p, rise))
    header = ("case", "success [95 % interval]", "only this", "only first", "McNemar's p", "best value")
    how = "Paired bootstrap over scenes; Newcombe's interval where all are the same."
    note = f"{how} Mean (standard error) of the difference in Ψ's best value."
    return Table(f"Less {first}, in the same scenes", header, tuple(lines), (note,))


def _cases(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["case"] for row in rows))


def _column(rows: Sequence[Row], case: str, name: str) -> list[float]:
    return [row[name] for row in rows if row["case"] == case]


def _successes(rows: Sequence[Row], case: str) -> np.ndarray:
    return np.array([row["outcome"] == Outcome.SUCCESS for row in rows if row["case"] == case])


def _mean(values: Sequence[float]) -> str:
    error = f"{statistics.stdev(values) / len(values) ** 0.5:.2f}" if len(values) > 1 else "-"
    return f"{statistics.fmean(values):.2f} ({error})"


def _difference(one: np.ndarray, other: np.ndarray) -> str:
    difference = f"{one.mean() - other.mean():+.3f}"
    trials = np.ones(len(one))
    interval = difference_interval((one, trials), (other, trials), np.random.default_rng(0))
    if interval is None:
        return difference
    low, high = interval
    return f"{difference} [{low:+.3f}, {high:+.3f}]"
