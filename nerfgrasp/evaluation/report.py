"""The paper's table out of results files: success rates with intervals, paired differences, outcomes, errors, times."""

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from nerfgrasp.errors import unknown_name
from nerfgrasp.evaluation.measures import SUCCESS_RATE, TASKS, Measure, clusters, successes
from nerfgrasp.evaluation.paper import paper_table
from nerfgrasp.evaluation.runs import SUCCESS, Run, common_scenes
from nerfgrasp.evaluation.statistics import (
    difference_interval,
    mcnemar,
    permutation_test,
    rate_interval,
    wilson_interval,
)
from nerfgrasp.evaluation.tables import Table
from nerfgrasp.sim.physics import physics_hash

SEED = 0
"""Of every bootstrap and permutation test: a report of the same files is the same."""
FEW_CLUSTERS = 20
"""Bootstraps over fewer are known to give too narrow intervals."""

_MEANINGS = {
    "cleared": "cleared: of a scene's objects, those lifted out",
    "dropped": "dropped: those left outside of the workspace",
}


def report_tables(runs: Sequence[Run], *, paper: bool = False) -> list[Table]:
    """Returns the report of runs that `load_runs` found comparable: the overview, then each task's tables.

    Args:
        runs: the runs; those of repeated trainings count only where trainings are compared.
        paper: whether the paper's own figures follow the overview.

    Raises:
        UserError: a run is of a task that is not known.
    """
    for run in runs:
        if run.task not in TASKS:
            raise unknown_name(f"task in {run.path}:", run.task, TASKS)
    first = [run for run in runs if not run.repeated]
    tables = [success_table(first), trainings_table(runs)] if first else [trainings_table(runs)]
    tables += [paper_table([task for task in TASKS if any(run.task == task for run in runs)])] if paper else []
    for task in TASKS:
        mine = [run for run in first if run.task == task]
        if mine:
            tables += [differences_table(mine), outcomes_table(mine), errors_table(mine)]
            tables += [objects_table(mine)] if TASKS[task].cluster == "object" else []
            tables += [times_table(mine)] if any(run.times for run in mine) else []
    return [table for table in tables if table.rows]


def success_table(runs: Sequence[Run]) -> Table:
    """Returns the paper's table: a row a method, a column a task's measure, each rate with its 95 % interval."""
    tasks = [task for task in TASKS if any(run.task == task for run in runs)]
    columns = [(task, measure) for task in tasks for measure in TASKS[task].measures]
    cells = {(run.label, run.task): [_rate(run, measure) for measure in TASKS[run.task].measures] for run in runs}
    rows = []
    for label in _labels(runs):
        row = [cells.get((label, task), [""] * len(TASKS[task].measures)) for task in tasks]
        rows.append((label, *(cell for part in row for cell in part)))
    header = ("method", *(f"{task} {measure.name}" for task, measure in columns))
    return Table("Success rates [95 % interval]", header, tuple(rows), _notes(runs, tasks))


def trainings_table(runs: Sequence[Run]) -> Table:
    """Returns what each method's repeated trainings differ by: the mean, the least and the most of each rate."""
    names = dict.fromkeys(run.name for run in runs if run.repeated)
    tasks = [task for task in TASKS if any(run.task == task and run.repeated for run in runs)]
    rows = []
    for name in names:
        cells, count = [], 0
        for task in tasks:
            mine = [run for run in runs if (run.name, run.task) == (name, task)]
            count = max(count, len(mine))
            cells += [_spread([_value(run, measure) for run in mine]) for measure in TASKS[task].measures]
        rows.append((name, str(count), *cells))
    header = ("method", "trainings", *(f"{task} {measure.name}" for task in tasks for measure in TASKS[task].measures))
    note = "Mean (least to most) over trainings with different seeds; the other tables are of the first."
    return Table("Training seeds", header, tuple(rows), (note,))


def differences_table(runs: Sequence[Run]) -> Table:
    """Returns one task's paired differences between every two methods, over the scenes that both were tried in."""
    task = TASKS[runs[0].task]
    paired = task.cluster == "attempt"
    names = [f"{measure.name} [95 % interval]" for measure in task.measures]
    if not paired:
        names = [
            name for measure, name in zip(task.measures, names, strict=True) for name in (name, f"{measure.name}: p")
        ]
    header = ("methods", "scenes", *names, *(("only first", "only second", "McNemar's p") if paired else ()))
    rows = []
    for one, other in combinations(runs, 2):
        scenes = common_scenes(one, other)
        cells = [cell for measure in task.measures for cell in _compared(one, other, scenes, measure, not paired)]
        cells += _mcnemar(one, other, scenes) if paired else []
        rows.append((f"{one.label} - {other.label}", str(len(scenes)), *cells))
    over = "objects" if task.cluster == "object" else "scenes"
    how = f"paired bootstrap over {over}; Newcombe's, of as many trials as {over}, if the difference is the same in all"
    notes = [f"First less second, in the same scenes; intervals: {how}."]
    notes += [] if paired else [f"p: paired permutation test over {over}, two-sided."]
    return Table(f"{runs[0].task}: paired differences", header, tuple(rows), tuple(notes))


def outcomes_table(runs: Sequence[Run]) -> Table:
    """Returns how often one task's attempts ended how, success first, then the most frequent failure first."""
    counts = {run.label: Counter(row.outcome for row in run.rows) for run in runs}
    total: Counter[str] = sum(counts.values(), Counter())
    outcomes = sorted(total, key=lambda outcome: (outcome != SUCCESS, -total[outcome], outcome))
    rows = [(outcome, *(str(counts[run.label][outcome]) for run in runs)) for outcome in outcomes]
    rows.append(("attempts", *(str(len(run.rows)) for run in runs)))
    return Table(f"{runs[0].task}: outcomes", ("outcome", *(run.label for run in runs)), tuple(rows))


def errors_table(runs: Sequence[Run]) -> Table:
    """Returns the errors to the nearest valid grasp, where the valid grasps are known."""
    rows = []
    for run in runs:
        errors = [row.errors for row in run.rows if row.errors is not None]
        if errors:
            cells = (_quartiles([error[name] for error in errors]) for name in ("distance_mm", "angle_deg"))
            rows.append((run.label, str(len(errors)), *cells))
    header = ("method", "grasps", "distance, mm", "angle, degrees")
    note = "To the nearest valid grasp: median (quartiles)."
    return Table(f"{runs[0].task}: pose errors", header, tuple(rows), (note,))


def objects_table(runs: Sequence[Run]) -> Table:
    """Returns the success rate of each object by each method, with Wilson's interval."""
    counts = {run.label: clusters(run, SUCCESS_RATE, sorted(run.scenes)) for run in runs}
    rows = []
    for name in sorted({name for by_object in counts.values() for name in by_object}):
        cells = (counts[run.label].get(name) for run in runs)
        rows.append((name, *("" if cell is None else _wilson(*cell) for cell in cells)))
    header = ("object", *(run.label for run in runs))
    note = "Successes of attempts, with Wilson's interval."
    return Table(f"{runs[0].task}: objects [95 % interval]", header, tuple(rows), (note,))


def times_table(runs: Sequence[Run]) -> Table:
    """Returns the medians of wall time an attempt, in seconds."""
    names = ("render_s", "propose_s", "attempt_s")
    rows = [
        (run.label, *(f"{np.median([getattr(one, name) for one in run.times]):.3f}" for name in names))
        for run in runs
        if run.times
    ]
    header = ("method", "render, s", "propose, s", "attempt, s")
    return Table(f"{runs[0].task}: time", header, tuple(rows), ("Median seconds an attempt.",))


def _notes(runs: Sequence[Run], tasks: Sequence[str]) -> tuple[str, ...]:
    notes = [_note([run for run in runs if run.task == task]) for task in tasks]
    if any(TASKS[task].cluster != "attempt" for task in tasks):
        line = "A rate that is the same in all gives a bootstrap nothing to resample"
        notes.append(f"{line}: Wilson's interval, of as many clusters.")
    names = {measure.name for task in tasks for measure in TASKS[task].measures}
    meanings = [meaning for name, meaning in _MEANINGS.items() if name in names]
    notes += [f"success: of all attempts; {'; '.join(meanings)}."] if meanings else []
    named = {run.label: run.rows[0] for run in runs if not run.label.startswith(run.rows[0].method)}
    notes += [f"{label}: method {row.method}, model {row.model or 'none'}." for label, row in named.items()]
    versions = sorted({", ".join(f"{name} {v}" for name, v in run.rows[0].versions.items()) for run in runs})
    physics, current = runs[0].rows[0].physics, physics_hash()
    differs = "" if physics == current else f", which is not this program's ({current})"
    return (*notes, f"Physics {physics}{differs}; {'; and '.join(versions)}.")


def _note(runs: Sequence[Run]) -> str:
    """Returns the line about one task's scenes and intervals."""
    task, cluster, numbers = runs[0].task, TASKS[runs[0].task].cluster, sorted({len(run.scenes) for run in runs})
    count = f"{numbers[0]}" if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"
    line = f"{task}: {count} scenes of the set {runs[0].rows[0].set}; intervals: "
    if cluster == "attempt":
        return f"{line}Wilson's."
    fewest = min(len(clusters(run, SUCCESS_RATE, sorted(run.scenes))) for run in runs)
    few = f", rather too narrow for as few as {fewest}" if fewest < FEW_CLUSTERS else ""
    return f"{line}bootstrap over {cluster}s{few}."


def _labels(runs: Iterable[Run]) -> list[str]:
    return list(dict.fromkeys(run.label for run in runs))


def _columns(run: Run, measure: Measure, scenes: Sequence[int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    successes, trials = np.array(list(clusters(run, measure, scenes).values()), dtype=np.int64).reshape(-1, 2).T
    return successes, trials


def _rate(run: Run, measure: Measure) -> str:
    won, trials = _columns(run, measure, sorted(run.scenes))
    if TASKS[run.task].cluster == "attempt":
        return _wilson(int(won.sum()), int(trials.sum()))
    return _with_interval(_value(run, measure), rate_interval(won, trials, np.random.default_rng(SEED)))


def _value(run: Run, measure: Measure) -> float:
    won, trials = _columns(run, measure, sorted(run.scenes))
    return float(won.sum() / trials.sum())


def _spread(values: Sequence[float]) -> str:
    return f"{np.mean(values):.2f} ({min(values):.2f} to {max(values):.2f})" if values else ""


def _wilson(successes: int, trials: int) -> str:
    return _with_interval(successes / trials, wilson_interval(successes, trials))


def _compared(one: Run, other: Run, scenes: Sequence[int], measure: Measure, test: bool) -> list[str]:
    """Returns the difference of two rates with its interval and, if asked for, the permutation test's p."""
    if not scenes:
        return [""] * (1 + test)
    first, second = _columns(one, measure, scenes), _columns(other, measure, scenes)
    rates = [won.sum() / trials.sum() for won, trials in (first, second)]
    interval = difference_interval(first, second, np.random.default_rng(SEED))
    cells = [_with_interval(rates[0] - rates[1], interval, "+.2f")]
    return [*cells, _p(permutation_test(first, second, np.random.default_rng(SEED)))] if test else cells


def _mcnemar(one: Run, other: Run, scenes: Sequence[int]) -> list[str]:
    pairs = [(successes(one.scenes[scene])[0] > 0, successes(other.scenes[scene])[0] > 0) for scene in scenes]
    only_first, only_second = pairs.count((True, False)), pairs.count((False, True))
    return [str(only_first), str(only_second), _p(mcnemar(only_first, only_second))]


def _p(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _with_interval(rate: float, interval: tuple[float, float] | None, form: str = ".2f") -> str:
    """Returns e.g. `0.84 [0.76, 0.90]`; a single cluster has no interval."""
    return f"{rate:{form}} [{interval[0]:{form}}, {interval[1]:{form}}]" if interval else f"{rate:{form}} [unknown]"


def _quartiles(values: Sequence[float]) -> str:
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{middle:.1f} ({low:.1f}, {high:.1f})"
