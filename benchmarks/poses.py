r"""Which pose parameterization finds the best grasps, from the same starts and in as many steps.

    python benchmarks/poses.py tune --out poses-tuning.jsonl
    python benchmarks/poses.py compare --rates '{quaternion: [0.01, 0.05], screw: [0.01]}' --out poses.jsonl

In each simple scene the same 16 different candidates, the best of 512 drawn by the model's density, climb for 32 steps
within the same limits. Two rates, of position and of orientation, decouple them as the paper does: 16 steps of the one,
then 16 of the other. One rate moves all parameters at once, as whole transforms must; `quaternion-joint` does so where
it need not. `tune` finds each case's rates by the mean over scenes of the best final value: for each of them five are
tried, but the rate of positions, which is found for quaternions, and shared. `compare` takes what `tune` prints, and
carries the grasp out that is best by Ψ and feasibility together.

A killed run goes on where the same command is given again; a finished one prints its tables again.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import comparison
import torch
from comparison import REPORTED_SEED, Row, Seen
from jsonargparse import auto_cli
from search import TUNING_SEED
from torch import Tensor

from nerfgrasp import registry
from nerfgrasp.evaluation.tables import format_tables
from nerfgrasp.evaluation.trials import proposal_generator
from nerfgrasp.models.folder import DEFAULT_MODEL
from nerfgrasp.search import PAPER, Phase, Schedule, ascend, best_first, distinct
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.occupancy import occupancy, occupied_candidates
from nerfgrasp.search.parameterization import load_pose
from nerfgrasp.search.strategies import GUIDED

CANDIDATES, CLIMBERS = 512, 16
LIMITS = Limits()
JOINT = "-joint"
"""What the name of a decoupled parameterization ends in where all its parameters move at once."""
JOINT_DECAY = 0.93
"""Of the rate, at each step, where all parameters move at once."""
DECOUPLED = ("quaternion", "rotvec", "axis_angle", "matrix", "sixd")
AT_ONCE = (f"quaternion{JOINT}", "transform", "screw")
POSITION_RATES = (0.0025, 0.005, 0.01, 0.02, 0.05)
ORIENTATION_RATES = (0.0125, 0.025, 0.05, 0.1, 0.2)
"""In each parameterization's own unit; the third is the paper's."""
JOINT_RATES = (0.0025, 0.005, 0.01, 0.02, 0.04)


@dataclass(frozen=True)
class Case:
    """A parameterization and how it climbs."""

    name: str
    """As registered, perhaps with `JOINT` behind."""
    rates: tuple[float, ...]
    """Of position and of orientation; or one, of all parameters."""

    @property
    def label(self) -> str:
        """What rows and tables call it."""
        return f"{self.name} {'/'.join(f'{rate:g}' for rate in self.rates)}"

    @property
    def pose(self) -> str:
        """The registered name."""
        return self.name.removesuffix(JOINT)

    @property
    def schedule(self) -> Schedule:
        """The steps: as many, whichever parameters they move."""
        if len(self.rates) == 1:
            return Schedule((Phase(("position", "orientation"), PAPER.steps, self.rates[0], JOINT_DECAY),))
        phases = zip(PAPER.phases, self.rates, strict=True)
        return Schedule(tuple(replace(phase, learning_rate=rate) for phase, rate in phases))


def tune(
    out: Path,
    scenes: int = 16,
    candidates: int = CANDIDATES,
    model: str = DEFAULT_MODEL,
    seed: int = TUNING_SEED,
    workers: int | None = None,
) -> None:
    """Finds each case's learning rates, and prints them as `compare` takes them.

    Args:
        out: JSON lines, one a scene and case.
        scenes: how many.
        candidates: that are drawn in each.
        model: folder or shipped name of a grasp value.
        seed: of the scenes; not the reported one.
        workers: processes; one a core if not given.
    """
    setting = {"model": model, "seed": seed, "candidates": candidates}
    run = partial(comparison.run, measure, attempts=False, out=out, scenes=scenes, workers=workers, **setting)
    middle = ORIENTATION_RATES[len(ORIENTATION_RATES) // 2]
    positions = [Case("quaternion", (rate, middle)) for rate in POSITION_RATES]
    rows = run(positions)
    print(f"positions: {comparison.best(positions, rows).label}{comparison.on_edge(positions, rows)}")
    position = comparison.best(positions, rows).rates[0]
    grids = [[Case(name, (position, rate)) for rate in ORIENTATION_RATES] for name in registered(DECOUPLED)]
    grids += [[Case(name, (rate,)) for rate in JOINT_RATES] for name in registered(AT_ONCE)]
    # Once each: the quaternion's middle rate of orientations stands in two grids.
    rows = run(list(dict.fromkeys([*positions, *(case for grid in grids for case in grid)])))
    print(format_tables([comparison.climbs_table(rows)]))
    for grid in grids:
        print(f"{comparison.best(grid, rows).label}{comparison.on_edge(grid, rows)}")
    chosen = {found.name: found.rates for found in (comparison.best(grid, rows) for grid in grids)}
    print(f"--rates '{json.dumps(chosen)}'")


def compare(
    rates: dict[str, tuple[float, ...]],
    out: Path,
    scenes: int = 200,
    candidates: int = CANDIDATES,
    model: str = DEFAULT_MODEL,
    seed: int = REPORTED_SEED,
    workers: int | None = None,
) -> None:
    """Compares cases, and carries their grasps out.

    Args:
        rates: of each case, the first of which the others are held against; see above.
        out: JSON lines, one a scene and case.
        scenes: how many.
        candidates: that are drawn in each.
        model: folder or shipped name of a grasp value.
        seed: of the scenes.
        workers: processes; one a core if not given.
    """
    cases = [Case(name, tuple(rates[name])) for name in registered(tuple(rates))]
    setting = {"model": model, "seed": seed, "candidates": candidates}
    comparison.print_comparison(
        comparison.run(measure, cases, attempts=True, out=out, scenes=scenes, workers=workers, **setting)
    )


def registered(names: Sequence[str]) -> list[str]:
    """Returns those cases whose parameterization is installed, and tells of the others."""
    found = registry.names(registry.POSES)
    for name in names:
        if name.removesuffix(JOINT) not in found:
            print(f"{name}: no such parameterization is installed, skipped")
    return [name for name in names if name.removesuffix(JOINT) in found]


def measure(scene: int, cases: Sequence[Case], *, model: str, seed: int, attempts: bool, candidates: int) -> list[Row]:
    """Returns the rows of one scene: all cases climb from the same starts."""
    seen = comparison.look(model, seed, scene)
    start = starts(seen, candidates)
    return [climb(seen, start, case, attempts) for case in cases]


def starts(seen: Seen, candidates: int) -> Tensor:
    """Returns `T_world_grasp` `[16, 4, 4]`, or fewer: the best different ones of what is drawn."""
    model, features, box = seen.psi.model, seen.scene.features, seen.scene.workspace
    generator = proposal_generator(seen.truth.seed, seen.truth.index, 0)
    occupied = occupancy(model, features, box, GUIDED.spacing)
    drawn = occupied_candidates(candidates, box, generator, LIMITS.max_tilt, occupied=occupied)
    poses = LIMITS.enforce(drawn, box)
    with torch.no_grad():
        values = torch.cat([model.value(features, part) for part in poses.split(seen.psi.chunk)])
    return distinct(best_first(poses, values), count=CLIMBERS).T_world_grasp


def climb(seen: Seen, start: Tensor, case: Case, attempts: bool) -> Row:
    """Lets the starts climb; with `attempts`, the best by Ψ and feasibility is carried out."""
    model, features, box = seen.psi.model, seen.scene.features, seen.scene.workspace
    with comparison.counting(model) as spent:
        grasps, trace = ascend(
            lambda T: model.value(features, T),
            start,
            load_pose(case.pose, box),
            box,
            case.schedule,
            limits=LIMITS,
            chunk=seen.psi.chunk,
        )
    row = {**comparison.climb_measures(trace), "evaluations": spent.evaluations}
    if not attempts:
        return row
    how = seen.psi.resolve(GUIDED).feasibility
    weighed = grasps if how is None else seen.psi.weigh(grasps, seen.scene, how)
    return row | comparison.attempt_measures(seen.truth, weighed)


if __name__ == "__main__":
    auto_cli([tune, compare], as_positional=False)
