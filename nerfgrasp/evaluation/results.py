"""Results as JSON lines, one an attempt: everything needed to repeat it, and nothing that varies between repeats.

A file whose name ends in `.gz` is compressed, which makes it a sixth as large.
"""

import gzip
import json
import os
import zlib
from collections.abc import Callable, Iterable
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from nerfgrasp.errors import UserError
from nerfgrasp.files import replacing

FORMAT_VERSION = 1
_OPTIONAL = ("search", "options", "gripper")
"""Fields that a line leaves out where they are None."""
_OLD_OPTIONS = {"schedule": "strategy", "device": "device", "pose": "pose"}
"""Options that older lines hold as fields of their own, with their names today."""
COMPRESSED = ".gz"
Line = TypeVar("Line", "Row", "Times")


@dataclass(frozen=True)
class Row:
    """One attempt of a method in a scene."""

    set: str
    """The scene set's name: task and seed, with the objects' catalogue between if the task has one."""
    task: str
    """E.g. `clutter`."""
    seed: int
    """The set's seed."""
    scene: int
    """The scene's number in the set."""
    attempt: int
    """The attempt's number in the scene, from 0."""
    method: str
    """The registered name."""
    model: str | None
    """16 hexadecimal digits of the weights' SHA-256; None for a method without weights."""
    scene_sha256: str
    """16 hexadecimal digits of the SHA-256 of the objects before the attempt and the cameras that looked at them."""
    physics: str
    """Hash of every constant of the physics and of the gripper."""
    objects: tuple[str, ...]
    """What is on the table before the attempt: kinds of prisms, names of meshes."""
    grasp: dict[str, list[float]] | None
    """`position` [3] in metres and `quaternion` [4], xyzw, in the world; None if the method proposed nothing."""
    value: float | None
    """What the method thinks of it: a logit, comparable within one scene only."""
    outcome: str
    """How the attempt ended."""
    object: int | None
    """The number in `objects` of what both fingers held once closed."""
    lifted_mm: float
    """By which that object's centre of mass was above its place of rest at the end."""
    dropped: tuple[int, ...]
    """The numbers in `objects` of what lay outside of the workspace at the end."""
    errors: dict[str, float] | None
    """`distance_mm` and `angle_deg` to the nearest valid grasp; None where the valid grasps are not known."""
    versions: dict[str, str]
    """Of `nerfgrasp`, `torch` and `pybullet`."""
    search: str | None = None
    """Name and hash of the method's search strategy, e.g. `guided-0123456789abcdef`; None for a method without one, and
    in files that are older than the hash."""
    gripper: str | None = None
    """The name of the hand that carried the grasp out; None for the default one."""
    options: dict[str, Any] | None = None
    """The method's options that were given, e.g. `{"strategy": "paper"}`; None if none were."""


@dataclass(frozen=True)
class Times:
    """How long one attempt took; beside the results, since it varies."""

    scene: int
    """The scene's number in the set."""
    attempt: int
    """The attempt's number in the scene."""
    render_s: float
    """Seconds for the pictures."""
    propose_s: float
    """Seconds for the method to propose a grasp."""
    attempt_s: float
    """Seconds for carrying it out in physics."""


def times_path(results: Path) -> Path:
    """Returns where the wall times of a results file lie.

    Example:
        >>> times_path(Path("runs/results.jsonl")).name
        'results.times.jsonl'
    """
    suffix = "".join(results.suffixes[-2:]) if results.suffix == COMPRESSED else results.suffix
    return results.with_name(f"{results.name.removesuffix(suffix)}.times{suffix}")


def write_results(path: Path, rows: Iterable[Row]) -> None:
    """Writes results, all or nothing; a file that cannot be written is a UserError."""
    _write_lines(path, (row_to_json(row) for row in rows))


def write_times(path: Path, times: Iterable[Times]) -> None:
    """Writes wall times, all or nothing; a file that cannot be written is a UserError."""
    _write_lines(path, (asdict(one) for one in times))


def read_results(path: Path) -> list[Row]:
    """Reads a results file.

    Raises:
        UserError: there is none, it is empty, or a line of it is damaged, of another format or there twice; the
            message names the line.
    """
    rows = _read_lines(path, row_from_json)
    if not rows:
        raise UserError(f"{path} holds no results")
    return rows


def read_times(path: Path) -> list[Times]:
    """Reads wall times; errors as for `read_results`, but the file may be empty."""
    return _read_lines(path, times_from_json)


def row_to_json(row: Row) -> dict[str, Any]:
    """Returns one line of results as JSON data."""
    data = {"format": FORMAT_VERSION, **asdict(row)}
    return {key: value for key, value in data.items() if key not in _OPTIONAL or value is not None}


def row_from_json(data: Any) -> Row:
    """Reads one line of results; one that is damaged or of another format is a ValueError that says how."""
    if not isinstance(data, dict):
        raise ValueError("it is not a JSON object")
    if data.get("format") != FORMAT_VERSION:
        raise ValueError(f"format {data.get('format')!r}, this program reads {FORMAT_VERSION}")
    fields = {key: value for key, value in data.items() if key != "format"}
    options = {name: fields.pop(key) for key, name in _OLD_OPTIONS.items() if key in fields}
    return _from_json(Row, fields | ({"options": options} if options else {}))


def times_from_json(data: Any) -> Times:
    """Reads one line of wall times; one that is damaged is a ValueError that says how."""
    return _from_json(Times, data)


def _write_lines(path: Path, lines: Iterable[dict[str, Any]]) -> None:
    data = "".join(json.dumps(line, allow_nan=False) + "\n" for line in lines).encode()
    if path.suffix == COMPRESSED:
        # Without the time of day in it: the same results are the same bytes.
        data = gzip.compress(data, mtime=0)
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _read_lines(path: Path, parse: Callable[[Any], Line]) -> list[Line]:
    try:
        data = path.read_bytes()
        text = (gzip.decompress(data) if path.suffix == COMPRESSED else data).decode()
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file") from error
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise UserError(f"cannot read {path}: {error}") from error
    lines: dict[tuple[int, int], Line] = {}
    for number, text_line in enumerate(text.splitlines(), start=1):
        try:
            line = parse(json.loads(text_line, parse_constant=_no_number))
        except (ValueError, RecursionError) as error:
            raise UserError(f"{path}, line {number}: {error}") from error
        if (line.scene, line.attempt) in lines:
            raise UserError(f"{path}, line {number}: attempt {line.attempt} of scene {line.scene} is there twice")
        lines[line.scene, line.attempt] = line
    return list(lines.values())


def _no_number(constant: str) -> float:
    raise ValueError(f"{constant} is no number")


def _from_json(kind: type[Line], data: Any) -> Line:
    if not isinstance(data, dict):
        raise ValueError("it is not a JSON object")
    types = {field.name: field.type for field in fields(kind)}
    optional = {field.name for field in fields(kind) if field.default is not MISSING}
    if odd := (data.keys() ^ types.keys()) - optional:
        raise ValueError(f"{sorted(odd)[0]!r} is missing or unknown")
    return kind(**{name: _typed(name, types[name], value) for name, value in data.items()})


_CHECKS: dict[Any, Callable[[Any], bool]] = {
    str: lambda v: isinstance(v, str),
    int: lambda v: type(v) is int,
    float: lambda v: type(v) in (int, float),
    str | None: lambda v: v is None or isinstance(v, str),
    int | None: lambda v: v is None or type(v) is int,
    float | None: lambda v: v is None or type(v) in (int, float),
    tuple[str, ...]: lambda v: isinstance(v, list) and all(isinstance(one, str) for one in v),
    tuple[int, ...]: lambda v: isinstance(v, list) and all(type(one) is int for one in v),
    dict[str, Any] | None: lambda v: v is None or isinstance(v, dict),
    dict[str, str]: lambda v: isinstance(v, dict) and all(isinstance(one, str) for one in v.values()),
    dict[str, float] | None: lambda v: v is None or _has_numbers(v, {"distance_mm", "angle_deg"}),
    dict[str, list[float]] | None: lambda v: v is None or _is_pose(v),
}
"""Whether JSON data fits a field of that type."""


def _typed(name: str, hint: Any, value: Any) -> Any:
    if not _CHECKS[hint](value):
        raise ValueError(f"{name!r} is {value!r}")
    return tuple(value) if isinstance(value, list) else value


def _has_numbers(value: Any, keys: set[str]) -> bool:
    return isinstance(value, dict) and value.keys() == keys and all(type(v) in (int, float) for v in value.values())


def _is_pose(value: Any) -> bool:
    lengths = {"position": 3, "quaternion": 4}
    return (
        isinstance(value, dict)
        and value.keys() == lengths.keys()
        and all(isinstance(value[key], list) and len(value[key]) == length for key, length in lengths.items())
        and all(type(number) in (int, float) for part in value.values() for number in part)
    )
