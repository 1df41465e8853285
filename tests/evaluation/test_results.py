import json
from dataclasses import replace
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

ROW = Row(
    set="simple-100",
    task="simple",
    seed=100,
    scene=3,
    attempt=0,
    method="oracle",
    model=None,
    scene_sha256="0123456789abcdef",
    physics="fedcba9876543210",
    objects=("box", "cylinder"),
    grasp={"position": [0.1, 0.0, 0.05], "quaternion": [1.0, 0.0, 0.0, 0.0]},
    value=-0.5,
    outcome="success",
    object=1,
    lifted_mm=99.5,
    dropped=(),
    errors={"distance_mm": 0.0, "angle_deg": 1.5},
    versions={"nerfgrasp": "0.3", "torch": "2.8", "pybullet": "3.2.7"},
)
BARE = replace(ROW, scene=4, model="0" * 16, grasp=None, value=None, outcome="no_grasp", object=None, errors=None)


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    write_results(tmp_path / "results.jsonl", [ROW, BARE])
    assert read_results(tmp_path / "results.jsonl") == [ROW, BARE]
    first = json.loads((tmp_path / "results.jsonl").read_text().splitlines()[0])
    assert first["format"] == 1
    assert (first["set"], first["objects"], first["dropped"]) == ("simple-100", ["box", "cylinder"], [])


def test_times_come_back_as_they_were(tmp_path: Path) -> None:
    times = [Times(0, 0, 0.1, 0.2, 0.3), Times(0, 1, 1.0, 2.0, 3.0)]
    path = times_path(tmp_path / "results.jsonl")
    write_times(path, times)
    assert read_times(path) == times


def damaged(**change: Any) -> str:
    from dataclasses import asdict

    return json.dumps({"format": 1, **asdict(BARE), **change})


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "Expecting property name"),
        ("[]", "it is not a JSON object"),
        (damaged(format=2), "format 2, this program reads 1"),
        (damaged(scene="4"), "'scene' is '4'"),
        (damaged(value=float("nan")), "NaN is no number"),
        (damaged(value=True), "'value' is True"),
        (damaged(extra=1), "'extra' is missing or unknown"),
        (damaged(grasp={"position": [0, 0], "quaternion": [0, 0, 0, 1]}), "'grasp' is"),
        (damaged(errors={"distance_mm": 1.0}), "'errors' is"),
        (damaged(objects=[1]), "'objects' is"),
        (damaged(scene=3), "attempt 0 of scene 3 is there twice"),
    ],
)
def test_damage_is_told_with_its_line(line: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    write_results(path, [ROW])
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(UserError, match=f"results.jsonl, line 2: {message}"):
        read_results(path)


def test_no_file_and_an_empty_one_are_told(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        read_results(tmp_path / "absent.jsonl")
    (tmp_path / "empty.jsonl").write_text("")
    with pytest.raises(UserError, match="holds no results"):
        read_results(tmp_path / "empty.jsonl")


def test_a_number_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_results(tmp_path / "results.jsonl", [replace(ROW, value=float("nan"))])
    assert list(tmp_path.iterdir()) == []
