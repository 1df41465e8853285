"""The paper's table as a list of stages: data, backbones, heads, baselines, evaluation, report."""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

from nerfgrasp import registry
from nerfgrasp.commands.configs import read_configs
from nerfgrasp.commands.stages import Stage
from nerfgrasp.errors import UserError, unknown_name
from nerfgrasp.methods.loading import find_method, load_method, method_hash
from nerfgrasp.models.folder import shipped_models

Scale = Literal["laptop", "paper"]
SCENE_SEED = 200
"""Of the scenes that every method is tried in: no training set has it, and no setting was chosen in them."""
SIZES: dict[str, int] = {"laptop": 192, "paper": 480}
"""The pictures' side in pixels, as in training."""
PROBE = 10
"""A short training has one of so many steps."""
TABLE = "table.md"
"""The report."""


@dataclass(frozen=True)
class Learned:
    """A method that the table trains itself; configs by their names, less `.yaml`."""

    label: str
    """What it is called in the table."""
    head: str
    """The config whose run gives the method's model."""
    backbone: str | None = None
    """The config of the pretraining before it."""
    rates: tuple[float, ...] = ()
    """Factors on the config's learning rates, each tried in a short training; the best is taken."""
    repeated: bool = False
    """Whether the head is trained anew with other seeds, to see what the seed does."""


LEARNED = {
    "mv3": Learned("MV3", "mv3_grasp", backbone="mv3", repeated=True),
    "mv1": Learned("MV1", "mv1_grasp", backbone="mv1", repeated=True),
    "no3": Learned("NO3", "no3_grasp", rates=(0.3, 1.0, 3.0)),
    "no1": Learned("NO1", "no1_grasp", rates=(0.3, 1.0, 3.0)),
    "tn": Learned("TN", "tn"),
}
"""The paper's methods."""


@dataclass(frozen=True)
class Experiment:
    """What the table is to hold."""

    folder: Path
    """Where everything is made: `data`, `runs`, `results`, the table."""
    methods: tuple[str, ...]
    """Names out of `LEARNED`, registered methods, `NAME=MODEL`, or `NAME=MODEL@SCHEDULE`."""
    scale: Scale
    """Of the configs."""
    evaluate_only: bool
    """Whether the shipped models are taken, `mv3-laptop` and its like, instead of training; they must be there."""
    scenes: int
    """Of the task `simple`."""
    clutter_scenes: int
    """Of the task `clutter`."""
    novel_scenes: int
    """Of the task `novel`."""
    objects: Path | None
    """The folder of its objects."""
    seeds: int
    """Trainings of each head that is repeated; all but the first are tried in the task `simple` alone."""


def shipped_name(name: str, scale: Scale) -> str:
    """Returns the name of the model of one of `LEARNED` that comes with the package, if it does."""
    return f"{name}-{scale}"


def not_shipped(methods: Iterable[str], scale: Scale) -> list[str]:
    """Returns those out of `methods` that are of `LEARNED` and have no model that comes with the package."""
    shipped = shipped_models()
    return [name for name in methods if name in LEARNED and shipped_name(name, scale) not in shipped]


def table_stages(experiment: Experiment) -> list[Stage]:
    """Returns the stages in an order in which they can be done, each method's trials right after its training.

    Raises:
        UserError: a method or a config does not exist, or the report could not tell two rows from each other.
    """
    rows = [_row(experiment, name) for name in experiment.methods]
    _check_rows(rows)
    stages: list[Stage] = []
    for row in rows:
        if row.model is None:
            made = {stage.name for stage in stages}
            stages += [stage for stage in _training(experiment, row, LEARNED[row.name]) if stage.name not in made]
        else:
            stages += _trials(experiment, row)
    # Files are named by them, and on some disks a name is the same in capitals.
    names = [stage.name.lower() for stage in stages]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UserError(f"methods: {' '.join(experiment.methods)}: stage {twice} is there twice")
    return [*stages, _report(stages)]


@dataclass(frozen=True)
class _Row:
    """One of the methods asked for, or a training of it with another seed."""

    name: str
    """As it was asked for."""
    key: str
    """What its stages and files are called."""
    label: str
    """What it is called in the table."""
    model: str | None = None
    """What `evaluate` takes; None if it is trained first."""
    strategy: str | None = None
    """The search strategy; None for the method's own."""


def _row(experiment: Experiment, name: str) -> _Row:
    learned = LEARNED.get(name)
    if learned is None:
        return _other(name)
    return _Row(name, name, learned.label, shipped_name(name, experiment.scale) if experiment.evaluate_only else None)


def _check_rows(rows: list[_Row]) -> None:
    """Refuses what the report would refuse once everything has been run: one name for two, or one model twice."""
    for one, other in combinations(rows, 2):
        if one.label.lower() == other.label.lower():
            raise UserError(f"methods: {one.name} and {other.name} are both called {one.label}: give one another name")
    known: dict[tuple[str | None, ...], str] = {}
    for row in rows:
        if row.model is not None:
            spec = find_method(row.model, strategy=row.strategy)
            identity = spec.name, method_hash(load_method(spec)), row.strategy
            if identity in known:
                raise UserError(f"methods: {known[identity]} and {row.name} are the same model: give one of them")
            known[identity] = row.name


def _other(name: str) -> _Row:
    """Returns the row of a method that the table does not train."""
    label, separator, model = name.partition("=")
    if separator:
        if re.fullmatch(r"[\w.+-]+", label) is None:
            raise UserError(f"methods: {name}: a name is of letters, digits and any of . + - _")
        strategy = None
        if not Path(model).is_dir() and "@" in model:
            model, _, strategy = model.rpartition("@")
        find_method(model)
        return _Row(name, label, label, str(Path(model).resolve()) if Path(model).is_dir() else model, strategy)
    registered = registry.names(registry.BASELINES)
    if name not in registered:
        raise unknown_name("method", name, [*LEARNED, *registered])
    return _Row(name, name, name, name)


def _training(experiment: Experiment, row: _Row, learned: Learned) -> Iterator[Stage]:
    name = row.key
    needs: tuple[str, ...] = ()
    if learned.backbone is not None:
        backbone = _fit(experiment, f"{name}-backbone", learned.backbone)
        yield from _data(experiment, learned.backbone)
        yield backbone
        needs = (backbone.name,)
    yield from _data(experiment, learned.head)
    probes = tuple(_probes(experiment, name, learned))
    yield from probes
    head = _fit(experiment, f"{name}-head", learned.head, needs=needs, rivals=probes)
    yield head
    yield from _trials(experiment, replace(row, model=f"{head.run}/model"), head.name)
    for seed in range(1, experiment.seeds if learned.repeated else 1):
        run = f"{head.run}-seed{seed}"
        options = ("--model.init_args.seed", str(seed), "--data.init_args.seed", str(seed))
        fit = _fit(experiment, f"{name}-head-seed{seed}", learned.head, run, options, needs)
        yield fit
        again = _Row(row.name, f"{name}-seed{seed}", f"{row.label}#{seed}", f"{run}/model")
        yield _trial(experiment, again, "simple", experiment.scenes, fit.name)


def _probes(experiment: Experiment, name: str, learned: Learned) -> Iterator[Stage]:
    """Yields a training of few steps for each factor on the learning rates."""
    if not learned.rates:
        return
    config = _config(experiment, learned.head)
    model, run = config["model"]["init_args"], config["trainer"]["default_root_dir"]
    steps = str(config["trainer"]["max_steps"] // PROBE)
    warm_up = str(model["schedule"]["warmup_steps"] // PROBE)
    shorter = [f"--trainer.{key}" for key in ("max_steps", "val_check_interval")]
    short = [part for option in (*shorter, "--model.init_args.schedule.decay_steps") for part in (option, steps)]
    short += ["--model.init_args.schedule.warmup_steps", warm_up]
    for factor in learned.rates:
        rates = {key: model[key] * factor for key in ("learning_rate", "encoder_learning_rate")}
        options = tuple(part for key, rate in rates.items() for part in (f"--model.init_args.{key}", f"{rate:.3g}"))
        probe = f"{name}-rate-{factor:g}"
        yield _fit(experiment, probe, learned.head, f"{run}-rate-{factor:g}", (*short, *options), options=options)


def _fit(
    experiment: Experiment,
    name: str,
    config: str,
    run: str | None = None,
    changes: tuple[str, ...] = (),
    needs: tuple[str, ...] = (),
    **more: Any,
) -> Stage:
    """Returns the stage of a training, whose losses and scores are kept as CSV."""
    folder = run or str(_config(experiment, config)["trainer"]["default_root_dir"])
    files = [part for file in _files(experiment, config) for part in ("--config", file)]
    logger = ["--trainer.logger", "CSVLogger", "--trainer.logger.save_dir", folder]
    moved = [] if run is None else ["--trainer.default_root_dir", run]
    sets = tuple(stage.name for stage in _data(experiment, config))
    command = ("fit", *files, *logger, *moved, *changes)
    return Stage(name, command, (*needs, *sets), folder, config=_config_hash(experiment, config), **more)


def _data(experiment: Experiment, config: str) -> list[Stage]:
    """Returns the stages of the data sets that a config asks for."""
    from nerfgrasp.data.streams import SceneSet

    init = _config(experiment, config).get("data", {}).get("init_args", {})
    stages = []
    for entry in (init[name] for name in ("train", "validation") if isinstance(init.get(name), dict)):
        settings = asdict(SceneSet(**entry))
        folder = Path(settings.pop("folder"))
        options = [part for key, value in settings.items() for part in (f"--{key}", str(value).lower())]
        stages.append(Stage(f"data-{folder.name}", ("generate", *options, "--out", str(folder))))
    return stages


def _trials(experiment: Experiment, row: _Row, *needs: str) -> list[Stage]:
    counts = {
        "simple": experiment.scenes,
        "clutter": experiment.clutter_scenes,
        "novel": experiment.novel_scenes,
    }
    return [_trial(experiment, row, task, count, *needs) for task, count in counts.items() if count > 0]


def _trial(experiment: Experiment, row: _Row, task: str, count: int, *needs: str) -> Stage:
    options = {"task": task, "method": row.model, "scenes": count, "seed": SCENE_SEED, "size": SIZES[experiment.scale]}
    if row.strategy is not None:
        options["strategy"] = row.strategy
    if task == "novel" and experiment.objects is not None:
        options["objects"] = str(experiment.objects)
    options["out"] = f"results/{task}-{row.key}.jsonl"
    command = ("evaluate", *(part for name, value in options.items() for part in (f"--{name}", str(value))))
    return Stage(f"{task}-{row.key}", command, needs, gives=f"{row.label}={options['out']}")


def _report(stages: list[Stage]) -> Stage:
    trials = [stage for stage in stages if stage.gives]
    command = ("report", *(stage.gives for stage in trials), "--paper", "true", "--format", "markdown", "--out", TABLE)
    return Stage("report", command, tuple(stage.name for stage in trials), again=True)


def _files(experiment: Experiment, config: str) -> list[str]:
    """Returns a config at the paper's scale and, laid over it, the one at the experiment's."""
    return [f"{config}.yaml", *([f"{experiment.scale}/{config}.yaml"] if experiment.scale != "paper" else [])]


def _config(experiment: Experiment, config: str) -> dict[str, Any]:
    return read_configs(_files(experiment, config), experiment.folder)


def _config_hash(experiment: Experiment, config: str) -> str:
    """Returns 16 hexadecimal digits of the SHA-256 of what a config says, however it is written down."""
    text = json.dumps(_config(experiment, config), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
