"""How good a model is on simple scenes that it has never seen: its renderings, and its best grasps in physics.

    python benchmarks/shipped_model.py

draws 64 scenes from a seed kept out of every training set, renders four unseen views of each from the first three,
searches a grasp in each, compares it with the nearest valid one and carries it out. It prints the figures of
docs/results.md and, with `--out`, keeps one JSON line a scene.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import torch
from joblib import Parallel, cpu_count, delayed
from jsonargparse import auto_cli
from torch import Tensor
from tqdm import tqdm

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.commands.generate import generate
from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.rays import HeldOutViews, ImageBatch
from nerfgrasp.evaluation.statistics import wilson_interval
from nerfgrasp.geometry import box_intersection, pixel_centres, pixel_rays
from nerfgrasp.models import MVNeRF
from nerfgrasp.models.folder import DEFAULT_MODEL
from nerfgrasp.scenes.oracle import grasp_errors, valid_grasps
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.psi import Psi
from nerfgrasp.search.strategies import DEFAULT_STRATEGY, Strategy, find_strategy
from nerfgrasp.sim.attempt import Outcome, attempt_grasp

UNSEEN_VIEWS = 4
IMAGE_SCORES = ("psnr_objects", "psnr_workspace")
"""Decibels over the pixels that show an object, and over those whose rays meet the workspace."""
RAYS_AT_A_TIME = 512

Row = dict[str, float | str]


def main(
    model: str = DEFAULT_MODEL,
    scenes: int = 64,
    seed: int = 100,
    size: int = 128,
    data: Path = Path("data/simple-evaluation"),
    stride: int = 1,
    schedule: str = DEFAULT_STRATEGY,
    candidates: int | None = None,
    keep: int | None = None,
    workers: int | None = None,
    out: Path | None = None,
) -> None:
    """Measures a model on held-out simple scenes.

    Args:
        model: a model folder or a shipped model's name.
        scenes: how many scenes.
        seed: of the scenes; no training set has it.
        size: the images' side in pixels.
        data: where the scenes are, or will be made.
        stride: render every object pixel, but of the workspace only every so many-th in each direction; 0 renders
            nothing.
        schedule: how to search, e.g. `paper`.
        candidates: random poses a search draws; the schedule's own number if not given.
        keep: how many of them climb; the schedule's own number if not given.
        workers: processes; one a core if not given.
        out: JSON lines, one a scene.
    """
    strategy = find_strategy(schedule, candidates=candidates, keep=keep)
    generate(scenes=scenes, views=3 + UNSEEN_VIEWS, seed=seed, out=data, size=size, demonstrations=False)
    jobs = (delayed(measure)(model, data, scene, stride, strategy) for scene in range(scenes))
    parallel = Parallel(n_jobs=workers or cpu_count(), return_as="generator")
    rows = list(tqdm(parallel(jobs), total=scenes, desc="scenes"))
    if out is not None:
        out.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print("\n".join(summary(rows)))


def measure(model: str, data: Path, scene: int, stride: int, strategy: Strategy) -> Row:
    """Returns all figures of one scene."""
    keep_freed_memory()
    torch.set_num_threads(1)
    method, held_out = Psi.from_pretrained(model), PackedScenes(data)
    images = image_scores(method.model.backbone, held_out, scene, method.images, stride) if stride else {}
    return {"scene": scene, **images, **grasp_scores(method, held_out, scene, strategy)}


def image_scores(model: MVNeRF, held_out: PackedScenes, scene: int, skip: int, stride: int) -> dict[str, float]:
    """Returns one scene's mean scores over its unseen views, which are those after the first `skip`."""
    views = HeldOutViews(held_out, len(held_out), model.config.views, UNSEEN_VIEWS, skip)
    scored = [
        view_scores(model, views[scene * UNSEEN_VIEWS + view], held_out.workspace, stride)
        for view in range(UNSEEN_VIEWS)
    ]
    return {name: _mean([one[name] for one in scored if name in one]) for name in IMAGE_SCORES}


@torch.inference_mode()
def view_scores(model: MVNeRF, view: ImageBatch, workspace: Workspace, stride: int) -> dict[str, float]:
    """Renders what one view shows of the objects and of the workspace; no object seen, no score for objects."""
    features = model.observe(view.inputs.images, view.inputs.camera(), workspace)
    camera = view.target.camera()
    width, height = camera.width, camera.height
    origins, directions = pixel_rays(camera, pixel_centres(width, height).flatten(0, 1))
    near, far = box_intersection(origins, directions, workspace.minimum, workspace.maximum)
    objects = view.objects.flatten()
    grid = torch.zeros(height, width, dtype=torch.bool)
    grid[::stride, ::stride] = True
    sampled = grid.flatten() & (far > near)
    error = torch.zeros(len(origins))
    for chosen in (objects | sampled).nonzero()[:, 0].split(RAYS_AT_A_TIME):
        fine = model.render(features, origins[None, chosen], directions[None, chosen], workspace).fine
        error[chosen] = (fine.colour[0] - view.target.images.flatten(1).T[chosen]).square().mean(dim=-1)
    scores = {"psnr_workspace": _decibels(error[sampled])}
    return {**scores, "psnr_objects": _decibels(error[objects])} if objects.any() else scores


def grasp_scores(method: Psi, held_out: PackedScenes, scene: int, strategy: Strategy) -> Row:
    """Searches one scene's best grasp, and returns its errors and its outcome in physics."""
    found = held_out.scene(scene)
    generator = torch.Generator().manual_seed(scene)
    grasps, _ = method.search(found.observations, found.workspace, generator=generator, strategy=strategy)
    best, truth = grasps.T_world_grasp[0], held_out.truth(scene)
    distance, angle = grasp_errors(best.double(), valid_grasps(truth.objects))
    return {
        "value": grasps.value[0].item(),
        "distance_mm": 1000 * distance.item(),
        "angle_deg": torch.rad2deg(angle).item(),
        "tilt_deg": torch.rad2deg(torch.arccos((-best[2, 2]).clamp(-1, 1))).item(),
        "outcome": str(attempt_grasp(truth, best).outcome),
    }


def summary(rows: Sequence[Row]) -> list[str]:
    """Returns the lines of the table."""
    lines = []
    for name in IMAGE_SCORES:
        if name in rows[0]:
            lines.append(f"{name:<24}{_mean([float(row[name]) for row in rows]):8.2f}  dB, mean over images")
    for name in ("distance_mm", "angle_deg", "tilt_deg"):
        values = torch.tensor([float(row[name]) for row in rows])
        low, middle, high = values.quantile(torch.tensor([0.25, 0.5, 0.75])).tolist()
        lines.append(f"{name:<24}{middle:8.2f}  median (quartiles {low:.2f}, {high:.2f})")
    successes = sum(row["outcome"] == Outcome.SUCCESS for row in rows)
    low, high = wilson_interval(successes, len(rows))
    count = f"{successes} of {len(rows)}, 95 % {low:.2f} to {high:.2f}"
    lines.append(f"{'success':<24}{successes / len(rows):8.3f}  {count}")
    outcomes = sorted({str(row["outcome"]) for row in rows})
    lines += [f"  {outcome:<30}{sum(row['outcome'] == outcome for row in rows):4d}" for outcome in outcomes]
    return lines


def _decibels(squared_error: Tensor) -> float:
    return -10.0 * squared_error.mean().log10().item()


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
