"""`nerfgrasp fit | validate | test`: LightningCLI, with shipped configs by name and data sets made on demand."""

import os
import sys
import warnings
import zipfile
from pathlib import Path
from typing import Any, Literal

import torch
from jsonargparse import ActionConfigFile
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.plugins.io import TorchCheckpointIO

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.commands.configs import shipped_configs
from nerfgrasp.commands.parsing import OneLineErrors
from nerfgrasp.data.streams import SceneSet, StepDataModule
from nerfgrasp.errors import UserError
from nerfgrasp.models.folder import save_model
from nerfgrasp.models.stored import StoredModule
from nerfgrasp.training.callbacks import ExpectedTime, ExponentialAverage, RayRate, StopOnNotFinite
from nerfgrasp.training.checkpoints import BestCheckpoint, StepCheckpoint, WholeCheckpoints
from nerfgrasp.training.module import ScheduledTraining
from nerfgrasp.viz.held_out import HeldOutRenders

MODEL_FOLDER = "model"
"""Where under a run's folder the trained model is written."""
CHECKPOINT_FOLDER = "checkpoints"
"""Where under it the checkpoints are: the same place for a run that is resumed, so that `last` finds its own."""
CHECKPOINT_WORDS = ("best", "last", "hpc")
"""What `--ckpt_path` may say other than a file's name."""


class Parser(OneLineErrors, LightningArgumentParser):
    """LightningCLI's parser with one-line errors."""


class Command(LightningCLI):
    """LightningCLI with a checkpoint callback, data sets made on demand, and a model folder at the end."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Adds the checkpoint callback, configured under `checkpoint`, and what is to become of the weights."""
        what = "decay of an exponential moving average of the weights, which is then the result; e.g. 0.999"
        parser.add_argument("--ema_decay", type=float | None, default=None, help=what)
        what = "which weights are the result: those of the last step, or those of the best validation"
        parser.add_argument("--keep", type=Literal["last", "best"], default="last", help=what)
        parser.add_lightning_class_args(StepCheckpoint, "checkpoint")
        # A checkpoint every few minutes, the newest kept: a killed run goes on with --ckpt_path last.
        parser.set_defaults({"checkpoint.every_n_train_steps": 500, "checkpoint.save_last": True})

    def init_parser(self, **kwargs: Any) -> Parser:
        """Returns the parser of one verb."""
        parser = Parser(**kwargs)
        parser.add_argument("-c", "--config", action=ActionConfigFile, help="a config; may be repeated")
        return parser

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parses, and refuses a checkpoint that cannot be read."""
        super().parse_arguments(parser, args)
        _check_checkpoint(self.config[self.config["subcommand"]].get("ckpt_path"))

    def before_instantiate_classes(self) -> None:
        """Puts the checkpoints into the run's folder, if the config says nothing else."""
        config = self.config[str(self.subcommand)]
        if config["checkpoint"]["dirpath"] is None and config["trainer"]["default_root_dir"] is not None:
            config["checkpoint"]["dirpath"] = str(Path(config["trainer"]["default_root_dir"]) / CHECKPOINT_FOLDER)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Builds the trainer, with an average of the weights and the best of them if the config asks for it."""
        config = self.config_init[str(self.subcommand)]
        if config["ema_decay"] is not None:
            self.trainer_defaults["callbacks"].append(ExponentialAverage(config["ema_decay"]))
        if config["keep"] == "best":
            self.trainer_defaults["callbacks"].append(self._best_checkpoint(config["checkpoint"].dirpath))
        trainer = super().instantiate_trainer(**kwargs)
        if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:
            trainer.strategy.checkpoint_io = WholeCheckpoints()
        return trainer

    def before_fit(self) -> None:
        """Says what is to come, and makes the data sets that are not there."""
        if self._best() is not None:
            _check_validated(self.trainer)
        self._prepare("fit")

    def before_validate(self) -> None:
        """Makes the data set if it is not there."""
        self._prepare("validate")

    before_test = before_validate

    def after_fit(self) -> None:
        """Writes the model folder."""
        if self.trainer.interrupted or not self.trainer.is_global_zero:
            return
        best = self._best()
        if best is not None:
            self.model.load_state_dict(best.weights())
        folder = Path(self.trainer.default_root_dir) / MODEL_FOLDER
        save_model(folder, self.model.network)
        which = "" if best is None else f", as it was where {best.monitor} was best ({best.best_model_score:.4g})"
        print(f"the model is in {folder}{which}")

    def _best_checkpoint(self, folder: str) -> BestCheckpoint:
        if not isinstance(self.model, ScheduledTraining):
            raise UserError(f"keep is best, but {type(self.model).__name__} does not say by what measure")
        return BestCheckpoint(folder, *self.model.best_by)

    def _best(self) -> BestCheckpoint | None:
        return next((one for one in self.trainer.checkpoint_callbacks if isinstance(one, BestCheckpoint)), None)

    def _prepare(self, stage: str) -> None:
        _check_inputs(self.model, self.datamodule)
        sets: list[SceneSet] = []
        if isinstance(self.datamodule, StepDataModule):
            self.datamodule.check(stage)
            sets = self.datamodule.sets(stage)
        if stage == "fit":
            gigabytes = sum(_image_bytes(scenes) for scenes in sets) / 1e9
            where = f"the run's folder is {self.trainer.default_root_dir}"
            print(f"{self.trainer.max_steps} steps; data of {gigabytes:.2g} GB; {where}", flush=True)
            _check_memory(self.model, self.datamodule, self.trainer)
        for scenes in sets:
            make_set(scenes)


def main(verb: str, args: list[str]) -> None:
    """Runs `fit`, `validate` or `test` with LightningCLI's arguments.

    Raises:
        UserError: a config is not found or does not fit, or a data set cannot be made.
        KeyboardInterrupt: the user ended it.
    """
    keep_freed_memory()
    warnings.filterwarnings("ignore", message="LightningCLI's args parameter")
    warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")  # a resumed run's
    # An average's own state is of no use there, and the checkpoint's weights are the average.
    warnings.filterwarnings("ignore", message="You're using the WeightAveraging callback, but loading a checkpoint")
    warnings.filterwarnings("ignore", message="Found .* in eval mode at the start")  # a frozen backbone's
    try:
        Command(
            args=[verb, *shipped_configs(args)],
            seed_everything_default=0,
            save_config_kwargs={"overwrite": True},
            parser_kwargs={name: {"prog": f"nerfgrasp {name}"} for name in ("fit", "validate", "test")},
            trainer_defaults={
                "callbacks": [
                    StopOnNotFinite(),
                    ExpectedTime(),
                    RayRate(),
                    HeldOutRenders(),
                    TQDMProgressBar(refresh_rate=10),
                ],
                "check_val_every_n_epoch": None,
                "num_sanity_val_steps": 0,
            },
        )
    except SystemExit as done:
        # The Trainer tidies up after an interrupt and then exits as if something had failed.
        if isinstance(done.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from done
        raise
    except ValueError as error:
        # jsonargparse turns what a class's constructor says into a list of what it tried.
        mistake = _user_mistake(error)
        if mistake is None:
            raise
        raise mistake from None


def _check_inputs(module: LightningModule, data: Any) -> None:
    """Refuses a network that no model folder could hold, and data that it does not take."""
    network = getattr(module, "network", None)
    if not isinstance(network, StoredModule):
        raise UserError(f"model: {type(module).__name__} has no `network` that a model folder can hold")
    backbone = getattr(network.config, "backbone", network.config)
    views, size = getattr(backbone, "views", None), getattr(backbone, "image_size", None)
    if views is not None and getattr(data, "views", views) != views:
        raise UserError(f"data.init_args.views is {data.views}, but the network sees {views} views")
    asked = getattr(data, "image_size", None)
    if asked not in (None, size):
        raise UserError(f"data.init_args.image_size is {asked}, but the network's is {size}")


def _check_validated(trainer: Trainer) -> None:
    """Refuses a training that ends before its first validation."""
    interval, steps = trainer.val_check_interval, trainer.max_steps
    if isinstance(interval, int) and interval > steps > 0:
        raise UserError(f"keep is best, but trainer.val_check_interval ({interval}) is more than max_steps ({steps})")


def _check_memory(module: LightningModule, data: Any, trainer: Trainer) -> None:
    """Says how much memory image features will take, and refuses more than there is."""
    if not isinstance(module, ScheduledTraining):
        return
    batches = trainer.max_steps * trainer.accumulate_grad_batches
    device = trainer.strategy.root_device
    processes = 1 if device.type == "cuda" else trainer.num_devices
    needed = processes * module.kept_bytes(data, batches if batches > 0 else sys.maxsize) / 1e9
    there = memory_bytes(device) / 1e9 if needed else 0.0
    if needed > there:
        switch = "give --model.init_args.cache_features false: they are then made anew at every step"
        raise UserError(
            f"the views' image features take {needed:.3g} GB of memory, {device} has {there:.3g} GB: {switch}"
        )
    if needed:
        print(f"the views' image features are kept: {needed:.3g} GB of the memory of {device}", flush=True)


def memory_bytes(device: torch.device) -> int:
    """Returns how much memory a device has: a CUDA device its own, others the machine's."""
    if device.type == "cuda":
        return int(torch.cuda.get_device_properties(device).total_memory)
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _user_mistake(error: BaseException | None) -> UserError | None:
    while error is not None and not isinstance(error, UserError):
        error = error.__cause__ or error.__context__
    return error


def _check_checkpoint(name: Any) -> None:
    if name is None or name in CHECKPOINT_WORDS:
        return
    if not Path(name).is_file():
        raise UserError(f"--ckpt_path: no such file: {name} (nor is it one of {', '.join(CHECKPOINT_WORDS)})")
    if not zipfile.is_zipfile(name):
        raise UserError(f"--ckpt_path: {name} is damaged or no checkpoint")


def _image_bytes(scenes: SceneSet) -> int:
    pixel = 6 if scenes.depth else 4  # RGB, the mask and, two bytes, depth
    return pixel * scenes.scenes * scenes.views * scenes.size**2


def make_set(scenes: SceneSet) -> None:
    """Generates a data set; what is there of it stays."""
    from nerfgrasp.commands.generate import generate

    generate(
        scenes.task,
        scenes=scenes.scenes,
        views=scenes.views,
        seed=scenes.seed,
        out=Path(scenes.folder),
        size=scenes.size,
        demonstrations=scenes.demonstrations,
        depth=scenes.depth,
    )
