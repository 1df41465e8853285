from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from nerfgrasp.evaluation.results import Row, Times, times_path, write_results, write_times

ROW = Row(
    set="simple-7",
    task="simple",
    seed=7,
    scene=0,
    attempt=0,
    method="oracle",
    model=None,
    scene_sha256="",
    physics="0123456789abcdef",
    objects=("box",),
    grasp={"position": [0.0, 0.0, 0.05], "quaternion": [1.0, 0.0, 0.0, 0.0]},
    value=1.0,
    outcome="success",
    object=0,
    lifted_mm=100.0,
    dropped=(),
    errors={"distance_mm": 2.0, "angle_deg": 4.0},
    versions={"nerfgrasp": "0.1.0", "torch": "2.8.0", "pybullet": "3.2.7"},
)


@pytest.fixture
def attempts() -> Callable[..., list[Row]]:
    """Returns a function of outcomes, a list a scene, and of what differs from a success: the rows."""

    def make(*scenes: Sequence[str], **changes: Any) -> list[Row]:
        return [
            replace(ROW, scene=scene, attempt=attempt, outcome=outcome, scene_sha256=f"{scene}-{attempt}", **changes)
            for scene, outcomes in enumerate(scenes)
            for attempt, outcome in enumerate(outcomes)
        ]

    return make


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Returns a function that writes rows to a file of that name, with wall times beside it if they are given."""

    def make(name: str, rows: Sequence[Row], times: Sequence[Times] = ()) -> Path:
        path = tmp_path / name
        write_results(path, rows)
        if times:
            write_times(times_path(path), times)
        return path

    return make
