"""How alike Ψ and the truth are: mean rank correlations in slices through a valid grasp of held-out scenes.

    python benchmarks/slices.py --models '[RUN/mv3/model, RUN/mv1/model, RUN/mv3-scratch/model]'

draws scenes of a task from a seed kept out of every training set, one valid grasp in each, and slices through it, as
`nerfgrasp slices` shows them; in each slice Ψ is ranked against the negative grasp error. It prints the means over
scenes of Spearman's correlation for translations, rotations and mixed slices, and for each slice, and how Ψ falls off
in translations as the grasp error grows. Models after the first are compared with it scene by scene: name the
pretrained one first, then the same architecture without pretraining. With `--out` it keeps one JSON line a scene and
model.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from backbone import SEEN_VIEWS, TARGET_SIZE, pictures
from joblib import Parallel, cpu_count, delayed
from jsonargparse import auto_cli
from torch import Tensor
from tqdm import tqdm

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.evaluation.slices import (
    KINDS,
    central_grasp,
    learned_values,
    means_by_kind,
    rank_correlation,
    true_values,
)
from nerfgrasp.methods.psi import Psi
from nerfgrasp.models.folder import DEFAULT_MODEL
from nerfgrasp.scenes.oracle import valid_grasps
from nerfgrasp.scenes.scene import Observations
from nerfgrasp.scenes.slices import SLICES, Axes, cut_slice
from nerfgrasp.sim.tasks import find_task, scene_cameras, workspace

ERRORS = (0.0, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0)
"""Where ranges of the grasp error begin: 0.5 is 50 mm away, or 45°."""

Row = dict[str, dict[str, float | None]]
"""Of one scene: `slices`, the correlation in each, `means`, by kind of slice, and `below`: in translations, by the
beginning of a range of grasp errors, how far Ψ lies below its best there, in logits, on average."""


def main(
    models: tuple[str, ...] = (DEFAULT_MODEL,),
    task: str = "simple",
    scenes: int = 64,
    seed: int = 100,
    slices: tuple[str, ...] = SLICES,
    size: int = 21,
    axes: Axes = "grasp",
    reach: float | None = None,
    turn: float = 90.0,
    images: int | None = None,
    workers: int | None = None,
    out: Path | None = None,
) -> None:
    """Measures models on the same slices.

    Args:
        models: folders or shipped names of grasp values; those after the first are compared with it.
        task: what the scenes are; their objects must be prisms, of which the oracle knows the valid grasps.
        scenes: how many.
        seed: of the scenes; no training set has it.
        slices: which, as `nerfgrasp slices` names them.
        size: poses in each direction of a slice.
        axes: whose axes coordinates are along: the grasp's or the world's.
        reach: metres that translations go at most to either side; all of the workspace if not given.
        turn: degrees that rotations go to either side.
        images: how many of the three a model that sees one at a time averages over; all if not given.
        workers: processes; one a core if not given.
        out: JSON lines, one a scene and model.
    """
    settings = {"size": size, "axes": axes, "reach": reach, "turn": turn}
    found: dict[str, list[Row]] = {}
    for model in models:
        jobs = (
            delayed(scene_correlations)(model, task, seed, index, slices, settings, images) for index in range(scenes)
        )
        parallel = Parallel(n_jobs=workers or cpu_count(), return_as="generator")
        found[model] = list(tqdm(parallel(jobs), total=scenes, desc=model))
        print("\n".join(summary(model, found[model])), flush=True)
    for model in models[1:]:
        print("\n".join(differences(models[0], found[models[0]], model, found[model])), flush=True)
    if out is not None:
        shared = {"task": task, "seed": seed, **settings, "images": images}
        rows = [
            {"model": model, **shared, "scene": index, **row}
            for model, every in found.items()
            for index, row in enumerate(every)
        ]
        out.write_text("".join(json.dumps(row) + "\n" for row in rows))


def scene_correlations(
    model: str,
    task: str,
    seed: int,
    index: int,
    names: Sequence[str],
    settings: dict[str, Any],
    images: int | None = None,
) -> Row:
    """Returns one model's rank correlations in one scene."""
    keep_freed_memory()
    torch.set_num_threads(1)
    method, truth = Psi.from_pretrained(model, images=images), find_task(task).draw(seed, index)
    valid = valid_grasps(truth.objects)
    grasp, _ = central_grasp(truth, valid, workspace, seed=index)
    turned = {**settings, "turn": math.radians(settings["turn"])}
    cuts = [cut_slice(grasp, name, workspace, **turned) for name in names]
    side = method.model.backbone.config.image_size or TARGET_SIZE
    camera = scene_cameras(seed, index, SEEN_VIEWS, side)
    pixels, _ = pictures(truth, camera)
    values = learned_values(method, Observations(pixels, camera), workspace, cuts)
    true = [true_values(cut, valid) for cut in cuts]
    found = {cut.name: rank_correlation(*pair) for cut, *pair in zip(cuts, values, true, strict=True)}
    moved = [pair for cut, *pair in zip(cuts, values, true, strict=True) if cut.kind == "translation"]
    return {"slices": found, "means": dict(means_by_kind(cuts, found)), "below": falling_off(moved)}


def falling_off(pairs: Sequence[Sequence[Tensor]]) -> dict[str, float | None]:
    """Returns how far Ψ lies below its best on average, by the beginning of a range of grasp errors; None if empty.

    Args:
        pairs: Ψ and the negative grasp error of slices, `[N, N]` each, NaN outside of the workspace.
    """
    if not pairs:
        return {}
    values, true = (torch.cat([pair[side][~pair[0].isnan()] for pair in pairs]) for side in (0, 1))
    ranges = torch.bucketize(-true, torch.tensor(ERRORS[1:]).to(true), right=True)
    below = [(values.max() - values)[ranges == number] for number in range(len(ERRORS))]
    return {f"{start:g}": float(one.mean()) if len(one) else None for start, one in zip(ERRORS, below, strict=True)}


def summary(model: str, rows: Sequence[Row]) -> list[str]:
    """Returns the lines of one model's table: means over scenes."""
    lines = [f"{model}: Spearman's correlation with the negative grasp error, mean over scenes (standard error)"]
    for title, of, names in (("mean of ", "means", KINDS), ("", "slices", list(rows[0]["slices"]))):
        for name in names:
            known = [row[of].get(name) for row in rows]
            lines += _line(f"{title}{name}", [value for value in known if value is not None])
    if any(row["below"] for row in rows):
        lines.append("Ψ below its best, logits, in translations, by the least grasp error (0.5 is 50 mm)")
        for start in rows[0]["below"]:
            known = [row["below"].get(start) for row in rows]
            lines += _line(start, [value for value in known if value is not None])
    return lines


def differences(first: str, one: Sequence[Row], second: str, other: Sequence[Row]) -> list[str]:
    """Returns the lines that compare two models scene by scene."""
    lines = [f"{first} less {second}: mean over scenes (standard error)"]
    for kind in KINDS:
        pairs = [(a["means"].get(kind), b["means"].get(kind)) for a, b in zip(one, other, strict=True)]
        lines += _line(f"mean of {kind}", [a - b for a, b in pairs if a is not None and b is not None])
    return lines


def _line(title: str, values: Sequence[float]) -> list[str]:
    if not values:
        return []
    numbers = torch.tensor(values)
    error = f"{numbers.std() / len(numbers) ** 0.5:.3f}" if len(numbers) > 1 else "-"
    return [f"  {title:<20}{numbers.mean():8.3f}  ({error}), {len(numbers)} scenes"]


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
