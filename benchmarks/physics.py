"""Whether the physics can be trusted: do outcomes depend on its time step, and does the oracle lift its objects?

    python benchmarks/physics.py

carries 300 grasps out at the project's time step and at half of it. They are valid grasps of simple scenes, with
random errors so large that 30 to 70 % of them succeed. It also counts the outcomes of the same grasps without
errors and, with `--forces`, of those with errors where the approach is stopped by other forces than the project's.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from joblib import Parallel, cpu_count, delayed
from jsonargparse import auto_cli
from tqdm import tqdm

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.evaluation.statistics import wilson_interval
from nerfgrasp.sim.attempt import Outcome, attempt_grasp
from nerfgrasp.sim.physics import PHYSICS, Physics
from nerfgrasp.sim.sanity import perturbed_grasp
from nerfgrasp.sim.tasks import simple_scene

SCALES = (0.5, 0.75, 1.0, 1.5, 2.0)
"""Of the errors; the first at which at most 60 % of the probes succeed is taken."""
PROBES = 40


def main(
    grasps: int = 300,
    seed: int = 102,
    scale: float | None = None,
    forces: Sequence[float] = (),
    workers: int | None = None,
) -> None:
    """Measures how far the outcomes of grasps depend on the physics' constants.

    Args:
        grasps: how many, each in a scene of its own.
        seed: of the scenes.
        scale: of the grasps' errors; found if not given.
        forces: newtons at which the approach is stopped, tried on the grasps with errors.
        workers: processes; one a core if not given.
    """
    run = partial(outcomes, seed, workers=workers or cpu_count())
    if scale is None:
        scale = next(s for s in SCALES if successes(run(PROBES, s, PHYSICS)) <= 0.6 * PROBES)
    report("valid grasps", run(grasps, 0.0, PHYSICS))
    whole = run(grasps, scale, PHYSICS)
    half = run(grasps, scale, replace(PHYSICS, time_step=PHYSICS.time_step / 2))
    report(f"with errors (scale {scale})", whole)
    report("with errors, half the time step", half)
    changed = Counter((a, b) for a, b in zip(whole, half, strict=True) if a != b)
    print(f"  shift {100 * (successes(half) - successes(whole)) / grasps:+.1f} points; changed outcomes:")
    print("\n".join(f"    {count} from {a} to {b}" for (a, b), count in changed.most_common()))
    for force in forces:
        report(f"with errors, stopped at {force:g} N", run(grasps, scale, replace(PHYSICS, approach_force=force)))


def outcomes(seed: int, grasps: int, scale: float, physics: Physics, *, workers: int) -> list[Outcome]:
    """Returns the outcome of one grasp in each of the first `grasps` scenes."""
    jobs = (delayed(outcome)(seed, index, scale, physics) for index in range(grasps))
    results = Parallel(n_jobs=workers, return_as="generator")(jobs)
    return list(tqdm(results, total=grasps, desc="attempts", leave=False))


def outcome(seed: int, index: int, scale: float, physics: Physics) -> Outcome:
    """Returns the outcome of one grasp with an error of size `scale`."""
    truth = simple_scene(seed, index)
    return attempt_grasp(truth, perturbed_grasp(truth, scale), physics=physics).outcome


def successes(found: Sequence[Outcome]) -> int:
    """Returns how many grasps succeeded."""
    return sum(each == Outcome.SUCCESS for each in found)


def report(what: str, found: Sequence[Outcome]) -> None:
    """Prints the success rate and how often each outcome occurred."""
    low, high = wilson_interval(successes(found), len(found))
    counts = ", ".join(f"{name} {count}" for name, count in Counter(found).most_common())
    print(f"{what}: {successes(found)}/{len(found)}, 95 % interval {100 * low:.1f} to {100 * high:.1f} % ({counts})")


if __name__ == "__main__":
    keep_freed_memory()
    auto_cli(main)
