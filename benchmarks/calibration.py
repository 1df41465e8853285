r"""Whether a grasp value can be read as a probability of success, and whether it tells that a scene has no grasp.

    python benchmarks/calibration.py --model RUN/binary/model --compare mv3-laptop --out calibration.json

In simple scenes of the tuning seed, two kinds of poses are valued and carried out in physics: the best different ones
that the search `guided` proposes by Ψ alone, and valid grasps with random errors. Even scenes fit Platt's scaling, a
slope and a shift of the values; odd ones are measured. Three readings of a value v are compared with the rate of
success: `raw`, sigmoid(v); `prior`, sigmoid(v − log N); `scaled`, sigmoid(slope v + shift).

The loss `binary` weighs the one demonstrated grasp of a scene as all N negatives together (`pos_weight`). So sigmoid(v)
is trained to be the probability that a pose is the demonstrated one rather than a negative where both are as frequent,
and log N taken off makes it that at one demonstrated among N: N is `--negatives`, the sum of the config's. Neither is a
probability of success: a valid grasp among the negatives counts as one, and a search proposes what is far better than
they are. What scaling makes of a value is one, for poses such as were measured. The loss `softmax` leaves a scene's
values free up to a constant: scaled over many scenes they may look calibrated as far as the constants agree by chance.

Whether a scene is to be rejected is asked of the best value found in it: of the scenes as they are against the same
without objects, and with one box that is too wide for the gripper. The AUC is the chance that the graspable one of two
scenes has the higher value: 0.5 is none.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from joblib import Parallel, cpu_count, delayed
from jsonargparse import auto_cli
from matplotlib.figure import Figure
from proposals import Proposals, load, observed, propose, succeeds
from search import TUNING_SEED
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torchmetrics.functional.classification import binary_auroc, binary_calibration_error
from tqdm import tqdm

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.evaluation.statistics import wilson_interval
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.sanity import perturbed_grasp
from nerfgrasp.sim.shapes import box
from nerfgrasp.sim.tasks import find_task, scene_generator
from nerfgrasp.sim.tasks.draws import random_prism, upright_pose

BINS = 10
ERROR_SCALE = 1.5
"""Of the errors of valid grasps: 15 mm and 15°, with which four in ten succeed."""
TOO_WIDE = (0.09, 0.13)
"""Metres: sides of boxes that the open gripper does not span."""
KINDS = ("graspable", "empty", "too wide")
"""Of scenes: as they are, and two that hold no grasp."""
READINGS = ("raw", "prior", "scaled")
_WIDE_STREAM = 40


def main(
    model: str,
    compare: str | None = None,
    scenes: int = 48,
    proposals: int = 24,
    perturbed: int = 24,
    negatives: int = 96,
    workers: int | None = None,
    out: Path | None = None,
    plot: Path | None = None,
) -> None:
    """Measures a model, and another beside it, on the same scenes and poses with errors.

    Args:
        model: folder or shipped name of a grasp value trained with the loss `binary`.
        compare: likewise of one trained with the loss `softmax`.
        scenes: how many, two at least; half of them fit, half are measured.
        proposals: grasps of each search that are carried out, at most.
        perturbed: valid grasps with errors in each scene.
        negatives: poses beside the demonstrated one in the training of both.
        workers: processes; one a core if not given.
        out: JSON: what is printed, the reliability curves, and each scene's values and outcomes.
        plot: a PNG file of the curves.
    """
    models = [model] if compare is None else [model, compare]
    jobs = (delayed(scene_row)(models, index, proposals, perturbed) for index in range(scenes))
    rows = list(tqdm(Parallel(n_jobs=workers or cpu_count(), return_as="generator")(jobs), total=scenes, desc="scenes"))
    found = {name: measure(rows, name, negatives) for name in models}
    for name, result in found.items():
        print("\n".join(summary(name, result)), flush=True)
    if out is not None:
        settings = {"seed": TUNING_SEED, "error_scale": ERROR_SCALE, "negatives": negatives}
        out.write_text(json.dumps({**settings, "models": found, "scenes": rows}) + "\n")
    if plot is not None:
        draw(found).savefig(plot, dpi=120)


def scene_row(models: Sequence[str], index: int, proposals: int, perturbed: int) -> dict[str, Any]:
    """Returns the values and outcomes of one scene's poses, and the best values found in it and what stands for it."""
    keep_freed_memory()
    torch.set_num_threads(1)
    truth = find_task("simple").draw(TUNING_SEED, index)
    poses = [perturbed_grasp(truth, ERROR_SCALE, number) for number in range(perturbed)]
    outcomes = [succeeds(truth, pose) for pose in poses]
    others = dict(zip(KINDS[1:], (replace(truth, objects=()), too_wide_scene(index)), strict=True))
    row: dict[str, Any] = {"scene": index, "models": {}}
    for name in models:
        method = load(name)
        scene = observed(method, truth)
        found = propose(method, scene, truth)
        tried = found.alone.T_world_grasp[:proposals]
        values = found.alone.value[:proposals].tolist()
        if poses:
            values += method.model.value(scene.features, torch.stack(poses)).tolist()
        best = {KINDS[0]: best_values(found)}
        best |= {kind: best_values(propose(method, observed(method, one), one)) for kind, one in others.items()}
        success = [succeeds(truth, pose) for pose in tried] + outcomes
        row["models"][name] = {"proposed": len(tried), "values": values, "success": success, "best": best}
    return row


def too_wide_scene(index: int) -> Truth:
    """Returns a scene of the tuning seed whose one object is a box that the open gripper does not span."""
    rng = scene_generator(TUNING_SEED, index, _WIDE_STREAM)
    parts = box(*rng.uniform(*TOO_WIDE, 2).tolist())
    wide = replace(random_prism(rng), kind="box", parts=parts, T_world_object=upright_pose(rng, 0.14))
    return Truth("simple", TUNING_SEED, index, (wide,))


def best_values(found: Proposals) -> dict[str, float | None]:
    """Returns the highest value by Ψ alone and with feasibility; None where nothing is found."""
    return {judge: float(grasps.value[0]) if len(grasps) else None for judge, grasps in found._asdict().items()}


def measure(rows: Sequence[dict[str, Any]], model: str, negatives: int) -> dict[str, Any]:
    """Returns what a model's values are worth: fitted on even scenes, measured on odd ones."""
    halves = [_poses([row["models"][model] for row in rows if row["scene"] % 2 == half]) for half in (0, 1)]
    slope, shift = platt(*halves[0])
    values, success = halves[1]
    logits = dict(zip(READINGS, (values, values - math.log(negatives), slope * values + shift), strict=True))
    best = {
        judge: {kind: [row["models"][model]["best"][kind][judge] for row in rows] for kind in KINDS}
        for judge in Proposals._fields
    }
    return {
        "slope": slope,
        "shift": shift,
        "auc_of_poses": auc(values[success], values[~success]),
        "readings": {name: reliability(each.sigmoid(), success) for name, each in logits.items()},
        "rejection": {
            judge: {kind: auc(_known(kinds[KINDS[0]]), _known(kinds[kind])) for kind in KINDS[1:]}
            for judge, kinds in best.items()
        },
        "median_best": {
            judge: {kind: float(_known(values).median()) for kind, values in kinds.items()}
            for judge, kinds in best.items()
        },
    }


def platt(values: Tensor, success: Tensor) -> tuple[float, float]:
    """Returns the slope and shift of the logit of success as a function of values `[N]`, by maximum likelihood.

    Source: Platt 1999, "Probabilistic outputs for support vector machines": the targets are drawn in a little, so that
    outcomes that the values separate without an error give no infinite slope.

    Args:
        values: `[N]`, double.
        success: bool `[N]`.
    """
    won, lost = int(success.sum()), int((~success).sum())
    target = torch.where(success, (won + 1) / (won + 2), 1 / (lost + 2)).to(values)
    centre, spread = values.mean(), values.std().clamp(min=1e-6)
    weights = torch.zeros(2, dtype=values.dtype, requires_grad=True)
    optimizer = torch.optim.LBFGS([weights], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> float:
        optimizer.zero_grad()
        error = binary_cross_entropy_with_logits(weights[0] * (values - centre) / spread + weights[1], target)
        error.backward()
        return error.item()

    optimizer.step(loss)
    slope = weights[0].detach() / spread
    return float(slope), float(weights[1].detach() - slope * centre)


def reliability(probability: Tensor, success: Tensor) -> dict[str, Any]:
    """Returns the Brier score, the expected calibration error over bins of one width, and the reliability curve.

    Args:
        probability: `[N]`, as predicted.
        success: bool `[N]`.

    Returns:
        `brier`, `ece`, and in `curve` for each bin that holds any poses their `count`, mean `predicted` probability,
        `observed` rate, and its 95 % interval, Wilson's, `low` and `high`; poses of one scene are counted as
        independent, which promises too much.
    """
    number = (probability * BINS).long().clamp(max=BINS - 1)
    curve = []
    for each in range(BINS):
        there = number == each
        if there.any():
            won, count = int(success[there].sum()), int(there.sum())
            low, high = wilson_interval(won, count)
            predicted = float(probability[there].mean())
            curve.append({"count": count, "predicted": predicted, "observed": won / count, "low": low, "high": high})
    return {
        "brier": float((probability - success.to(probability)).square().mean()),
        "ece": float(binary_calibration_error(probability, success.long(), n_bins=BINS)),
        "curve": curve,
    }


def auc(higher: Tensor, lower: Tensor) -> float | None:
    """Returns how likely a value of the first is above one of the second; None where there are none of either."""
    if len(higher) == 0 or len(lower) == 0:
        return None
    values = torch.cat([higher, lower])
    # By rank: probabilities so near to 1 that they are alike would count as ties.
    rank = torch.unique(values, return_inverse=True)[1].double() / len(values)
    return float(binary_auroc(rank, (torch.arange(len(values)) < len(higher)).long()))


def summary(model: str, found: dict[str, Any]) -> list[str]:
    """Returns the lines of one model."""
    poses = sum(each["count"] for each in found["readings"]["raw"]["curve"])
    lines = [
        f"{model}: {poses} poses measured, AUC {_number(found['auc_of_poses'])};"
        f" scaled by {found['slope']:.3f} v {found['shift']:+.2f}",
        "  reading   Brier    ECE   mean predicted: observed rate (95 % interval) of count",
    ]
    for name, reading in found["readings"].items():
        lines.append(f"  {name:<8} {reading['brier']:6.3f} {reading['ece']:6.3f}")
        lines += [
            f"{'':26}{each['predicted']:.2f}: {each['observed']:.2f} ({each['low']:.2f}, {each['high']:.2f})"
            f" of {each['count']}"
            for each in reading["curve"]
        ]
    for judge, kinds in found["rejection"].items():
        shown = ", ".join(f"{kind} {_number(value)}" for kind, value in kinds.items())
        medians = ", ".join(f"{kind} {value:.1f}" for kind, value in found["median_best"][judge].items())
        lines.append(f"  rejecting by the best value, {judge}: AUC {shown}; medians {medians}")
    return lines


def draw(found: dict[str, dict[str, Any]]) -> Figure:
    """Returns a picture of the reliability curves, a panel a model."""
    figure = Figure(figsize=(4.5 * len(found), 4.2), layout="constrained")
    for panel, (model, result) in zip(figure.subplots(1, len(found), squeeze=False)[0], found.items(), strict=True):
        panel.plot([0, 1], [0, 1], color="0.7", linewidth=1)
        for name, reading in result["readings"].items():
            x, y, low, high = (
                [each[key] for each in reading["curve"]] for key in ("predicted", "observed", "low", "high")
            )
            lengths = [[max(0.0, a - b) for a, b in zip(*ends, strict=True)] for ends in ((y, low), (high, y))]
            panel.errorbar(
                x, y, lengths, marker="o", markersize=4, capsize=2, label=f"{name}, ECE {reading['ece']:.2f}"
            )
        panel.set(title="/".join(Path(model).parts[-2:]), xlabel="predicted", ylabel="rate of success")
        panel.legend()
    return figure


def _poses(rows: Sequence[dict[str, Any]]) -> tuple[Tensor, Tensor]:
    values = torch.tensor([value for row in rows for value in row["values"]], dtype=torch.float64)
    return values, torch.tensor([success for row in rows for success in row["success"]], dtype=torch.bool)


def _known(values: Sequence[float | None]) -> Tensor:
    return torch.tensor([value for value in values if value is not None], dtype=torch.float64)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
