r"""What each choice in Ψ's recipe is worth: the same config, changed in one thing, after the same number of steps.

    python benchmarks/head_ablation.py --configs '[mv3_grasp.yaml, laptop/mv3_grasp.yaml]' \
        --base model.backbone=mv3-laptop --steps 750 --scenes 24 --out head.jsonl \
        --variants '["", "model.symmetric=false", "model.loss=binary", "data.negatives={uniform: 88, near: 8}"]'

Each variant is a readout of its own on the frozen backbone, trained from the same start with the learning rates falling
to zero. The image features of the training views are made once and shared, so that a variant's processor time is that
of its steps. It is measured on one set of poses in held-out scenes, those that the unchanged config draws, whatever
negatives or loss the variant itself has; and in physics, by the best grasp that the search `guided` finds in simple
scenes of the tuning seed, judged by Ψ alone and with feasibility.

A variant whose loss is `binary` may have a softmax loss of any size: of it, look at what does not depend on a scale.
"""

import json
import statistics
import time
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ablation import change, train
from jsonargparse import auto_cli
from proposals import observed, propose, tried
from search import TUNING_SEED
from torch import Tensor
from torch.utils.data import default_collate
from tqdm import tqdm

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.commands.configs import read_configs
from nerfgrasp.commands.fit import make_set
from nerfgrasp.commands.parsing import call
from nerfgrasp.data.grasps import GraspBatch, GraspData
from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.views import read_views
from nerfgrasp.methods.psi import Psi
from nerfgrasp.models.folder import load_backbone, save_model
from nerfgrasp.sim.tasks import find_task
from nerfgrasp.training import GraspValueTraining
from nerfgrasp.training.features import FeatureCache
from nerfgrasp.training.grasp_value import grasp_loss

JUDGES = ("alone", "weighed")
"""Ψ alone, and with feasibility."""


def main(
    configs: list[Path],
    variants: list[str],
    base: str = "",
    steps: int = 750,
    scenes: int = 24,
    threads: int = 1,
    models: Path | None = None,
    out: Path | None = None,
) -> None:
    """Trains and measures variants, and prints one line for each.

    Args:
        configs: laid over each other as `nerfgrasp fit` does; files, or names of the project's own.
        variants: changes as `key=value`, several with blanks between; `model.` and `data.` stand for their `init_args`.
            A whole mapping takes the place of the config's, e.g. `data.negatives={uniform: 88, near: 8}`.
        base: changes to all variants, and to what they are measured on.
        steps: of each training; its schedule is not asked.
        scenes: simple scenes of the tuning seed in which the search is tried; none if 0.
        threads: of torch.
        models: a folder that keeps the variants as model folders, by their number.
        out: JSON lines, one a variant.
    """
    keep_freed_memory()
    torch.set_num_threads(threads)
    config = change(read_configs(configs), base)
    changed = [change(config, variant) for variant in variants]
    _, common = build(config)
    common.setup("validate")
    built = [build(one) for one in changed]
    for number, (variant, one, (training, data)) in enumerate(zip(variants, changed, built, strict=True)):
        if training.frozen:
            training.features = features(one["model"]["init_args"]["backbone"], data.train_set.folder)
        row = measure(training, data, common, steps, scenes)
        print("\n".join(summary(variant, row)), flush=True)
        if models is not None:
            save_model(models / str(number), training.network)
        if out is not None:
            with out.open("a") as file:
                file.write(json.dumps({"variant": variant, "base": base, "steps": steps, **row}) + "\n")


def build(config: dict[str, Any]) -> tuple[GraspValueTraining, GraspData]:
    """Returns a config's training and its data, whose sets are there.

    Raises:
        UserError: a key is unknown, a value of another type, or a set does not fit.
    """
    given = [f"--{part}={json.dumps(config[part])}" for part in ("model", "data")]
    training, data = call(together, given, prog="head_ablation")
    data.check()
    for scenes in data.sets():
        make_set(scenes)
    return training, data


def together(model: GraspValueTraining, data: GraspData) -> tuple[GraspValueTraining, GraspData]:
    """Returns what its arguments are parsed to."""
    return model, data


def measure(
    training: GraspValueTraining, data: GraspData, common: GraspData, steps: int, scenes: int
) -> dict[str, Any]:
    """Trains one variant, and returns what it reaches on the held-out poses of `common` and in physics."""
    data.setup("fit")

    def loss(batch: GraspBatch, step: int) -> Tensor:
        return grasp_loss(training.training_values(batch), training.loss)

    start = time.process_time()
    train(training, data, loss, lambda step: step / steps)
    seconds = time.process_time() - start
    row: dict[str, Any] = {"process_s": seconds, **held_out(training.eval(), common)}
    method = Psi(training.network)
    row["scenes"] = [try_scene(method, scene) for scene in tqdm(range(scenes), desc="scenes", leave=False)]
    return row


@lru_cache(maxsize=1)
def features(backbone: str, folder: Path) -> FeatureCache:
    """Returns the features of all views of a packed set, by a backbone."""
    scenes, cache = PackedScenes(folder), FeatureCache(load_backbone(backbone))
    view = np.arange(scenes.settings.views)
    for scene in tqdm(range(len(scenes)), desc="features", leave=False):
        batch = GraspBatch(torch.tensor(scene), torch.from_numpy(view), read_views(scenes, scene, view), torch.eye(4))
        cache(default_collate([batch]))
    return cache


@torch.inference_mode()
def held_out(training: GraspValueTraining, data: GraspData) -> dict[str, float]:
    """Returns means over held-out scenes, each with its own fixed poses.

    `loss`: −log softmax of the demonstrated grasp. `top1`: how often it is valued highest. `below`: the share of the
    other poses that are valued lower, which does not depend on a scale either.
    """
    values = [training.values(batch) for batch in data.val_dataloader()]
    return {
        "loss": statistics.mean(float(grasp_loss(one, "softmax")) for one in values),
        "top1": statistics.mean(float(one.argmax() == 0) for one in values),
        "below": statistics.mean(float((one[0, 1:] < one[0, 0]).float().mean()) for one in values),
    }


def try_scene(method: Psi, index: int) -> dict[str, Any]:
    """Returns what becomes of the best grasps in one tuning scene, by judge."""
    truth = find_task("simple").draw(TUNING_SEED, index)
    found = propose(method, observed(method, truth), truth)
    return {judge: tried(truth, getattr(found, judge)) for judge in JUDGES}


def summary(variant: str, row: dict[str, Any]) -> list[str]:
    """Returns the lines of one variant."""
    shares = f"first {100 * row['top1']:.0f} %, above {100 * row['below']:.1f} % of the poses"
    lines = [
        variant or "as configured",
        f"  held out: loss {row['loss']:.3f}, {shares}; {row['process_s']:.0f} s of processor time",
    ]
    if row["scenes"]:
        lines += [f"  {judge:<8} {_physics([scene[judge] for scene in row['scenes']])}" for judge in JUDGES]
    return lines


def _physics(tries: Sequence[dict[str, Any]]) -> str:
    medians = [
        statistics.median(known) if (known := [one[key] for one in tries if one[key] is not None]) else float("nan")
        for key in ("distance_mm", "angle_deg")
    ]
    successes = sum(one["success"] for one in tries)
    return f"{successes} of {len(tries)} succeed; medians {medians[0]:.1f} mm, {medians[1]:.1f}°"


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
