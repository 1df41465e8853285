r"""What each choice in a backbone's recipe is worth: the same config, changed in one thing, after the same minutes.

    python benchmarks/ablation.py --configs '[mv3.yaml, laptop/mv3.yaml]' --minutes 7 \
        --variants '["", "model.network.fine.blend=0", "data.scenes_per_step=4 data.rays_per_scene=96"]'

Each variant trains from scratch on one thread for so many minutes of processor time, which other processes disturb less
than wall time, with the learning rates falling to zero over them. It is measured on the object pixels of unseen views
of held-out scenes (`benchmarks/backbone.py`, another seed than the reported one).
"""

import copy
import json
import math
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from backbone import network_scores
from joblib import Parallel, delayed
from jsonargparse import auto_cli
from torch import Tensor

from configs import network_config
from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.commands.configs import read_configs
from nerfgrasp.commands.fit import make_set
from nerfgrasp.data.rays import RayBatch, RayData
from nerfgrasp.data.streams import SceneSet, StepDataModule
from nerfgrasp.models import MVNeRF
from nerfgrasp.sim.tasks import find_task
from nerfgrasp.training import MVNeRFTraining
from nerfgrasp.training.module import ScheduledTraining

HELD_OUT_SEED = 3
WARM_UP = 0.04
"""Share of a training in which the rates rise."""


def main(
    configs: list[Path],
    variants: list[str],
    minutes: float = 7.0,
    scenes: int = 16,
    workers: int = 1,
    out: Path | None = None,
) -> None:
    """Trains and measures variants, and prints one line for each.

    Args:
        configs: laid over each other as `nerfgrasp fit` does; files, or names of the project's own.
        variants: changes as `key=value`, several with blanks between; `model.` and `data.` stand for their `init_args`.
        minutes: of processor time for each.
        scenes: held-out scenes.
        workers: variants trained at once.
        out: JSON lines, one a variant.
    """
    config = read_configs(configs)
    changed = [change(config, variant) for variant in variants]
    for one in changed:
        for name in ("train", "validation"):
            make_set(SceneSet(**one["data"]["init_args"][name]))
    jobs = (delayed(measure)(one, minutes, scenes) for one in changed)
    rows = Parallel(n_jobs=workers, return_as="generator")(jobs)
    for variant, row in zip(variants, rows, strict=True):
        print(f"{row['psnr_objects']:7.2f} dB  {row['steps']:5d} steps  {variant or 'as configured'}", flush=True)
        if out is not None:
            with out.open("a") as file:
                file.write(json.dumps({"variant": variant, "minutes": minutes, **row}) + "\n")


def change(config: dict[str, Any], variant: str) -> dict[str, Any]:
    """Returns a config with some of its values changed."""
    changed = copy.deepcopy(config)
    for entry in filter(None, re.split(r"\s+(?=[\w.]+=)", variant.strip())):
        path, value = entry.split("=", 1)
        first, *keys = path.split(".")
        place = changed[first]["init_args"]
        for key in keys[:-1]:
            place = place.setdefault(key, {})
        place[keys[-1]] = yaml.safe_load(value)
    return changed


def measure(config: dict[str, Any], minutes: float, scenes: int) -> dict[str, float | int]:
    """Trains one variant and returns its score and the number of its steps."""
    keep_freed_memory()
    torch.set_num_threads(1)
    model, data = config["model"]["init_args"], dict(config["data"]["init_args"])
    sets = {name: SceneSet(**data.pop(name)) for name in ("train", "validation")}
    rays = RayData(**sets, **{**data, "workers": 0})
    rays.setup("fit")
    rates = {name: model[name] for name in ("learning_rate", "encoder_learning_rate") if name in model}
    training = MVNeRFTraining(network_config(config), **rates)

    def loss(batch: RayBatch, step: int) -> Tensor:
        coarse, fine = training.errors(batch, torch.Generator().manual_seed(step))
        return coarse + fine

    start = time.process_time()
    steps = train(training, rays, loss, lambda _: (time.process_time() - start) / (60 * minutes))
    network = training.network.eval()
    return {"psnr_objects": score(network, scenes), "steps": steps}


def train(
    training: ScheduledTraining,
    data: StepDataModule,
    loss: Callable[[Any, int], Tensor],
    spent: Callable[[int], float],
) -> int:
    """Trains until all is spent, and returns the number of steps; the rates fall to zero over what there is to spend.

    Args:
        training: gives the optimizer; its own schedule is not asked.
        data: draws the batches.
        loss: of a batch and the step's number.
        spent: the share that is spent before a step.
    """
    optimizer = training.configure_optimizers()["optimizer"]  # type: ignore[index, call-overload]
    rates = [group["initial_lr"] for group in optimizer.param_groups]
    step = 0
    while (share := spent(step)) < 1:
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * min(1.0, share / WARM_UP) * 0.5 * (1 + math.cos(math.pi * share))
        batch = data.draw(np.random.default_rng((data.seed, step)))
        optimizer.zero_grad()
        loss(batch, step).backward()
        optimizer.step()
        step += 1
    return step


def score(network: MVNeRF, scenes: int) -> float:
    """Returns the mean PSNR over the objects of held-out scenes' unseen views, in dB."""
    task = find_task("simple")
    found = [network_scores(network, task.draw(HELD_OUT_SEED, i), None, 0)["psnr_objects"] for i in range(scenes)]
    return float(np.mean([score for scores in found for score in scores]))


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
