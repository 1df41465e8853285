"""How well a backbone renders views of held-out scenes that it has not seen.

    python benchmarks/backbone.py --models '[mv3-laptop]'

draws 64 scenes of a task from a seed kept out of every training set, gives a model the first views of each and renders
four others at 128×128 and a focal length of 120 pixels. It prints the means over images of the PSNR over the pixels
that show an object and over those whose rays meet the workspace; with `--out` it keeps one JSON line a scene and model.
Tasks that a model was never trained on are measured all the same.
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
from nerfgrasp.geometry import Camera, box_intersection, pixel_centres, pixel_rays
from nerfgrasp.models import GraspValue, MVNeRF
from nerfgrasp.models.folder import DEFAULT_MODEL, load_model
from nerfgrasp.models.mvnerf import SceneFeatures
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.rendering import render_scene
from nerfgrasp.sim.tasks import find_task, scene_cameras, workspace

SEEN_VIEWS, UNSEEN_VIEWS = 3, 4
"""Of the scene's endless sequence of views: the first are shown to models, the next are rendered by them."""
TARGET_SIZE = 128
SCORES = ("psnr_objects", "psnr_workspace")
"""Decibels over the pixels that show an object, and over those whose rays meet the workspace."""
RAYS_AT_A_TIME = 512


def main(
    models: tuple[str, ...] = (DEFAULT_MODEL,),
    task: str = "simple",
    scenes: int = 64,
    seed: int = 100,
    size: int | None = None,
    stride: int = 4,
    objects: Path | None = None,
    workers: int | None = None,
    out: Path | None = None,
) -> None:
    """Measures models on the same held-out scenes.

    Args:
        models: model folders or shipped models' names; of a grasp value, its backbone.
        task: what the scenes are.
        scenes: how many.
        seed: of the scenes; no training set has it.
        size: side of the images shown to the models, in pixels; each model's own if not given.
        stride: of the workspace, only every so many-th pixel in each direction is rendered, none if 0; objects
            are rendered whole.
        objects: for `novel`: a folder of URDFs or meshes.
        workers: processes; one a core if not given.
        out: JSON lines, one a scene and model.
    """
    rows = []
    for model in models:
        jobs = (delayed(scene_scores)(model, task, seed, index, size, stride, objects) for index in range(scenes))
        parallel = Parallel(n_jobs=workers or cpu_count(), return_as="generator")
        found = list(tqdm(parallel(jobs), total=scenes, desc=model))
        rows += [{"model": model, "task": task, "seed": seed, "scene": i, **row} for i, row in enumerate(found)]
        print("\n".join(summary(model, found)), flush=True)
    if out is not None:
        out.write_text("".join(json.dumps(row) + "\n" for row in rows))


def scene_scores(
    model: str, task: str, seed: int, index: int, size: int | None, stride: int, objects: Path | None
) -> dict[str, list[float]]:
    """Returns the scores of each unseen view of one scene; see `network_scores`."""
    keep_freed_memory()
    torch.set_num_threads(1)
    return network_scores(backbone(model), find_task(task, objects).draw(seed, index), size, stride)


def network_scores(network: MVNeRF, truth: Truth, size: int | None, stride: int) -> dict[str, list[float]]:
    """Returns the scores of each unseen view of one scene; a view that shows no object has none for objects."""
    seed, index = truth.seed, truth.index
    side = size or network.config.image_size or TARGET_SIZE
    camera = scene_cameras(seed, index, SEEN_VIEWS, side)[: network.config.views]
    images, _ = pictures(truth, camera)
    found: dict[str, list[float]] = {name: [] for name in SCORES}
    targets = scene_cameras(seed, index, SEEN_VIEWS + UNSEEN_VIEWS, TARGET_SIZE)[SEEN_VIEWS:]
    truths, masks = pictures(truth, targets)
    with torch.inference_mode():
        features = network.observe(images[None], camera[None], workspace)
        for view in range(UNSEEN_VIEWS):
            scores = view_scores(network, features, targets[view], truths[view], masks[view], stride)
            for name, score in scores.items():
                found[name].append(score)
    return found


def backbone(model: str) -> MVNeRF:
    """Loads a model's backbone."""
    loaded = load_model(model)
    return loaded.backbone if isinstance(loaded, GraspValue) else loaded


def pictures(truth: Truth, camera: Camera) -> tuple[Tensor, Tensor]:
    """Renders RGB `[V, 3, H, W]` in [0, 1] and where objects are, bool `[V, H, W]`."""
    images, masks = render_scene(truth, camera)
    return (torch.from_numpy(images).movedim(-1, -3) / 255).contiguous(), torch.from_numpy(masks > 0)


def view_scores(
    model: MVNeRF, features: SceneFeatures, camera: Camera, truth: Tensor, objects: Tensor, stride: int
) -> dict[str, float]:
    """Renders what one view shows of the objects and of the workspace, and compares it with the truth."""
    origins, directions = pixel_rays(camera, pixel_centres(camera.width, camera.height).flatten(0, 1))
    near, far = box_intersection(origins, directions, workspace.minimum, workspace.maximum)
    shown = objects.flatten()
    grid = torch.zeros_like(objects)
    if stride:
        grid[::stride, ::stride] = True
    sampled = grid.flatten() & (far > near)
    error = torch.zeros(len(origins))
    for chosen in (shown | sampled).nonzero()[:, 0].split(RAYS_AT_A_TIME):
        fine = model.render(features, origins[None, chosen], directions[None, chosen], workspace).fine
        error[chosen] = (fine.colour[0] - truth.flatten(1).T[chosen]).square().mean(dim=-1)
    return {name: _decibels(error[where]) for name, where in zip(SCORES, (shown, sampled), strict=True) if where.any()}


def summary(model: str, rows: Sequence[dict[str, list[float]]]) -> list[str]:
    """Returns the lines of the table."""
    lines = [model]
    for name in SCORES:
        if not any(row[name] for row in rows):
            continue
        scenes = torch.tensor([sum(row[name]) / len(row[name]) for row in rows if row[name]])
        images = torch.tensor([score for row in rows for score in row[name]])
        error = f"standard error {scenes.std() / len(scenes) ** 0.5:.2f} over scenes"
        lines.append(f"  {name:<16}{images.mean():8.2f} dB, mean over {len(images)} images; {error}")
    return lines


def _decibels(squared_error: Tensor) -> float:
    return -10.0 * squared_error.mean().log10().item()


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
