"""Results files as runs of methods that may be compared: of one physics, and on the same scenes."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import Any

from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.results import Row, Times, read_results, read_times, times_path

SUCCESS = "success"
"""The outcome that counts, as `nerfgrasp.sim.attempt.Outcome` names it; that would bring a simulator along."""
CONSTANT = ("set", "task", "seed", "method", "model", "search", "gripper", "options", "physics", "versions")
"""What all lines of one file share."""


@dataclass(frozen=True)
class Run:
    """A method's attempts in one set of scenes: one results file."""

    path: Path
    """The file."""
    rows: tuple[Row, ...]
    """Its lines; never none."""
    times: tuple[Times, ...]
    """How long they took; empty where that is not kept."""
    label: str
    """The name given, or the method, with its model's hash where several models of one method are compared, and the
    options given."""

    @property
    def name(self) -> str:
        """The label, less the number of a repeated training: `MV3` of `MV3#1`."""
        return self.label.partition("#")[0]

    @property
    def repeated(self) -> bool:
        """Whether it is of a repeated training."""
        return "#" in self.label

    @property
    def task(self) -> str:
        """The task."""
        return self.rows[0].task

    @cached_property
    def scenes(self) -> dict[int, list[Row]]:
        """The attempts of every scene, by its number, in order."""
        scenes: dict[int, list[Row]] = {}
        for row in sorted(self.rows, key=lambda row: (row.scene, row.attempt)):
            scenes.setdefault(row.scene, []).append(row)
        return scenes


def load_runs(paths: Sequence[Path], names: Mapping[Path, str] = MappingProxyType({})) -> list[Run]:
    """Reads results files, with the wall times beside them where there are any, in the order given.

    A file of wall times that is named along with its results, as by `*.jsonl`, is no run.

    Args:
        paths: the files.
        names: what their runs are to be called; `MV3#1` for another training of what is called `MV3`.

    Raises:
        UserError: a file is damaged, mixes runs or lacks an attempt; or two files are of the same method and task,
            of different physics, or of different scenes; or a name stands for two. The message names what differs, and
            where.
    """
    twice, count = Counter(paths).most_common(1)[0]
    if count > 1:
        raise UserError(f"{twice} is given twice")
    wall_times = {times_path(path) for path in paths}
    files = {path: read_results(path) for path in paths if path not in wall_times}
    for path, rows in files.items():
        _check_file(path, rows)
    models = {(rows[0].method, rows[0].model) for rows in files.values()}
    several = {method for method, count in Counter(method for method, _ in models).items() if count > 1}
    runs = []
    for path, rows in files.items():
        first, beside = rows[0], times_path(path)
        hashed = [(first.model or "no model")[:8]] if first.method in several else []
        options = [value if isinstance(value, str) else f"{name}={value}" for name, value in _told_options(first)]
        method = " ".join([first.method, *hashed, *options])
        label = names.get(path, method)
        runs.append(Run(path, tuple(rows), tuple(read_times(beside)) if beside.exists() else (), label))
    for one, other in combinations(runs, 2):
        _check_pair(one, other)
        _check_names(one, other)
    return runs


def common_scenes(one: Run, other: Run) -> list[int]:
    """Returns the numbers of the scenes in which both were tried."""
    return sorted(one.scenes.keys() & other.scenes.keys())


def _check_file(path: Path, rows: Sequence[Row]) -> None:
    expected = {name: getattr(rows[0], name) for name in CONSTANT}
    attempts: dict[int, list[int]] = {}
    for number, row in enumerate(rows, start=1):
        for name, value in expected.items():
            if getattr(row, name) != value:
                raise UserError(f"{path}, line {number}: {name} {getattr(row, name)!r}, but line 1 has {value!r}")
        attempts.setdefault(row.scene, []).append(row.attempt)
    for scene, numbers in attempts.items():
        missing = set(range(max(numbers))).difference(numbers)
        if missing:
            raise UserError(f"{path}: scene {scene} has an attempt {max(numbers)} but no attempt {min(missing)}")


def _check_pair(one: Run, other: Run) -> None:
    a, b = one.rows[0], other.rows[0]
    if a.physics != b.physics:
        raise UserError(f"{other.path} is of physics {b.physics}, {one.path} of {a.physics}: they do not compare")
    if a.task != b.task:
        return
    if _identity(a) == _identity(b):
        raise UserError(f"{one.path} and {other.path} are both of {a.method} on {a.task}: give one of them")
    if (a.set, a.seed) != (b.set, b.seed):
        raise UserError(
            f"{other.path} is of the scenes {b.set} (seed {b.seed}), {one.path} of {a.set} (seed {a.seed}): "
            "they do not compare"
        )
    for scene in common_scenes(one, other):
        mine, its = one.scenes[scene][0].scene_sha256, other.scenes[scene][0].scene_sha256
        if mine != its:
            raise UserError(
                f"scene {scene} of {a.set} is {its} in {other.path} and {mine} in {one.path}: not the same scenes"
            )


def _check_names(one: Run, other: Run) -> None:
    a, b = one.rows[0], other.rows[0]
    if one.label == other.label and _identity(a) != _identity(b):
        raise UserError(f"{one.path} and {other.path} are both called {one.label}: a name stands for one method")


def _identity(row: Row) -> tuple[object, ...]:
    """Returns the fields that distinguish a method, its model and its options from others."""
    return row.method, row.model, _told_options(row)


def _told_options(row: Row) -> list[tuple[str, Any]]:
    """Returns the options that were given, except for the device, which changes nothing but the last digits."""
    return [(name, value) for name, value in (row.options or {}).items() if name != "device"]
