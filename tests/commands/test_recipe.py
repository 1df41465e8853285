import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("pybullet")

from nerfgrasp import cli
from nerfgrasp.commands import recipe
from nerfgrasp.commands.configs import find_config
from nerfgrasp.commands.recipe import Experiment, Learned, table_stages
from nerfgrasp.commands.stages import Stage
from nerfgrasp.errors import UserError
from nerfgrasp.models.folder import find_model

# Lightning calls what jsonargparse is about to retire.
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


@pytest.fixture
def stages(tmp_path: Path) -> Callable[..., dict[str, Stage]]:
    """Returns a function of methods: the table's stages by name."""

    def make(*methods: str, **changes: Any) -> dict[str, Stage]:
        settings = {
            "folder": tmp_path, "scale": "laptop", "evaluate_only": False, "scenes": 200, "clutter_scenes": 40,
            "novel_scenes": 0, "objects": None, "seeds": 1,
        }  # fmt: skip
        made = table_stages(Experiment(methods=methods, **{**settings, **changes}))
        return {stage.name: stage for stage in made}

    return make


def test_every_method_from_its_data_to_its_trials(stages: Callable[..., dict[str, Stage]]) -> None:
    found = stages("mv3", "no3", "random", novel_scenes=180, objects=Path("/ycb"), seeds=2)
    assert list(found) == [
        "data-simple-views", "data-simple-held-out", "mv3-backbone", "data-grasps", "data-grasps-held-out", "mv3-head",
        "simple-mv3", "clutter-mv3", "novel-mv3", "mv3-head-seed1", "simple-mv3-seed1",
        "no3-rate-0.3", "no3-rate-1", "no3-rate-3", "no3-head", "simple-no3", "clutter-no3", "novel-no3",
        "simple-random", "clutter-random", "novel-random", "report",
    ]  # fmt: skip
    order = list(found)
    assert all(order.index(need) < order.index(stage.name) for stage in found.values() for need in stage.needs)
    data = "generate --scenes 512 --views 8 --seed 1 --task simple --size 192 --demonstrations true --out data/grasps"
    assert set(data.split()) <= set(found["data-grasps"].command)
    trial = "evaluate --task novel --method runs/mv3_grasp-laptop/model --scenes 180 --seed 200 --size 192"
    trial += " --objects /ycb --out results/novel-mv3.jsonl"
    assert found["novel-mv3"].command == tuple(trial.split())
    assert found["report"].command[1:5] == (
        "MV3=results/simple-mv3.jsonl", "MV3=results/clutter-mv3.jsonl", "MV3=results/novel-mv3.jsonl",
        "MV3#1=results/simple-mv3-seed1.jsonl",
    )  # fmt: skip
    assert "random=results/simple-random.jsonl" in found["report"].command


def config_of(stage: Stage, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    capsys.readouterr()
    with pytest.raises(SystemExit):
        cli.main([*stage.command, *stage.options, "--print_config"])
    return yaml.safe_load(capsys.readouterr().out)


def test_trainings_are_the_configs_with_what_sets_them_apart(
    stages: Callable[..., dict[str, Stage]], capsys: pytest.CaptureFixture[str]
) -> None:
    found = stages("mv3", "no3", seeds=2)
    probe, model = config_of(found["no3-rate-3"], capsys), "model"
    arguments = probe[model]["init_args"]
    assert (arguments["learning_rate"], arguments["encoder_learning_rate"]) == pytest.approx((3e-3, 1.5e-3))
    assert arguments["schedule"] == {"warmup_steps": 20, "decay": "cosine", "decay_steps": 300, "factor": 0.1}
    assert probe["trainer"]["max_steps"] == probe["trainer"]["val_check_interval"] == 300
    assert probe["trainer"]["default_root_dir"] == "runs/no3_grasp-laptop-rate-3" == found["no3-rate-3"].run
    assert found["no3-head"].rivals[2] is found["no3-rate-3"]
    seed = config_of(found["mv3-head-seed1"], capsys)
    assert seed[model]["init_args"]["seed"] == seed["data"]["init_args"]["seed"] == 1
    assert seed[model]["init_args"]["backbone"] == f"{found['mv3-backbone'].run}/model"
    assert seed["trainer"]["logger"]["class_path"].endswith("CSVLogger")


def test_shipped_models_need_no_training(stages: Callable[..., dict[str, Stage]]) -> None:
    found = stages("mv3", "mine=mv1-laptop", evaluate_only=True)
    assert list(found) == ["simple-mv3", "clutter-mv3", "simple-mine", "clutter-mine", "report"]
    assert found["simple-mv3"].command[3:5] == ("--method", "mv3-laptop")


def test_what_does_not_exist_is_told_before_anything_starts(
    stages: Callable[..., dict[str, Stage]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="unknown method 'mv33': did you mean 'mv3'"):
        stages("mv3", "mv33")
    with pytest.raises(UserError, match="unknown method 'randm': did you mean 'random'"):
        stages("randm")
    with pytest.raises(UserError, match="unknown method .*'mv3-latpop'"):
        stages("mine=mv3-latpop")
    with pytest.raises(UserError, match="a name is of letters"):
        stages("a/b=mv3-laptop")
    with pytest.raises(UserError, match="stage simple-mv3-seed1 is there twice"):
        stages("mv3", "MV3-seed1=oracle", seeds=2)
    monkeypatch.setitem(recipe.LEARNED, "tt", Learned("TT", "mv3_grap"))
    with pytest.raises(UserError, match="unknown config 'mv3_grap.yaml': did you mean 'mv3_grasp.yaml'"):
        stages("tt")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("methods", "evaluate_only", "message"),
    [
        (["random", "random"], False, "random and random are both called random"),
        (["Random=oracle", "random"], False, "Random=oracle and random are both called Random: give one another name"),
        (["mv3", "MV3=mv1-laptop"], False, "mv3 and MV3=mv1-laptop are both called MV3"),
        (["mv3", "mine=mv3-laptop"], True, "mv3 and mine=mv3-laptop are the same model: give one of them"),
        (["random", "mine=random"], False, "random and mine=random are the same model"),
    ],
)
def test_what_the_report_would_refuse_is_refused_before_anything_starts(
    methods: list[str], evaluate_only: bool, message: str, stages: Callable[..., dict[str, Stage]]
) -> None:
    with pytest.raises(UserError, match=message):
        stages(*methods, evaluate_only=evaluate_only)


def test_a_row_may_search_by_a_schedule_of_its_own(stages: Callable[..., dict[str, Stage]]) -> None:
    found = stages("mv3", "MV3-alone=mv3-laptop@alone", evaluate_only=True)
    assert "--strategy" not in found["simple-mv3"].command
    command = found["simple-MV3-alone"].command
    assert command[command.index("--method") + 1] == "mv3-laptop"
    assert command[command.index("--strategy") + 1] == "alone"
    with pytest.raises(UserError, match="unknown strategy 'alon': did you mean 'alone'"):
        stages("a=mv3-laptop@alon")
    with pytest.raises(UserError, match="method 'random' has no option 'strategy'"):
        stages("a=random@alone")
    with pytest.raises(UserError, match="are the same model"):
        stages("a=mv3-laptop@alone", "b=mv3-laptop@alone")


def test_a_copy_of_a_model_is_the_same_model(stages: Callable[..., dict[str, Stage]], tmp_path: Path) -> None:
    shutil.copytree(find_model("mv1-laptop"), tmp_path / "copy")
    with pytest.raises(UserError, match="are the same model"):
        stages("a=mv1-laptop", f"b={tmp_path / 'copy'}")
    assert "simple-b" in stages("mv3", f"b={tmp_path / 'copy'}"), "what will be trained is not known yet"


def test_a_training_knows_what_its_configs_say(stages: Callable[..., dict[str, Stage]], tmp_path: Path) -> None:
    before = stages("mv3", "random")
    assert before["simple-random"].config is None
    here = tmp_path / "laptop" / "mv3.yaml"
    here.parent.mkdir()
    text = find_config("laptop/mv3.yaml").read_text()
    here.write_text(f"# A remark changes nothing.\n{text}")
    assert stages("mv3", "random") == before
    changed = yaml.safe_load(text)
    changed["trainer"]["max_steps"] += 1
    here.write_text(yaml.safe_dump(changed))
    after = stages("mv3", "random")
    assert after["mv3-backbone"].command == before["mv3-backbone"].command
    assert after["mv3-backbone"].config != before["mv3-backbone"].config
    assert after["mv3-head"].config == before["mv3-head"].config
