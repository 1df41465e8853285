from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.results import Row, Times
from nerfgrasp.evaluation.runs import SUCCESS, common_scenes, load_runs

Attempts = Callable[..., list[Row]]
Write = Callable[..., Path]


def test_success_is_the_simulators() -> None:
    from nerfgrasp.sim.attempt import Outcome

    assert Outcome.SUCCESS == SUCCESS


def test_rows_are_read_by_scene_with_the_times_beside(attempts: Attempts, write: Write) -> None:
    rows = attempts(["success", "slipped"], ["success"])
    times = [Times(0, 0, 0.1, 0.2, 0.3)]
    run, bare = load_runs([write("a.jsonl", rows, times), write("b.jsonl", attempts(["success"], method="psi"))])
    assert {scene: [row.attempt for row in mine] for scene, mine in run.scenes.items()} == {0: [0, 1], 1: [0]}
    assert run.times == tuple(times)
    assert bare.times == ()
    assert common_scenes(run, bare) == [0]


def test_wall_times_named_along_with_their_results_are_no_run(attempts: Attempts, write: Write, tmp_path: Path) -> None:
    write("a.jsonl", attempts(["success"]), [Times(0, 0, 0.1, 0.2, 0.3)])
    [run] = load_runs(sorted(tmp_path.glob("*.jsonl")))
    assert run.path.name == "a.jsonl"
    with pytest.raises(UserError, match="a.times.jsonl, line 1: format None"):
        load_runs([tmp_path / "a.times.jsonl"])


def test_models_of_one_method_are_told_apart(attempts: Attempts, write: Write) -> None:
    models = ["a" * 16, "b" * 16]
    paths = [write(f"{m[0]}.jsonl", attempts(["success"], method="psi", model=m)) for m in models]
    other = write("oracle.jsonl", attempts(["success"]))
    assert [run.label for run in load_runs([*paths, other])] == ["psi aaaaaaaa", "psi bbbbbbbb", "oracle"]
    assert [run.label for run in load_runs([paths[0], other])] == ["psi", "oracle"]


def test_schedules_and_poses_of_one_method_are_told_apart(attempts: Attempts, write: Write) -> None:
    own, paper = attempts(["success"], method="psi"), attempts(["slipped"], method="psi", options={"strategy": "paper"})
    screw = attempts(["slipped"], method="psi", options={"strategy": "paper", "pose": "screw"})
    paths = [write("own.jsonl", own), write("paper.jsonl", paper), write("screw.jsonl", screw)]
    assert [run.label for run in load_runs(paths)] == ["psi", "psi paper", "psi paper screw"]
    with pytest.raises(UserError, match="options {'strategy': 'paper'}, but line 1 has None"):
        load_runs([write("both.jsonl", [*own, *(replace(row, attempt=1) for row in paper)])])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "a.jsonl and .*b.jsonl are both of oracle on simple: give one of them"),
        ({"method": "psi", "physics": "f" * 16}, "b.jsonl is of physics f{16}, .*a.jsonl of 0123456789abcdef"),
        ({"task": "novel", "set": "novel-7", "physics": "f" * 16}, "b.jsonl is of physics f{16}"),
        ({"method": "psi", "seed": 8, "set": "simple-8"}, r"scenes simple-8 \(seed 8\), .*a.jsonl of simple-7 \(seed"),
        ({"method": "psi", "set": "simple-other-7"}, "scenes simple-other-7"),
    ],
)
def test_files_that_do_not_compare_are_refused(
    changes: dict[str, object], message: str, attempts: Attempts, write: Write
) -> None:
    scenes = (["success"], ["slipped"])
    paths = [write("a.jsonl", attempts(*scenes)), write("b.jsonl", attempts(*scenes, **changes))]
    with pytest.raises(UserError, match=message):
        load_runs(paths)


def test_other_scenes_of_the_same_name_are_refused(attempts: Attempts, write: Write) -> None:
    rows = attempts(["success"], ["success"], method="psi")
    rows[1] = replace(rows[1], scene_sha256="other")
    paths = [write("a.jsonl", attempts(["success"], ["success"])), write("b.jsonl", rows)]
    with pytest.raises(UserError, match=r"scene 1 of simple-7 is other in .*b.jsonl and 1-0 in .*a.jsonl"):
        load_runs(paths)


def test_later_attempts_may_find_other_tables(attempts: Attempts, write: Write) -> None:
    clutter = {"task": "clutter", "set": "clutter-7", "objects": ("box", "l")}
    rows = attempts(["slipped", "success"], method="psi", **clutter)
    rows[1] = replace(rows[1], scene_sha256="what is left")
    paths = [write("a.jsonl", attempts(["success", "success"], **clutter)), write("b.jsonl", rows)]
    assert len(load_runs(paths)) == 2


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("physics", "f" * 16, "line 2: physics 'ffffffffffffffff', but line 1 has '0123456789abcdef'"),
        ("method", "psi", "line 2: method 'psi', but line 1 has 'oracle'"),
        ("search", "guided-0", "line 2: search 'guided-0', but line 1 has None"),
        ("attempt", 1, "scene 1 has an attempt 1 but no attempt 0"),
    ],
)
def test_files_that_are_not_one_run_are_refused(
    name: str, value: object, message: str, attempts: Attempts, write: Write
) -> None:
    rows = attempts(["success"], ["success"])
    rows[1] = replace(rows[1], **{name: value})
    with pytest.raises(UserError, match=message):
        load_runs([write("a.jsonl", rows)])


def test_a_file_given_twice_is_refused(attempts: Attempts, write: Write) -> None:
    path = write("a.jsonl", attempts(["success"]))
    with pytest.raises(UserError, match="a.jsonl is given twice"):
        load_runs([path, path])


def test_damaged_wall_times_are_refused_by_line(attempts: Attempts, write: Write, tmp_path: Path) -> None:
    path = write("a.jsonl", attempts(["success"]))
    (tmp_path / "a.times.jsonl").write_text('{"scene": 0}\n')
    with pytest.raises(UserError, match=r"a.times.jsonl, line 1: "):
        load_runs([path])
