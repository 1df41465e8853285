import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.results import (
    Row,
    Times,
    read_results,
    read_times,
    times_path,
    write_results,
    write_times,
)

NOTHING: dict[str, Any] = dict.fromkeys(("grasp", "value", "object", "errors"))


@pytest.fixture
def rows(attempts: Callable[..., list[Row]]) -> list[Row]:
    """A success, and in the next scene nothing proposed, by a model."""
    success, failure = attempts(["success"], ["no_grasp"], objects=("box", "cylinder"))
    return [success, replace(failure, model="0" * 16, **NOTHING)]


def test_rows_come_back_as_they_were(rows: list[Row], tmp_path: Path) -> None:
    write_results(tmp_path / "results.jsonl", rows)
    assert read_results(tmp_path / "results.jsonl") == rows
    first = json.loads((tmp_path / "results.jsonl").read_text().splitlines()[0])
    assert first["format"] == 1
    assert (first["set"], first["objects"], first["dropped"]) == ("simple-7", ["box", "cylinder"], [])


@pytest.mark.parametrize(
    ("name", "value"),
    [("search", "guided-0123456789abcdef"), ("gripper", "franka"), ("options", {"strategy": "paper", "keep": 8})],
)
def test_what_not_every_line_has_is_written_only_where_it_is_known(
    name: str, value: Any, rows: list[Row], tmp_path: Path
) -> None:
    rows[1] = replace(rows[1], **{name: value})  # type: ignore[arg-type]
    write_results(tmp_path / "results.jsonl", rows)
    assert read_results(tmp_path / "results.jsonl") == rows
    without, with_it = map(json.loads, (tmp_path / "results.jsonl").read_text().splitlines())
    assert name not in without
    assert with_it[name] == value


def test_older_lines_hold_options_as_fields_of_their_own(rows: list[Row], tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    write_results(path, rows[:1])
    line = {**json.loads(path.read_text()), "schedule": "paper", "device": "cpu", "pose": "screw"}
    path.write_text(json.dumps(line) + "\n")
    [row] = read_results(path)
    assert row.options == {"strategy": "paper", "device": "cpu", "pose": "screw"}


def test_times_come_back_as_they_were(tmp_path: Path) -> None:
    times = [Times(0, 0, 0.1, 0.2, 0.3), Times(0, 1, 1.0, 2.0, 3.0)]
    path = times_path(tmp_path / "results.jsonl")
    write_times(path, times)
    assert read_times(path) == times


def test_compressed_results_come_back_as_they_were_and_are_the_same_bytes(rows: list[Row], tmp_path: Path) -> None:
    path, again = tmp_path / "some.results.jsonl.gz", tmp_path / "again.jsonl.gz"
    write_results(path, rows)
    write_results(again, rows)
    assert read_results(path) == rows
    assert path.read_bytes() == again.read_bytes()
    assert times_path(path).name == "some.results.times.jsonl.gz"


@pytest.mark.parametrize("keep", [0, 40, -4])
def test_damaged_compressed_results_are_told(keep: int, rows: list[Row], tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl.gz"
    write_results(path, rows)
    path.write_bytes(path.read_bytes()[:keep] or b"{}")
    with pytest.raises(UserError, match="cannot read .*results.jsonl.gz: "):
        read_results(path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("{", "Expecting property name"),
        ("[]", "it is not a JSON object"),
        ({"format": 2}, "format 2, this program reads 1"),
        ({"scene": "1"}, "'scene' is '1'"),
        ({"value": float("nan")}, "NaN is no number"),
        ({"value": True}, "'value' is True"),
        ({"extra": 1}, "'extra' is missing or unknown"),
        ({"grasp": {"position": [0, 0], "quaternion": [0, 0, 0, 1]}}, "'grasp' is"),
        ({"errors": {"distance_mm": 1.0}}, "'errors' is"),
        ({"objects": [1]}, "'objects' is"),
        ({"scene": 0}, "attempt 0 of scene 0 is there twice"),
    ],
)
def test_damage_is_told_with_its_line(
    damage: str | dict[str, Any], message: str, rows: list[Row], tmp_path: Path
) -> None:
    path = tmp_path / "results.jsonl"
    write_results(path, rows[:1])
    line = damage if isinstance(damage, str) else json.dumps({"format": 1, **asdict(rows[1]), **damage})
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(UserError, match=f"results.jsonl, line 2: {message}"):
        read_results(path)


def test_no_file_and_an_empty_one_are_told(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        read_results(tmp_path / "absent.jsonl")
    (tmp_path / "empty.jsonl").write_text("")
    with pytest.raises(UserError, match="holds no results"):
        read_results(tmp_path / "empty.jsonl")


def test_a_number_that_is_not_finite_is_not_written(rows: list[Row], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_results(tmp_path / "results.jsonl", [replace(rows[0], value=float("nan"))])
    assert list(tmp_path.iterdir()) == []
