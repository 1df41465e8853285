r"""Which schedule of the search finds the best grasps for as many evaluations of the grasp value.

    python benchmarks/schedules.py tune --out schedules-tuning.jsonl
    python benchmarks/schedules.py compare --rates '{joint: 0.02, prune: 0.02}' --out schedules.jsonl
    python benchmarks/schedules.py full --seed 200 --scenes 50 --out full.jsonl

The named schedules search the same simple scenes, each with so few candidates that it spends about what `guided` does;
an evaluation with a gradient counts as two. All keep to the same limits, and their grasps are weighed by the same
feasibility, but not polished, before the best is carried out; `paper as it is` has neither. The model's density, asked
for candidates and for feasibility, is not counted. Most schedules draw their candidates anywhere; with `--spacing
0.015` all draw them where the model sees something, as `guided` does, so that only what follows tells them apart.
`tune` finds the learning rates of `joint` and `prune` by the mean over scenes of the best final value, out of seven
each; the others keep theirs.

`full` holds the paper's full search, 4,096 candidates by `halving`, against the default one, at any cost: it keeps to
the default's limits, and its grasps are weighed and polished as the default's are. (Without these it is
`nerfgrasp evaluate --schedule halving`.)

A killed run goes on where the same command is given again; a finished one prints its tables again.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import comparison
from comparison import REPORTED_SEED, Row
from jsonargparse import auto_cli
from search import TUNING_SEED

from nerfgrasp.errors import unknown_name
from nerfgrasp.evaluation.tables import format_tables
from nerfgrasp.evaluation.trials import proposal_generator
from nerfgrasp.models.folder import DEFAULT_MODEL
from nerfgrasp.search.feasibility import Feasibility
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.strategies import GUIDED, HALVING_SEARCH, JOINT_SEARCH, PAPER_SEARCH, PRUNE, RESAMPLE, Strategy

AS_IT_IS = "paper as it is"
_SAME = {"limits": Limits(), "feasibility": Feasibility(), "polish": ()}
EQUAL = {
    "guided": replace(GUIDED, **_SAME),
    "resample": replace(RESAMPLE, candidates=462, keep=26, **_SAME),
    "joint": replace(JOINT_SEARCH, candidates=35, **_SAME),
    "prune": replace(PRUNE, candidates=1024, keep=21, **_SAME),
    "paper": replace(PAPER_SEARCH, candidates=38, **_SAME),
    AS_IT_IS: replace(PAPER_SEARCH, candidates=38),
}
"""By what tables call them: the first is what the others are held against. `guided` spends at most 2464 evaluations,
`resample` 2464 and `paper` 2470; how many `joint` and `prune` do, which stop once converged, was tried in scenes of the
tuning seed."""
FULL = {"default": GUIDED, "full": replace(HALVING_SEARCH, limits=Limits(), feasibility=Feasibility())}
"""What `full` compares, by what tables call it."""
TUNED = ("joint", "prune")
RATES = (0.0025, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)


@dataclass(frozen=True)
class Case:
    """A schedule, perhaps with another learning rate."""

    name: str
    """In `EQUAL` or `FULL`."""
    rate: float | None = None
    """Of all phases of its climb; None for its own."""

    @property
    def label(self) -> str:
        """What rows and tables call it."""
        return self.name if self.rate is None else f"{self.name} {self.rate:g}"

    @property
    def strategy(self) -> Strategy:
        """The whole search."""
        found = {**EQUAL, **FULL}[self.name]
        if self.rate is None:
            return found
        phases = tuple(replace(phase, learning_rate=self.rate) for phase in found.climb.phases)
        return replace(found, climb=replace(found.climb, phases=phases))


def tune(
    out: Path,
    scenes: int = 16,
    spacing: float | None = None,
    model: str = DEFAULT_MODEL,
    seed: int = TUNING_SEED,
    workers: int | None = None,
) -> None:
    """Finds the learning rates of `joint` and `prune`, and prints them as `compare` takes them.

    Args:
        out: JSON lines, one a scene and case.
        scenes: how many.
        spacing: of the points at which the density is asked, metres; each schedule's own way if not given.
        model: folder or shipped name of a grasp value.
        seed: of the scenes; not the reported one.
        workers: processes; one a core if not given.
    """
    grids = [[Case(name, rate) for rate in RATES] for name in TUNED]
    # The first beside them shows whether they spend as much.
    cases = [Case(next(iter(EQUAL))), *(case for grid in grids for case in grid)]
    setting = {"model": model, "seed": seed, "spacing": spacing}
    rows = comparison.run(measure, cases, attempts=False, out=out, scenes=scenes, workers=workers, **setting)
    print(format_tables([comparison.climbs_table(rows)]))
    for grid in grids:
        print(f"{comparison.best(grid, rows).label}{comparison.on_edge(grid, rows)}")
    chosen = {found.name: found.rate for found in (comparison.best(grid, rows) for grid in grids)}
    print(f"--rates '{json.dumps(chosen)}'")


def compare(
    out: Path,
    rates: dict[str, float] | None = None,
    scenes: int = 200,
    spacing: float | None = None,
    model: str = DEFAULT_MODEL,
    seed: int = REPORTED_SEED,
    workers: int | None = None,
) -> None:
    """Compares the schedules, and carries their grasps out.

    Args:
        out: JSON lines, one a scene and case.
        rates: learning rates in place of the schedules' own.
        scenes: how many.
        spacing: of the points at which the density is asked, metres; each schedule's own way if not given.
        model: folder or shipped name of a grasp value.
        seed: of the scenes.
        workers: processes; one a core if not given.
    """
    rates = rates or {}
    for name in rates:
        if name not in EQUAL:
            raise unknown_name("schedule", name, EQUAL)
    cases = [Case(name, rates.get(name)) for name in EQUAL]
    setting = {"model": model, "seed": seed, "spacing": spacing}
    comparison.print_comparison(
        comparison.run(measure, cases, attempts=True, out=out, scenes=scenes, workers=workers, **setting)
    )


def full(
    out: Path,
    scenes: int = 50,
    model: str = DEFAULT_MODEL,
    seed: int = REPORTED_SEED,
    workers: int | None = None,
) -> None:
    """Compares the full search with the default one, and carries their grasps out.

    Args:
        out: JSON lines, one a scene and search.
        scenes: how many.
        model: folder or shipped name of a grasp value.
        seed: of the scenes.
        workers: processes; one a core if not given.
    """
    setting = {"model": model, "seed": seed, "spacing": None}
    cases = [Case(name) for name in FULL]
    comparison.print_comparison(
        comparison.run(measure, cases, attempts=True, out=out, scenes=scenes, workers=workers, **setting)
    )


def measure(
    scene: int, cases: Sequence[Case], *, model: str, seed: int, attempts: bool, spacing: float | None
) -> list[Row]:
    """Returns the rows of one scene: all searches draw from the same random stream, that of `nerfgrasp evaluate`."""
    seen = comparison.look(model, seed, scene)
    rows = []
    for case in cases:
        strategy = case.strategy if spacing is None else replace(case.strategy, spacing=spacing)
        strategy = strategy if attempts else replace(strategy, feasibility=None)
        with comparison.counting(seen.psi.model) as spent:
            generator = proposal_generator(seed, scene, 0)
            grasps, trace = seen.psi.search(seen.scene, generator=generator, strategy=strategy)
        row = {**comparison.climb_measures(trace), "evaluations": spent.evaluations}
        rows.append(row | (comparison.attempt_measures(seen.truth, grasps) if attempts else {}))
    return rows


if __name__ == "__main__":
    auto_cli([tune, compare, full], as_positional=False)
