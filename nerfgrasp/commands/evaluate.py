"""`nerfgrasp evaluate`: tries a method in the scenes of a task."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path

from nerfgrasp.commands.ranges import check_ranges
from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.methods import find_method, load_method, method_hash, method_search
from nerfgrasp.evaluation.parts import Parts
from nerfgrasp.evaluation.results import Row, Times, read_results
from nerfgrasp.evaluation.trials import Trials, first_scene_hash, run_scene
from nerfgrasp.parallel import Cluster, run_all
from nerfgrasp.scenes.images import IMAGE_SIZE
from nerfgrasp.search.devices import find_device
from nerfgrasp.sim.attempt import Outcome
from nerfgrasp.sim.catalogue import open_catalogue
from nerfgrasp.sim.tasks import find_task


def evaluate(
    *,
    task: str,
    method: str,
    scenes: int,
    seed: int,
    out: Path,
    schedule: str | None = None,
    pose: str | None = None,
    workers: int | None = None,
    cluster: Cluster | None = None,
    device: str | None = None,
    objects: Path | None = None,
    size: int = IMAGE_SIZE,
) -> None:
    """Tries a grasping method in simulated scenes and writes one JSON line an attempt.

    Results are a function of what is asked for: the number of workers does not change a byte of them. A run that was
    stopped or killed continues where the same command is given again; until the end, finished scenes lie in
    OUT.parts. Wall times are written beside the results, as OUT with `.times` in its name.

    Args:
        task: what the scenes are: `simple`, `clutter` or `novel`.
        method: a registered method (`nerfgrasp plugins list`), or a model's folder or shipped name.
        scenes: how many scenes.
        seed: a set's scenes are the first of an endless sequence that the seed names; take one that was not trained on.
        out: the results file, e.g. `results.jsonl`; compressed if its name ends in `.gz`.
        schedule: how a method with search schedules is to search, e.g. `paper`; its own way if not given.
        pose: the registered name of the pose parameterization that a method which climbs is to climb in; its own if not
            given.
        workers: number of processes; one a core if not given, and one alone on a device other than `cpu`.
        cluster: `ray` tries on a Ray cluster, whose machines all see the model and the objects.
        device: where a method that takes a device computes: `cpu`, `cuda`, `mps` or e.g. `cuda:1`; its own choice,
            which is `cpu` for Ψ, if not given.
        objects: for `novel`: a folder of URDFs or meshes; the one that NERFGRASP_OBJECTS names if not given, or else
            the objects that come with pybullet.
        size: width and height of a picture in pixels.

    Raises:
        UserError: a value is out of range, something asked for is not there, or `out` holds other results or cannot
            be written.
    """
    check_ranges(scenes=scenes, seed=seed, workers=workers, size=size)
    if device is not None and find_device(device).type != "cpu":
        workers = workers or 1
    found = find_task(task, objects)
    name, folder = find_method(method)
    out = Path(out)
    if out.is_dir():
        raise UserError(f"cannot write {out}: it is a folder")
    asked = {"schedule": schedule, "device": device, "pose": pose}
    loaded = load_method(name, folder, **asked)
    catalogue = open_catalogue(objects).sha256 if found.catalogue else None
    hashes = {"model": method_hash(loaded), "catalogue": catalogue, "search": method_search(loaded)}
    trials = Trials(found, seed, name, folder, size=size, **asked, **hashes)
    if out.exists():
        tally = Tally(_finished(trials, out, scenes))
        print(f"{out} is already complete: {scenes} scenes")
    else:
        tally = Tally(_run(trials, out, scenes, workers, cluster))
        print(f"wrote {out}")
    print(f"{name} in {scenes} scenes of {trials.set}: {tally}")


class Tally:
    """Successes and attempts so far, as the progress bar shows them."""

    def __init__(self, rows: Iterable[Row] = ()) -> None:
        self.successes, self.attempts = 0, 0
        self.add(rows)

    def add(self, rows: Iterable[Row]) -> None:
        """Counts more attempts."""
        for row in rows:
            self.attempts += 1
            self.successes += row.outcome == Outcome.SUCCESS

    def __str__(self) -> str:
        rate = 100 * self.successes / max(self.attempts, 1)
        return f"{self.successes} of {self.attempts} attempts succeeded ({rate:.1f} %)"


def _run(trials: Trials, out: Path, scenes: int, workers: int | None, cluster: Cluster | None) -> list[Row]:
    parts, tally = Parts(out, trials.settings()), Tally()
    parts.claim(scenes)
    for scene in set(range(scenes)) - set(parts.missing(scenes)):
        tally.add(parts.read(scene)[0])

    def keep(result: tuple[int, list[tuple[Row, Times]]]) -> None:
        parts.write(*result)
        tally.add(row for row, _ in result[1])

    run_all(
        partial(_numbered, trials),
        partial(parts.missing, scenes),
        scenes,
        workers=workers,
        cluster=cluster,
        describe="evaluate",
        unit="scene",
        keep=keep,
        status=lambda _: str(tally),
    )
    return parts.publish(scenes)


def _numbered(trials: Trials, scene: int) -> tuple[int, list[tuple[Row, Times]]]:
    return scene, run_scene(trials, scene)


def _finished(trials: Trials, out: Path, scenes: int) -> list[Row]:
    """Returns the rows of a results file that is there, if it is the one asked for."""
    rows, settings = read_results(out), trials.settings()
    first = rows[0]
    pairs = {
        key: (getattr(first, key), settings[key])
        for key in ("set", "method", "model", "schedule", "search", "device", "pose", "physics", "versions")
    }
    pairs["scenes"] = (len({row.scene for row in rows}), scenes)
    pairs["scene_sha256"] = (first.scene_sha256, first_scene_hash(trials))
    for key, (there, asked) in pairs.items():
        if there != asked:
            raise UserError(f"{out} holds other results: {key} {there!r}, asked for {asked!r}; give a new file")
    Parts(out, settings).discard()
    return rows
