"""How fast the simulation of the task `simple` is, and where its time goes.

    python benchmarks/simulation.py

carries a valid grasp out in each of 20 scenes, renders 20 views of each at 128x128, and generates them as a packed set,
without and with demonstrations: by one process, then by two. Rates are a second and a core, by the wall's clock, which
slows down where the machine does other work, and by the processes' own, which does so less. Last it lists what one
process does in the time of an attempt and of a generated scene.
"""

import tempfile
import time
from collections.abc import Callable, Sequence
from cProfile import Profile
from functools import partial
from pathlib import Path

from jsonargparse import auto_cli

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.commands.generate import write_slot
from nerfgrasp.data.packed import PackedWriter
from nerfgrasp.data.settings import SetSettings
from nerfgrasp.evaluation.tables import Format, Table, format_tables
from nerfgrasp.grippers import DEFAULT_GRIPPER
from nerfgrasp.parallel import run_all
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.sim.attempt import attempt_grasp
from nerfgrasp.sim.hand import Hand
from nerfgrasp.sim.physics import physics_hash
from nerfgrasp.sim.rendering import render_scene
from nerfgrasp.sim.sanity import perturbed_grasp
from nerfgrasp.sim.tasks import find_task, scene_cameras, simple_scene
from nerfgrasp.sim.world import World

PARTS: dict[str, tuple[Callable[..., object], ...]] = {
    "drawing the scene": (simple_scene, scene_cameras),
    "building the world, loading shapes": (World.__init__, Hand.__init__),
    "steps of the physics": (World.step,),
    "rendering": (render_scene,),
    "writing": (PackedWriter.write,),
}
"""What the time goes to; none of these calls another."""

Job = Callable[[int], None]
"""Does what is measured in the scene of that number."""


def main(
    workers: Sequence[int] = (1, 2),
    scenes: int = 20,
    views: int = 20,
    size: int = 128,
    seed: int = 103,
    format: Format = "text",
) -> None:
    """Measures attempts, images and generated scenes a second and a core.

    Args:
        workers: numbers of processes, one after another.
        scenes: how many are simulated for each figure.
        views: images of each scene.
        size: the images' side in pixels.
        seed: of the scenes.
        format: how tables are drawn.
    """
    with tempfile.TemporaryDirectory() as folder:
        settings = SetSettings("simple", seed, scenes, views, size, False, "", "packed", "")
        demonstrated = SetSettings("simple", seed, scenes, views, size, True, physics_hash(), "packed", "")
        attempts = partial(attempt, seed)
        generated = partial(write_slot, writer(Path(folder, "set"), settings), find_task("simple"), DEFAULT_GRIPPER)
        with_grasps = partial(
            write_slot, writer(Path(folder, "grasps"), demonstrated), find_task("simple"), DEFAULT_GRIPPER
        )
        jobs: dict[str, tuple[Job, int]] = {
            "grasp attempts": (attempts, 1),
            f"{size}x{size} images": (partial(render, seed, views, size), views),
            f"scenes of {views} views": (generated, 1),
            "the same with demonstrations": (with_grasps, 1),
        }
        tables = [rates_table(jobs, scenes, workers), parts_table("An attempt", attempts, scenes)]
        tables.append(parts_table("A generated scene with a demonstration", with_grasps, scenes))
    print(format_tables(tables, format), end="")


def attempt(seed: int, index: int) -> None:
    """Draws a scene and carries a valid grasp out, which takes the longest: hardly any ends early."""
    truth = simple_scene(seed, index)
    attempt_grasp(truth, perturbed_grasp(truth, 0.0))


def render(seed: int, views: int, size: int, index: int) -> None:
    """Draws a scene and renders it."""
    render_scene(simple_scene(seed, index), scene_cameras(seed, index, views, size))


def writer(folder: Path, settings: SetSettings) -> PackedWriter:
    """Returns what writes the scenes of a new set."""
    new = PackedWriter(folder, settings)
    new.prepare(Workspace())
    return new


def rates_table(jobs: dict[str, tuple[Job, int]], scenes: int, workers: Sequence[int]) -> Table:
    """Returns how often each job is done a second and a core, by the wall's clock and the processes' own."""
    rows = []
    for name, (job, pieces) in jobs.items():
        cells: list[str] = []
        for count in workers:
            wall, own = seconds(job, name, scenes, count)
            cells += [f"{pieces * scenes / (wall * count):.1f}", f"{pieces * scenes / own:.1f}"]
        rows.append((name, *cells))
    clocks = [f"{count} worker{'s' * (count > 1)}, {clock}" for count in workers for clock in ("wall", "own")]
    return Table("Rates, a second and a core", ("", *clocks), tuple(rows))


def seconds(job: Job, name: str, scenes: int, workers: int) -> tuple[float, float]:
    """Returns how long a job takes in all scenes: by the wall's clock, and by all processes' own."""
    spent: list[float] = []

    def run(count: int) -> None:
        todo = list(range(count))
        run_all(
            partial(own_seconds, job), lambda: todo, count,
            workers=workers, describe=name, unit="scene", keep=spent.append,
        )  # fmt: skip

    run(2 * workers)  # starts the processes
    spent.clear()
    start = time.perf_counter()
    run(scenes)
    return time.perf_counter() - start, sum(spent)


def own_seconds(job: Job, index: int) -> float:
    """Returns the time that the processor spends on one piece."""
    start = time.process_time()
    job(index)
    return time.process_time() - start


def parts_table(title: str, job: Job, scenes: int) -> Table:
    """Returns what a job's time goes to in one process, by the process's own clock."""
    profile = Profile(time.process_time)
    start = time.process_time()
    profile.enable()
    for index in range(scenes):
        job(index)
    profile.disable()
    total = time.process_time() - start
    within = {entry.code: entry.totaltime for entry in profile.getstats()}
    parts = {name: sum(within.get(each.__code__, 0.0) for each in functions) for name, functions in PARTS.items()}
    parts["all else"] = total - sum(parts.values())
    rows = [(name, f"{1000 * part / scenes:.1f}", f"{100 * part / total:.0f}") for name, part in parts.items() if part]
    rows.append(("in all", f"{1000 * total / scenes:.1f}", "100"))
    return Table(title, ("", "ms", "%"), tuple(rows), ("Profiled, which slows Python's own part down.",))


if __name__ == "__main__":
    keep_freed_memory()  # as the processes of `run_all` do
    auto_cli(main)
