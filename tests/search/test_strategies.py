import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search import search, strategies
from nerfgrasp.search.feasibility import Feasibility
from nerfgrasp.search.schedule import PAPER, Phase, Plateau, Round, Schedule
from nerfgrasp.search.strategies import DEFAULT_STRATEGY, GUIDED, STRATEGIES, find_strategy

PEAK = torch.tensor([0.1, 0.05, 0.08])


def nearness(T: Tensor) -> Tensor:
    """Highest at a point, for approaches from straight above."""
    return -200.0 * (T[:, :3, 3] - PEAK).square().sum(dim=-1) - 5.0 * (1.0 + T[:, 2, 2])


@pytest.mark.parametrize("pose", ["quaternion", "transform", "screw"])  # decoupled, and whole transforms
@pytest.mark.parametrize("name", [name for name in STRATEGIES if name != "guided"])  # it needs a model: test_psi.py
def test_every_search_comes_near_the_peak(name: str, pose: str, workspace: Workspace) -> None:
    strategy = find_strategy(name, candidates=96, keep=min(12, STRATEGIES[name].climbing))
    arguments = {"rounds": strategy.rounds, "schedule": strategy.climb, "limits": strategy.limits}
    grasps, trace = search(
        nearness,
        registry.load(registry.POSES, pose)(),
        workspace,
        candidates=strategy.candidates,
        keep=strategy.keep,
        generator=torch.Generator().manual_seed(0),
        **arguments,
    )
    assert trace.value.shape[1] == 12
    assert len(trace.value) <= strategy.climb.steps + 1
    best = grasps.T_world_grasp[0]
    assert float((best[:3, 3] - PEAK).norm()) < 0.025  # Algorithm 1 ends with steps of 10 mm
    assert float(-best[2, 2]) > math.cos(0.35)


def test_the_default_is_what_was_measured() -> None:
    default = STRATEGIES[DEFAULT_STRATEGY]
    assert (default.name, default.candidates, default.keep, len(default.rounds)) == ("guided", 512, 64, 3)
    assert default.limits is not None
    assert default.feasibility is not None


def test_the_papers_search() -> None:
    paper = find_strategy("paper")
    assert (paper.candidates, paper.climbing, paper.rounds, paper.climb) == (4096, 4096, (), PAPER)
    assert paper.limits is None
    assert paper.feasibility is None
    assert str(paper) == "4096 candidates, all climb"


def test_what_is_given_takes_the_place_of_its_own() -> None:
    changed = find_strategy("prune", candidates=64, keep=8, max_tilt=20, clearance=0.03)
    assert (changed.candidates, changed.keep) == (64, 8)
    assert changed.limits is not None
    assert changed.limits.max_tilt == pytest.approx(math.radians(20))
    assert changed.limits.clearance == 0.03
    assert changed.climb == STRATEGIES["prune"].climb
    assert changed.settings() == {
        "strategy": "prune",
        "candidates": 64,
        "keep": 8,
        "max_tilt_degrees": 20.0,
        "clearance": 0.03,
    }
    assert find_strategy("prune", candidates=5).climbing == 5


def test_a_limit_of_the_papers_search_is_the_only_one() -> None:
    limits = find_strategy("paper", max_tilt=30).limits
    assert limits is not None
    assert limits.clearance is None
    limits = find_strategy("paper", clearance=0.01).limits
    assert limits is not None
    assert limits.max_tilt == math.pi
    assert find_strategy("paper").settings()["max_tilt_degrees"] is None


def test_limits_hold_for_what_is_found(workspace: Workspace) -> None:
    strategy = find_strategy("joint", candidates=8, max_tilt=10, clearance=0.02)
    grasps, _ = search(
        lambda T: T[:, 2, 2] - 10 * T[:, 2, 3],  # upwards and through the table
        registry.load(registry.POSES, "quaternion")(),
        workspace,
        candidates=8,
        generator=torch.Generator().manual_seed(0),
        schedule=strategy.climb,
        limits=strategy.limits,
    )
    assert (-grasps.T_world_grasp[:, 2, 2]).min() > math.cos(math.radians(10.1))
    assert ROBOTIQ_2F85.lowest(grasps.T_world_grasp).min() >= 0.02 - 1e-4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "papper"}, "unknown strategy 'papper': did you mean 'paper'"),
        ({"candidates": 0}, "candidates is 0: it must be at least 1"),
        ({"keep": -2}, "keep is -2: it must be at least 1"),
        ({"max_tilt": -1.0}, "max_tilt is -1.0: it must be from 0 to 180 degrees"),
        ({"max_tilt": math.nan}, "max_tilt is nan"),
        ({"clearance": -0.01}, "clearance is -0.01: it must be 0 metres or more"),
        ({"clearance": math.nan}, "clearance is nan"),
        ({"clearance": math.inf}, "clearance is inf"),
    ],
)
def test_bad_values_are_told(changes: dict[str, float], message: str) -> None:
    with pytest.raises(UserError, match=message):
        find_strategy(**{"name": "resample", **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(GUIDED, polished=0), "polished is 0: it must be at least 1"),
        (lambda: replace(GUIDED, climbers=0), "climbers is 0: it must be at least 1"),
        (lambda: replace(GUIDED, weighed=0), "weighed is 0: it must be at least 1"),
        (lambda: replace(GUIDED, spacing=0.0), "spacing is 0.0: it must be above 0"),
        (lambda: replace(GUIDED, spacing=math.nan), "spacing is nan"),
        (lambda: Phase((), steps=-1, learning_rate=0.1), "a phase's steps is -1: it must be at least 0"),
        (lambda: Phase((), steps=1, learning_rate=math.nan), "a phase's learning_rate is nan: it must be above 0"),
        (lambda: Phase((), steps=1, learning_rate=0.1, decay=0.0), "a phase's decay is 0.0: it must be above 0"),
        (lambda: Schedule((), clip=-1.0), "a schedule's clip is -1.0"),
        (lambda: Round(-1, 0.1, 0.1), "a round's copies is -1: it must be at least 1"),
        (lambda: Round(1, math.nan, 0.1), "a round's distance is nan: it must be at least 0"),
        (lambda: Round(1, 0.1, -0.1), "a round's angle is -0.1"),
        (lambda: Plateau(patience=-1), "a plateau's patience is -1"),
        (lambda: Plateau(rise=math.nan), "a plateau's rise is nan"),
        (lambda: Plateau(factor=2.0), "a plateau's factor is 2.0: it must be above 0 and at most 1"),
        (lambda: Plateau(least=-0.1), "a plateau's least share is -0.1: it must be at least 0 and at most 1"),
    ],
)
def test_numbers_out_of_range_are_told(make: Callable[[], object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        make()


def test_without_density_a_guided_search_resamples_with_the_numbers_given() -> None:
    # By its name, a model that can render is searched so too.
    assert GUIDED.blind() == find_strategy("alone")
    assert find_strategy("alone").feasibility is None
    changed = find_strategy(candidates=300, keep=20, max_tilt=30)
    assert changed.blind() == find_strategy("alone", candidates=300, keep=20, max_tilt=30)
    assert changed.blind().blind() == changed.blind()
    assert STRATEGIES["paper"].blind() == STRATEGIES["paper"]
    assert STRATEGIES["prune"].blind() == replace(STRATEGIES["prune"], feasibility=None)


def test_what_one_view_tells_of_density_counts_half_if_nobody_says_how_much() -> None:
    assert GUIDED.feasibility is not None
    halved = GUIDED.one_view()
    assert halved.feasibility == Feasibility(free=1.5, gap=5.0, slant=2.75)
    assert replace(halved, feasibility=GUIDED.feasibility) == GUIDED
    assert halved.one_view() == halved
    given = replace(GUIDED, feasibility=replace(GUIDED.feasibility, slant=5.0))
    assert given.one_view() == given
    assert STRATEGIES["paper"].one_view() == STRATEGIES["paper"]


def test_every_number_of_a_search_changes_its_identity(monkeypatch: pytest.MonkeyPatch) -> None:
    assert GUIDED.limits is not None
    assert GUIDED.feasibility is not None
    searches = [
        *STRATEGIES.values(),
        GUIDED.one_view(),
        find_strategy(candidates=300),
        replace(GUIDED, limits=replace(GUIDED.limits, clearance=0.01)),
        replace(GUIDED, feasibility=replace(GUIDED.feasibility, slant=5.0)),
        replace(GUIDED, climb=replace(GUIDED.climb, clip=0.5)),
        replace(GUIDED, polish=(*GUIDED.polish, Round(6, 0.001, 0.1))),
    ]
    assert len({search.identity for search in searches}) == len(searches)
    before = GUIDED.identity
    assert before == find_strategy("guided").identity
    assert before.startswith("guided-")
    monkeypatch.setattr(strategies, "SEARCH_VERSION", strategies.SEARCH_VERSION + 1)
    assert before != GUIDED.identity


def test_keeping_all_resamples_all(workspace: Workspace) -> None:
    strategy = replace(find_strategy("resample", candidates=4), keep=None)
    asked: list[int] = []

    def counted(T: Tensor) -> Tensor:
        asked.append(len(T))
        return nearness(T)

    pose = registry.load(registry.POSES, "quaternion")()
    generator = torch.Generator().manual_seed(0)
    search(counted, pose, workspace, candidates=4, rounds=strategy.rounds, schedule=strategy.climb, generator=generator)
    assert asked[: 1 + len(strategy.rounds)] == [4, *(4 * resampling.copies for resampling in strategy.rounds)]
