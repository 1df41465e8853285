"""`nerfgrasp evaluate`: tries a method in the scenes of a task."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from nerfgrasp.commands.arguments import with_shorthands
from nerfgrasp.commands.ranges import check_ranges
from nerfgrasp.devices import find_device
from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.parts import Parts
from nerfgrasp.evaluation.results import Row, Times, read_results
from nerfgrasp.evaluation.trials import Trials, first_scene_hash, run_scene
from nerfgrasp.grippers import DEFAULT_GRIPPER, find_gripper
from nerfgrasp.methods.loading import find_method, load_method, method_hash, method_search, takes_option
from nerfgrasp.parallel import Cluster, run_all
from nerfgrasp.scenes.images import IMAGE_SIZE
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
    strategy: str | None = None,
    pose: str | None = None,
    options: dict[str, Any] | None = None,
    workers: int | None = None,
    cluster: Cluster | None = None,
    device: str | None = None,
    gripper: str | None = None,
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
        strategy: short for `--options.strategy`: the search strategy of a method that searches, e.g. `paper`.
        pose: short for `--options.pose`: the registered name of the pose parameterization that it ascends in.
        options: the method's own options, each given as `--options.NAME VALUE`: the keyword parameters of its
            `from_pretrained`. An option that is not given has the method's own default.
        workers: number of processes; one a core if not given, and one alone on a device other than `cpu`.
        cluster: `ray` tries on a Ray cluster, whose machines all see the model and the objects.
        device: short for `--options.device`: where the method computes: `cpu`, `cuda`, `mps` or e.g. `cuda:1`.
        gripper: the hand that carries grasps out, a registered gripper (`nerfgrasp plugins list`) or a YAML file
            (docs/grippers.md); also `--options.gripper` of a method that takes one. The Robotiq 2F-85 if not given.
        objects: for `novel`: a folder of URDFs or meshes; the one that NERFGRASP_OBJECTS names if not given, or else
            the objects that come with pybullet.
        size: width and height of a picture in pixels.

    Raises:
        UserError: a value is out of range, something asked for is not there, or `out` holds other results or cannot
            be written.
    """
    check_ranges(scenes=scenes, seed=seed, workers=workers, size=size)
    spec = find_method(method, **with_shorthands(options, strategy=strategy, pose=pose, device=device))
    if find_device(spec.options.get("device", "cpu")).type != "cpu":
        workers = workers or 1
    hand = DEFAULT_GRIPPER if gripper is None else find_gripper(gripper)
    if gripper is not None and takes_option(spec, "gripper"):
        spec = replace(spec, options=with_shorthands(spec.options, gripper=gripper))
    found = find_task(task, objects)
    out = Path(out)
    if out.is_dir():
        raise UserError(f"cannot write {out}: it is a folder")
    loaded = load_method(spec)
    catalogue = open_catalogue(objects).sha256 if found.catalogue else None
    hashes = {"model": method_hash(loaded), "catalogue": catalogue, "search": method_search(loaded)}
    trials = Trials(found, seed, spec, size=size, gripper=hand, **hashes)
    if out.exists():
        tally = Tally(_finished(trials, out, scenes))
        print(f"{out} is already complete: {scenes} scenes")
    else:
        tally = Tally(_run(trials, out, scenes, workers, cluster))
        print(f"wrote {out}")
    print(f"{spec.name} in {scenes} scenes of {trials.set}: {tally}")


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
    pairs: dict[str, tuple[Any, Any]] = {"options": (first.options or {}, settings["options"])}
    for key in ("set", "method", "model", "search", "physics", "versions"):
        pairs[key] = (getattr(first, key), settings[key])
    pairs["scenes"] = (len({row.scene for row in rows}), scenes)
    pairs["scene_sha256"] = (first.scene_sha256, first_scene_hash(trials))
    for key, (there, asked) in pairs.items():
        if there != asked:
            raise UserError(f"{out} holds other results: {key} {there!r}, asked for {asked!r}; give a new file")
    Parts(out, settings).discard()
    return rows
