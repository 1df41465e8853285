"""What is recorded of an attempt, with methods made for the test."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch

from nerfgrasp.errors import UserError
from nerfgrasp.methods.spec import MethodSpec
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace

pytest.importorskip("pybullet")

from nerfgrasp.evaluation import trials
from nerfgrasp.evaluation.trials import Trials, proposal_generator, recorded_pose, run_scene, scene_hash
from nerfgrasp.scenes.oracle import sample_top_down, valid_grasps
from nerfgrasp.sim.attempt import attempt_grasp
from nerfgrasp.sim.tasks import find_task, scene_cameras

DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


class Scripted:
    """Proposes the pose or poses that a function of (observations, generator) returns, and keeps what it was shown."""

    def __init__(self, needs: set[str], propose: Callable[..., Any]) -> None:
        self.needs, self.script = frozenset(needs), propose
        self.seen: list[Observations] = []

    def propose(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> Grasps:
        self.seen.append(observations)
        T = self.script(observations, generator)
        poses = torch.zeros(0, 4, 4) if T is None else T.view(-1, 4, 4)[:count]
        return Grasps(poses, torch.full((len(poses),), 0.5))


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Scripted]:
    """Returns a function that makes a scripted method the one that every name loads."""

    def make(propose: Callable[..., Any], needs: set[str] = frozenset()) -> Scripted:  # type: ignore[assignment]
        method = Scripted(needs, propose)
        monkeypatch.setattr(trials, "load_method", lambda *_, **__: method)
        return method

    return make


SIMPLE = Trials(find_task("simple"), 3, MethodSpec("scripted"), None, size=32)


def high(observations: Observations, generator: torch.Generator) -> torch.Tensor:
    """A grasp in the air, which touches nothing."""
    T = DOWN.clone()
    T[2, 3] = 0.4
    return T


def demonstrated(observations: Observations, generator: torch.Generator) -> torch.Tensor:
    assert observations.truth is not None
    return sample_top_down(valid_grasps(observations.truth.objects), generator)


def test_a_method_sees_what_it_declares_and_no_more(script: Callable[..., Scripted]) -> None:
    for needs in (set(), {"depth"}, {"truth"}, {"depth", "truth"}):
        method = script(high, needs)
        run_scene(SIMPLE, 0)
        (seen,) = method.seen
        assert seen.images.shape == (3, 3, 32, 32)
        assert 0 <= seen.images.min() < seen.images.max() <= 1
        assert (seen.depth is not None) == ("depth" in needs)
        assert (seen.truth is not None) == ("truth" in needs)
        if seen.depth is not None:
            assert seen.depth.shape == (3, 32, 32)
            assert 0.5 < seen.depth.median() < 1.5, "cameras are 0.8 m away"


def test_a_row_repeats_its_attempt(script: Callable[..., Scripted]) -> None:
    script(demonstrated, {"truth"})
    ((row, _),) = run_scene(SIMPLE, 1)
    truth = find_task("simple").draw(3, 1)
    assert row.scene_sha256 == scene_hash(truth, scene_cameras(3, 1, 3, 32))
    assert row.grasp is not None
    again = attempt_grasp(truth, recorded_pose(row.grasp))
    assert (row.outcome, row.object, row.lifted_mm) == (str(again.outcome), again.object, 1000 * again.lifted)
    assert row.errors is not None
    assert row.errors["distance_mm"] < 0.01
    assert row.errors["angle_deg"] < 0.1
    assert row.value == 0.5


def test_nothing_proposed_is_an_outcome(script: Callable[..., Scripted]) -> None:
    script(lambda observations, generator: None)
    ((row, _),) = run_scene(SIMPLE, 0)
    assert (row.outcome, row.grasp, row.value, row.errors, row.object) == ("no_grasp", None, None, None, None)


@pytest.mark.parametrize("broken", [torch.full((4, 4), float("nan")), torch.diag(torch.tensor([2.0, 2, 2, 1]))])
def test_what_is_no_pose_is_told(broken: torch.Tensor, script: Callable[..., Scripted]) -> None:
    script(lambda observations, generator: broken)
    with pytest.raises(UserError, match="method 'scripted', scene 0, attempt 0: it proposed what is no pose"):
        run_scene(SIMPLE, 0)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (None, "TypeError: propose returned NoneType, not Grasps"),
        (Grasps(torch.zeros(2, 3, 3), torch.zeros(2)), r"\(2, 3, 3\).* not \[N, 4, 4\]"),
        (Grasps(torch.zeros(2, 4, 4), torch.zeros(3)), r"values \(3,\)"),
        (Grasps(torch.zeros(4, 4), torch.tensor(1.0)), r"poses \(4, 4\) and values \(\)"),
        (Grasps(torch.zeros(1, 4, 4), [1.0]), "AttributeError: 'list'"),  # type: ignore[arg-type]
        (ZeroDivisionError("of theirs"), "ZeroDivisionError: of theirs"),
    ],
)
def test_a_faulty_method_is_named(
    returned: Any, message: str, script: Callable[..., Scripted], monkeypatch: pytest.MonkeyPatch
) -> None:
    def propose(*args: Any, **kwargs: Any) -> Any:
        if isinstance(returned, Exception):
            raise returned
        return returned

    monkeypatch.setattr(script(high), "propose", propose)
    where = "^method 'scripted', scene 0, attempt 0: "
    with pytest.raises(UserError, match=f"{where}.*{message}.*the plug-in is at fault") as told:
        run_scene(SIMPLE, 0)
    assert told.value.__cause__ is not None, "what --debug shows"


def test_attempts_draw_apart_and_the_same_again() -> None:
    def draw(*key: int) -> float:
        return torch.rand(1, generator=proposal_generator(*key)).item()

    keys = [(3, 0, 0), (3, 0, 1), (3, 1, 0), (4, 0, 0)]
    assert len({draw(*key) for key in keys}) == len(keys)
    assert [draw(*key) for key in keys] == [draw(*key) for key in keys]


REPEATED = replace(SIMPLE, task=replace(find_task("simple"), name="repeated", attempts=4))


def test_lifted_objects_are_gone_and_the_next_attempt_looks_anew(script: Callable[..., Scripted]) -> None:
    method = script(demonstrated, {"truth"})
    rows = [row for row, _ in run_scene(REPEATED, 1)]
    assert [row.attempt for row in rows] == list(range(len(rows)))
    lifted = [index for index, row in enumerate(rows) if row.outcome == "success"]
    assert lifted, "a valid grasp lifts"
    for before, after in pairwise(rows):
        gone = int(before.outcome == "success") + len(before.dropped)
        assert len(after.objects) == len(before.objects) - gone
        assert after.scene_sha256 != before.scene_sha256 or gone == 0
    if len(rows) > lifted[0] + 1:
        first, second = method.seen[lifted[0]], method.seen[lifted[0] + 1]
        assert not torch.equal(first.images, second.images)
    assert len(rows) == 4 or len(rows[-1].objects) == 1


def test_what_failed_is_not_repeated_until_a_success(script: Callable[..., Scripted]) -> None:
    def propose(observations: Observations, generator: torch.Generator) -> torch.Tensor:
        again, other = high(observations, generator), high(observations, generator)
        again[0, 3] += 0.005 * torch.rand(1, generator=generator).item()
        other[0, 3] = 0.1
        return torch.stack([again, other, demonstrated(observations, generator)])

    script(propose, {"truth"})
    rows = [row for row, _ in run_scene(REPEATED, 1)]
    chosen = ["again" if abs(row.grasp["position"][0]) < 0.01 else "other" for row in rows[:2]]
    assert chosen == ["again", "other"]
    assert [row.outcome for row in rows[:3]] == ["nothing_between_fingers"] * 2 + ["success"]
    assert len(rows) == 3 or rows[3].grasp["position"] == pytest.approx([0.0, 0.0, 0.4], abs=0.01)


def test_what_failed_may_be_like_several_that_differ(script: Callable[..., Scripted]) -> None:
    def propose(observations: Observations, generator: torch.Generator) -> torch.Tensor:
        first = len(method.seen) == 1
        return torch.stack([beside(x) for x in ((0.0,) if first else (-0.015, 0.015, 0.1))])

    def beside(x: float) -> torch.Tensor:
        T = high(None, None)  # type: ignore[arg-type]
        T[0, 3] = x
        return T

    method = script(propose)
    rows = [row for row, _ in run_scene(replace(REPEATED, task=replace(REPEATED.task, attempts=2)), 0)]
    assert [row.grasp["position"][0] for row in rows] == pytest.approx([0.0, 0.1])


def test_a_method_without_end_is_not_asked_forever(script: Callable[..., Scripted]) -> None:
    method = script(lambda observations, generator: high(observations, generator).expand(10_000, 4, 4).contiguous())
    rows = [row for row, _ in run_scene(replace(REPEATED, task=replace(REPEATED.task, attempts=2)), 0)]
    assert rows[1].grasp == rows[0].grasp
    assert len(method.seen) <= 12


def test_where_all_has_failed_the_best_is_repeated(script: Callable[..., Scripted]) -> None:
    script(high)
    rows = [row for row, _ in run_scene(REPEATED, 0)]
    assert [row.grasp["position"][2] for row in rows] == pytest.approx([0.4] * 4)


def test_a_scene_without_a_grasp_goes_on_to_its_next_attempt(script: Callable[..., Scripted]) -> None:
    script(lambda observations, generator: None)
    rows = [row for row, _ in run_scene(REPEATED, 0)]
    assert [(row.attempt, row.outcome) for row in rows] == [(k, "no_grasp") for k in range(4)]
    assert len({row.scene_sha256 for row in rows}) == 1
