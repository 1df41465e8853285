"""How good a model is on simple scenes that it has never seen: its renderings, and its best grasps in physics.

    python benchmarks/shipped_model.py

draws 64 scenes from a seed kept out of every training set, renders four unseen views of each from the first three,
searches a grasp in each, compares it with the nearest valid one and carries it out. It prints the figures of
docs/results.md and, with `--out`, keeps one JSON line a scene.
"""

import json
from pathlib import Path

import torch
from jsonargparse import auto_cli
from tqdm import tqdm

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.commands.generate import generate
from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.rays import HeldOutViews
from nerfgrasp.evaluation.statistics import wilson_interval
from nerfgrasp.geometry import Camera
from nerfgrasp.models import MVNeRF, render_image
from nerfgrasp.models.folder import DEFAULT_MODEL
from nerfgrasp.scenes.oracle import grasp_errors, valid_grasps
from nerfgrasp.search.psi import Psi
from nerfgrasp.sim.attempt import Outcome, attempt_grasp
from nerfgrasp.training.mvnerf import image_scores

UNSEEN_VIEWS = 4
IMAGE_SCORES = ("psnr_objects", "psnr", "ssim")
"""Decibels over the pixels that show an object and over those that show the workspace, and structural similarity."""


def main(
    model: str = DEFAULT_MODEL,
    scenes: int = 64,
    seed: int = 100,
    size: int = 128,
    data: Path = Path("data/simple-evaluation"),
    render: bool = True,
    candidates: int | None = None,
    keep: int | None = None,
    out: Path | None = None,
) -> None:
    """Measures a model on held-out simple scenes.

    Args:
        model: a model folder or a shipped model's name.
        scenes: how many scenes.
        seed: of the scenes; no training set has it.
        size: the images' side in pixels.
        data: where the scenes are, or will be made.
        render: whether to measure the renderings; they take most of the time.
        candidates: random poses a search draws; the method's own number if not given.
        keep: how many of them climb; the method's own number if not given.
        out: JSON lines, one a scene.
    """
    keep_freed_memory()
    method = Psi.from_pretrained(model)
    views = method.images + UNSEEN_VIEWS
    generate(scenes=scenes, views=views, seed=seed, out=data, size=size, demonstrations=False)
    held_out = PackedScenes(data)
    images = rendering_scores(method.model.backbone, held_out, method.images) if render else [{} for _ in range(scenes)]
    grasps = [grasp_scores(method, held_out, scene, candidates, keep) for scene in tqdm(range(scenes), desc="grasps")]
    rows = [{"scene": n, **image, **grasp} for n, (image, grasp) in enumerate(zip(images, grasps, strict=True))]
    if out is not None:
        out.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print("\n".join(summary(rows)))


def rendering_scores(model: MVNeRF, held_out: PackedScenes, skip: int) -> list[dict[str, float]]:
    """Returns each scene's mean scores over its unseen views, which are those after the first `skip`."""
    views = HeldOutViews(held_out, len(held_out), model.config.views, UNSEEN_VIEWS, skip)
    scores: list[list[dict[str, float]]] = [[] for _ in range(len(held_out))]
    for item in tqdm(range(len(views)), desc="views"):
        view = views[item]
        size = (view.images.shape[-1], view.images.shape[-2])
        with torch.inference_mode():
            features = model.observe(view.images, Camera(view.intrinsics, view.T_world_camera, *size))
            camera = Camera(view.target_intrinsics, view.target_T_world_camera, *size)
            rgb, _, inside = render_image(model, features, camera, held_out.workspace)
        scored = image_scores(rgb.movedim(-1, 0), view.target, inside, view.objects)
        scores[item // UNSEEN_VIEWS].append({name: value.item() for name, value in scored.items()})
    return [{name: _mean([one[name] for one in some if name in one]) for name in IMAGE_SCORES} for some in scores]


def grasp_scores(
    method: Psi, held_out: PackedScenes, scene: int, candidates: int | None, keep: int | None
) -> dict[str, float | str]:
    """Searches one scene's best grasp, and returns its errors and its outcome in physics."""
    found = held_out.scene(scene)
    generator = torch.Generator().manual_seed(scene)
    grasps, _ = method.search(
        found.observations, found.workspace, generator=generator, candidates=candidates, keep=keep
    )
    best, truth = grasps.T_world_grasp[0], held_out.truth(scene)
    distance, angle = grasp_errors(best.double(), valid_grasps(truth.objects))
    return {
        "value": grasps.value[0].item(),
        "distance_mm": 1000 * distance.item(),
        "angle_deg": torch.rad2deg(angle).item(),
        "tilt_deg": torch.rad2deg(torch.arccos((-best[2, 2]).clamp(-1, 1))).item(),
        "outcome": str(attempt_grasp(truth, best).outcome),
    }


def summary(rows: list[dict[str, float | str]]) -> list[str]:
    """Returns the lines of the table."""
    lines = []
    for name in IMAGE_SCORES:
        if name in rows[0]:
            lines.append(f"{name:<24}{_mean([row[name] for row in rows]):8.3f}  mean over images")
    for name in ("distance_mm", "angle_deg", "tilt_deg"):
        values = torch.tensor([row[name] for row in rows])
        low, middle, high = values.quantile(torch.tensor([0.25, 0.5, 0.75])).tolist()
        lines.append(f"{name:<24}{middle:8.2f}  median (quartiles {low:.2f}, {high:.2f})")
    successes = sum(row["outcome"] == Outcome.SUCCESS for row in rows)
    low, high = wilson_interval(successes, len(rows))
    count = f"{successes} of {len(rows)}, 95 % {low:.2f} to {high:.2f}"
    lines.append(f"{'success':<24}{successes / len(rows):8.3f}  {count}")
    outcomes = sorted({str(row["outcome"]) for row in rows})
    lines += [f"  {outcome:<30}{sum(row['outcome'] == outcome for row in rows):4d}" for outcome in outcomes]
    return lines


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
