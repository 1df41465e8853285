import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from joblib.externals.loky import get_reusable_executor

from nerfgrasp import cli
from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.results import read_results, read_times, times_path
from nerfgrasp.methods.spec import MethodSpec
from nerfgrasp.models.folder import load_model, weights_hash
from nerfgrasp.search import strategies
from nerfgrasp.search.strategies import GUIDED, STRATEGIES

pytest.importorskip("pybullet")

from nerfgrasp_baselines.random import Random

from nerfgrasp.commands.evaluate import evaluate
from nerfgrasp.evaluation import parts
from nerfgrasp.evaluation.parts import Parts
from nerfgrasp.evaluation.trials import Trials
from nerfgrasp.sim.tasks import find_task

SMALL: dict[str, Any] = {"task": "simple", "method": "random", "scenes": 5, "seed": 11, "size": 32}


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results made in one go by one process, to compare others with."""
    out = tmp_path_factory.mktemp("evaluate") / "results.jsonl"
    evaluate(**SMALL, out=out, workers=1)
    return out


@dataclass(frozen=True)
class Case:
    """An evaluation, and what it gives in one go and one process."""

    arguments: dict[str, Any]
    unbroken: Path


@pytest.fixture(scope="module", autouse=True)
def _workers_of_these_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Prepared object models go to a fresh folder, in worker processes too: earlier ones know another."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        get_reusable_executor().shutdown(kill_workers=True)
        yield
        get_reusable_executor().shutdown(kill_workers=True)


@pytest.fixture(scope="module", params=["simple", "clutter", "novel", "psi"])
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Every task, and both a method that knows the truth and one that learns."""
    if request.param == "simple":
        return Case(SMALL, request.getfixturevalue("unbroken"))
    folder, changes = tmp_path_factory.mktemp(request.param), {"task": request.param, "scenes": 2}
    if request.param == "novel":
        request.getfixturevalue("make_box")(folder / "things")
        changes |= {"method": "antipodal", "objects": folder / "things", "scenes": 3}
    if request.param == "psi":
        changes |= {"task": "simple", "method": str(request.getfixturevalue("model"))}
    arguments = {**SMALL, **changes}
    evaluate(**arguments, out=folder / "results.jsonl", workers=1)
    return Case(arguments, folder / "results.jsonl")


KILLED_WHILE_PUBLISHING = """
import os, signal
from nerfgrasp.evaluation import parts
parts.write_results = lambda path, rows: os.kill(os.getpid(), signal.SIGKILL)
"""


def test_every_attempt_is_a_line_in_scene_order(unbroken: Path) -> None:
    rows = read_results(unbroken)
    assert [(row.scene, row.attempt) for row in rows] == [(scene, 0) for scene in range(5)]
    assert {(row.set, row.method, row.model) for row in rows} == {("simple-11", "random", None)}
    assert len({row.scene_sha256 for row in rows}) == 5
    assert all(row.grasp is not None and row.errors is not None for row in rows)
    times = read_times(times_path(unbroken))
    assert [(one.scene, one.attempt) for one in times] == [(row.scene, row.attempt) for row in rows]
    assert min(one.render_s for one in times) > 0
    assert sorted(path.name for path in unbroken.parent.iterdir()) == ["results.jsonl", "results.times.jsonl"]


@pytest.mark.parametrize("case", ["clutter", "psi"], indirect=True)  # of several attempts a scene, and what learns
@pytest.mark.usefixtures("ray_cluster")
def test_a_cluster_changes_no_byte(case: Case, tmp_path: Path) -> None:
    evaluate(**case.arguments, out=tmp_path / "results.jsonl", workers=2, cluster="ray")
    assert (tmp_path / "results.jsonl").read_bytes() == case.unbroken.read_bytes()


@pytest.mark.parametrize("case", ["simple", "clutter"], indirect=True)  # of one attempt a scene, and of several
def test_two_workers_killed_at_any_time_and_continued(
    case: Case, tmp_path: Path, run_until_killed: Callable[..., None]
) -> None:
    out = tmp_path / "results.jsonl"
    run_until_killed(
        evaluate, **case.arguments, out=out, workers=2, until=lambda: any(tmp_path.glob("*.parts/0*.json"))
    )
    evaluate(**case.arguments, out=out, workers=2)
    assert out.read_bytes() == case.unbroken.read_bytes()


def test_two_workers_change_no_byte(unbroken: Path, tmp_path: Path) -> None:
    evaluate(**SMALL, out=tmp_path / "results.jsonl", workers=2)
    assert (tmp_path / "results.jsonl").read_bytes() == unbroken.read_bytes()


@pytest.mark.parametrize(
    ("when", "finished"),
    # The first that is written are the settings.
    [({"writing": (parts, 4)}, 2), ({"before": KILLED_WHILE_PUBLISHING}, 5)],
    ids=["writing", "publishing"],
)
def test_killed_and_continued(
    when: dict[str, Any], finished: int, unbroken: Path, tmp_path: Path, run_until_killed: Callable[..., None]
) -> None:
    out = tmp_path / "results.jsonl"
    run_until_killed(evaluate, **SMALL, out=out, workers=1, **when)
    assert len(list((tmp_path / "results.jsonl.parts").glob("[0-9]*.json"))) == finished
    assert not out.exists()
    evaluate(**SMALL, out=out, workers=1)
    assert out.read_bytes() == unbroken.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["results.jsonl", "results.times.jsonl"]


def test_fewer_scenes_are_the_first_of_more(unbroken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluate(**{**SMALL, "scenes": 2}, out=tmp_path / "new" / "results.jsonl", workers=1)
    assert unbroken.read_bytes().startswith((tmp_path / "new" / "results.jsonl").read_bytes())
    assert "random in 2 scenes of simple-11: " in capsys.readouterr().out


def test_finished_results_are_left_alone(unbroken: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = unbroken.stat().st_mtime_ns
    evaluate(**SMALL, out=unbroken)
    assert "is already complete: 5 scenes" in capsys.readouterr().out
    assert unbroken.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 12}, "holds other results: set 'simple-11', asked for 'simple-12'"),
        ({"method": "oracle"}, "holds other results: method 'random', asked for 'oracle'"),
        ({"scenes": 6}, "holds other results: scenes 5, asked for 6"),
        ({"size": 48}, "holds other results: scene_sha256 "),
    ],
)
def test_other_results_are_refused(unbroken: Path, change: dict[str, Any], message: str) -> None:
    before = unbroken.read_bytes()
    with pytest.raises(UserError, match=message):
        evaluate(**{**SMALL, **change}, out=unbroken)
    assert unbroken.read_bytes() == before


def test_the_parts_of_another_command_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "results.jsonl"
    settings = Trials(find_task("simple"), 12, MethodSpec("random"), None, 32).settings()
    Parts(out, settings).claim(5)
    with pytest.raises(
        UserError,
        match=r"left by another command: its set is 'simple-12', asked for 'simple-11'",
    ):
        evaluate(**SMALL, out=out, workers=1)
    assert [path.name for path in (tmp_path / "results.jsonl.parts").iterdir()] == ["settings.json"]


def test_finished_scenes_are_not_thrown_away_by_a_shorter_run(tmp_path: Path) -> None:
    out = tmp_path / "results.jsonl"
    left = Parts(out, Trials(find_task("simple"), 11, MethodSpec("random"), None, 32).settings())
    left.claim(5)
    for scene in (0, 3):
        left.write(scene, [])
    before = sorted(path.name for path in left.folder.iterdir())
    with pytest.raises(UserError, match="it holds scene 3, asked for 3 scenes; ask for as many"):
        evaluate(**{**SMALL, "scenes": 3}, out=out, workers=1)
    assert sorted(path.name for path in left.folder.iterdir()) == before
    left.claim(4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "simpel"}, "unknown task 'simpel': did you mean 'simple'?"),
        ({"method": "orcale"}, "unknown method (and no model) 'orcale': did you mean 'oracle'?"),
        ({"strategy": "paper"}, "method 'random' has no option 'strategy'"),
        ({"method": "no/such/folder"}, "unknown model (no folder, and none shipped by that name) 'no/such/folder'"),
        ({"objects": Path("here")}, "only 'novel' takes a folder"),
        ({"task": "novel", "objects": Path(__file__).parent}, "commands: neither a URDF nor a mesh"),
        ({"cluster": "rya"}, "'cluster': "),
        ({"scenes": 0}, "scenes is 0: it must be from 1 to"),
        ({"seed": -1}, "seed is -1"),
        ({"size": 8}, "size is 8: it must be from 16"),
        ({"workers": 0}, "workers is 0"),
        ({"device": "cuda:99"}, "device 'cuda:99' is not there"),
        ({"device": "cpu"}, "method 'random' has no option 'device'"),
    ],
)
def test_bad_values_are_one_line_and_nothing_is_written(
    change: dict[str, Any], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = {**SMALL, "out": tmp_path / "results.jsonl", **change}
    assert cli.main(["evaluate", *(f"--{name}={value}" for name, value in values.items())]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert message in err
    assert list(tmp_path.iterdir()) == []


def test_a_method_s_fault_is_one_line_and_finished_scenes_are_kept(
    unbroken: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refusal: Callable[[list[str]], str]
) -> None:
    propose, calls = Random.propose, []

    def fails_once(*args: Any, **kwargs: Any) -> Any:
        calls.append(None)
        if len(calls) == 3:
            raise IndexError("list index out of range")
        return propose(*args, **kwargs)

    monkeypatch.setattr(Random, "propose", fails_once)
    out = tmp_path / "results.jsonl"
    line = refusal(["evaluate", *(f"--{name}={value}" for name, value in {**SMALL, "out": out, "workers": 1}.items())])
    named = r"method 'random' \(nerfgrasp_baselines.random:Random of nerfgrasp [0-9.]+\), scene 2, attempt 0: "
    assert re.fullmatch(named + r"IndexError: list index out of range \(the plug-in is at fault\)", line)
    kept = sorted(path.name for path in (tmp_path / "results.jsonl.parts").glob("0*.json"))
    assert kept == ["000000.json", "000001.json"]
    evaluate(**SMALL, out=out, workers=1)
    assert out.read_bytes() == unbroken.read_bytes()


def test_a_folder_without_a_method_is_told(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    with pytest.raises(UserError, match=r"config.json: no such file"):
        evaluate(**{**SMALL, "method": str(tmp_path / "model")}, out=tmp_path / "results.jsonl")
    (tmp_path / "model" / "config.json").write_text('{"format": 1}')
    with pytest.raises(UserError, match="its config.json names no grasping method"):
        evaluate(**{**SMALL, "method": str(tmp_path / "model")}, out=tmp_path / "results.jsonl")


def test_places_that_cannot_be_written_are_told(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cannot write .*: it is a folder"):
        evaluate(**SMALL, out=tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write .*: Not a directory"):
        evaluate(**SMALL, out=tmp_path / "file" / "results.jsonl")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_is_told(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match=r"cannot write .*Permission denied"):
        evaluate(**SMALL, out=tmp_path / "results.jsonl")


@pytest.mark.parametrize("case", ["psi"], indirect=True)
def test_a_model_is_named_by_its_weights(case: Case, model: Path) -> None:
    first, second = read_results(case.unbroken)
    assert (first.method, first.model) == ("psi", weights_hash(load_model(model))[:16])
    assert second.model == first.model
    assert first.search == second.search == GUIDED.identity
    assert str(model.parent) not in case.unbroken.read_text()


def test_a_strategy_is_recorded_and_kept_apart(model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STRATEGIES, "paper", replace(STRATEGIES["paper"], candidates=4))
    arguments, out = {**SMALL, "method": str(model), "scenes": 1}, tmp_path / "results.jsonl"
    evaluate(**arguments, strategy="paper", out=out, workers=1)
    assert [row.options for row in read_results(out)] == [{"strategy": "paper"}]
    assert [row.search for row in read_results(out)] == [STRATEGIES["paper"].identity]
    with pytest.raises(UserError, match="holds other results: options {'strategy': 'paper'}, asked for {}"):
        evaluate(**arguments, out=out)
    with pytest.raises(UserError, match="unknown strategy 'papre': did you mean 'paper'"):
        evaluate(**arguments, strategy="papre", out=tmp_path / "other.jsonl")
    with pytest.raises(UserError, match="holds other results: options .*, asked for .*'device': 'cpu'"):
        evaluate(**arguments, strategy="paper", out=out, device="cpu")
    evaluate(**arguments, strategy="paper", pose="screw", out=tmp_path / "screw.jsonl", workers=1)
    [own], [screw] = read_results(out), read_results(tmp_path / "screw.jsonl")
    assert (own.options, screw.options) == ({"strategy": "paper"}, {"strategy": "paper", "pose": "screw"})
    assert own.grasp != screw.grasp
    with pytest.raises(UserError, match="holds other results: options .*, asked for .*'pose': 'screw'"):
        evaluate(**arguments, strategy="paper", pose="screw", out=out)
    with pytest.raises(UserError, match="unknown pose 'scerw': did you mean 'screw'"):
        evaluate(**arguments, pose="scerw", out=tmp_path / "other.jsonl")
    # Another search of the same name, finished or begun: neither is taken for the one asked for.
    search = STRATEGIES["paper"].identity
    monkeypatch.setattr(strategies, "SEARCH_VERSION", strategies.SEARCH_VERSION + 1)
    with pytest.raises(UserError, match=f"holds other results: search '{search}', asked for 'paper-"):
        evaluate(**arguments, strategy="paper", out=out)
    model_hash = weights_hash(load_model(model))[:16]
    begun = Trials(
        find_task("simple"), 11, MethodSpec("psi", options={"strategy": "paper"}), model_hash, 32, None, search
    )
    Parts(tmp_path / "begun.jsonl", begun.settings()).claim(scenes=1)
    with pytest.raises(UserError, match=f"left by another command: its search is '{search}'"):
        evaluate(**arguments, strategy="paper", out=tmp_path / "begun.jsonl", workers=1)
