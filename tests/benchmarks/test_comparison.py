import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import comparison
import pytest
import torch

from nerfgrasp.errors import UserError
from nerfgrasp.models import GraspValue, GraspValueConfig
from nerfgrasp.models.folder import save_model
from nerfgrasp.search.ascent import Trace

pytest.importorskip("pybullet")


@dataclass(frozen=True)
class Case:
    label: str


class Recorder:
    def __init__(self) -> None:
        self.asked: list[tuple[int, list[str]]] = []

    def __call__(self, scene: int, cases: Sequence[Case]) -> list[comparison.Row]:
        self.asked.append((scene, [case.label for case in cases]))
        return [{"value": scene + len(case.label)} for case in cases]


def run(out: Path, cases: str, scenes: int, seed: int = 7) -> tuple[Recorder, list[comparison.Row]]:
    recorder = Recorder()
    found = comparison.compare(
        recorder, [Case(label) for label in cases.split()], {"seed": seed}, out=out, scenes=scenes, workers=1
    )
    return recorder, found


def test_what_is_there_is_not_measured_again(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    recorder, rows = run(out, "a bb", scenes=2)
    assert recorder.asked == [(0, ["a", "bb"]), (1, ["a", "bb"])]
    recorder, more = run(out, "bb c a", scenes=3)
    assert recorder.asked == [(0, ["c"]), (1, ["c"]), (2, ["bb", "c", "a"])]
    assert [(row["scene"], row["case"]) for row in more] == [(s, c) for s in range(3) for c in ("bb", "c", "a")]
    assert all(row in more for row in rows)
    recorder, again = run(out, "bb c a", scenes=3)
    assert not recorder.asked
    assert again == more


def test_a_torn_line_is_measured_again(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    run(out, "a", scenes=2)
    whole = out.read_bytes()
    out.write_bytes(whole[:-4])
    recorder, _ = run(out, "a", scenes=2)
    assert recorder.asked == [(1, ["a"])]
    assert out.read_bytes() == whole


def test_rows_of_other_settings_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    run(out, "a", scenes=1)
    with pytest.raises(UserError, match="line 1: seed is 7, not 8"):
        run(out, "a", scenes=1, seed=8)
    assert len(out.read_text().splitlines()) == 1


def test_what_a_climb_came_to() -> None:
    values = torch.tensor([[0.0, 3.0], [1.0, 2.0], [4.95, 1.0], [5.0, 2.5]])
    found = comparison.climb_measures(Trace(torch.eye(4).expand(4, 2, 4, 4), values))
    assert found == {"start": 3.0, "value": 5.0, "mean": 3.75, "steps": 2, "median_steps": 1.0, "fell": 0.5}


def test_the_best_case_and_the_edge_of_its_grid() -> None:
    cases = [Case(label) for label in "abc"]
    values = {"a": (1.0, 1.0), "b": (4.0, 0.0), "c": (1.5, 1.5)}
    rows = [{"case": label, "value": value} for label, pair in values.items() for value in pair]
    assert comparison.best(cases, rows).label == "b"
    assert comparison.on_edge(cases, rows) == ""
    assert "edge" in comparison.on_edge(cases[1:], rows)


def test_tables() -> None:
    outcomes = {"one": ["success", "slipped", "success"], "other": ["success", "success", "slipped"]}
    rows = [
        {"case": case, "outcome": outcome, "value": float(scene + len(case)), "distance_mm": 2.0, "angle_deg": 3.0}
        for case, every in outcomes.items()
        for scene, outcome in enumerate(every)
    ]
    (first, *_), _ = comparison.attempts_table(rows).rows
    assert first == "one"
    assert comparison.attempts_table(rows).rows[1][1:3] == ("2 of 3", "0.667 [0.208, 0.939]")
    (line,) = comparison.differences_table(rows).rows
    assert (line[0], *line[2:]) == ("other", "1", "1", "1.000", "2.00 (0.00)")


def test_poses_in_a_scene(tmp_path: Path, tiny_network: Callable[..., Any], capsys: pytest.CaptureFixture[str]) -> None:
    import poses

    torch.manual_seed(0)
    save_model(tmp_path / "model", GraspValue(GraspValueConfig(backbone=tiny_network(image_size=32))))
    rates = {"quaternion": (0.01, 0.05), "screw": (0.01,), "nothing": (0.01,)}
    out = tmp_path / "rows.jsonl"
    poses.compare(rates, out, scenes=1, candidates=20, model=str(tmp_path / "model"), workers=1)
    one, other = map(json.loads, out.read_text().splitlines())
    assert [one["case"], other["case"]] == ["quaternion 0.01/0.05", "screw 0.01"]
    assert one["evaluations"] == other["evaluations"]
    assert one["evaluations"] % (2 * 32 + 1) == 0
    assert one["start"] == pytest.approx(other["start"], abs=1e-4)
    told = capsys.readouterr().out
    assert "nothing: no such parameterization" in told
    assert "Less quaternion 0.01/0.05" in told


def test_schedules_spend_alike(tmp_path: Path, tiny_network: Callable[..., Any]) -> None:
    import schedules

    torch.manual_seed(0)
    save_model(tmp_path / "model", GraspValue(GraspValueConfig(backbone=tiny_network(image_size=32))))
    cases = [schedules.Case(name) for name in ("resample", "paper")]
    found = schedules.measure(0, cases, model=str(tmp_path / "model"), seed=7, attempts=False, spacing=None)
    assert [row["evaluations"] for row in found] == [2464, 2470]


def test_the_full_search_is_held_against_the_default(
    tmp_path: Path,
    tiny_network: Callable[..., Any],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import schedules

    torch.manual_seed(0)
    save_model(tmp_path / "model", GraspValue(GraspValueConfig(backbone=tiny_network(image_size=32))))
    for name, strategy in schedules.FULL.items():
        monkeypatch.setitem(schedules.FULL, name, replace(strategy, candidates=16))
    out = tmp_path / "rows.jsonl"
    schedules.full(out, scenes=1, model=str(tmp_path / "model"), workers=1)
    default, full = map(json.loads, out.read_text().splitlines())
    assert [default["case"], full["case"]] == ["default", "full"]
    # All 16 for 7 steps, 8 for 4, and so on; the rest is what polishing asks for, of any.
    assert full["evaluations"] > 2 * (16 * 7 + 8 * 4)
    assert "Less default" in capsys.readouterr().out
