"""`nerfgrasp slices`: shows a grasp value beside the truth in slices through a valid grasp."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torch import Tensor
from tqdm import tqdm

from nerfgrasp import __version__
from nerfgrasp.commands.publishing import publishing
from nerfgrasp.commands.ranges import check_ranges
from nerfgrasp.devices import find_device
from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.slices import central_grasp, learned_values, means_by_kind, rank_correlation, true_values
from nerfgrasp.files import write_json
from nerfgrasp.grippers import DEFAULT_GRIPPER, find_gripper
from nerfgrasp.methods.psi import Psi
from nerfgrasp.models.folder import DEFAULT_MODEL
from nerfgrasp.scenes.folder import read_scene
from nerfgrasp.scenes.oracle import valid_grasps
from nerfgrasp.scenes.scene import Scene
from nerfgrasp.scenes.shipped import find_scene
from nerfgrasp.scenes.slices import SLICES, Axes, Slice, cut_slice
from nerfgrasp.scenes.truth import tensor_to_json
from nerfgrasp.viz.slice_sheet import slice_sheet, spans

NOTE = (
    "truth: the negative grasp error -(d / 50 mm + angle / 45 deg) / 2; values are logits, comparable within one scene"
    " and model only; correlations are Spearman's, over the poses in the workspace"
)


@dataclass(frozen=True)
class Compared:
    """What a model makes of the slices."""

    values: list[Tensor]
    """`[N, N]` of each slice; NaN outside of the workspace."""
    correlations: dict[str, float | None]
    """Rank correlations with the truth, by slice."""
    means: dict[str, float]
    """Their means by kind of slice."""


def slices(
    scene: str,
    *,
    model: tuple[str, ...] = (DEFAULT_MODEL,),
    slices: tuple[str, ...] = SLICES,
    size: int = 33,
    axes: Axes = "grasp",
    reach: float | None = None,
    turn: float = 90.0,
    seed: int = 0,
    device: str = "cpu",
    gripper: str = DEFAULT_GRIPPER.name,
    out: Path | None = None,
) -> None:
    """Shows models' grasp values beside the negative grasp error, in slices through a valid grasp.

    Writes `slices.png`, the truth above and a row for each model, and `slices.json` with the rank correlation of each
    model's values with the truth in each slice; both or none. Slices are named by the two coordinates that change:
    tx, ty, tz along three axes through the grasp, rx, ry, rz about them. The values are those of Ψ alone.

    Args:
        scene: a simulated scene's folder, or the name of a shipped one, e.g. `demo`.
        model: models' folders, Hugging Face repository ids, or names of shipped ones.
        slices: e.g. `tx-ty rx-rz`.
        size: poses in each direction of a slice.
        axes: whose axes: those of the `grasp` (x closes, z approaches) or of the `world`.
        reach: metres that translations go at most to either side; all of the workspace if not given.
        turn: degrees that rotations go to either side.
        seed: draws the grasp from the valid ones, where the scene has no demonstrated one.
        device: where the models compute: `cpu`, `cuda`, `mps`, or a numbered one, e.g. `cuda:1`.
        gripper: the hand that the truth is about: a registered gripper or a YAML file.
        out: folder of the results; `SCENE-slices` if not given.

    Raises:
        UserError: something asked for is not there, is damaged or cannot be written, or the scene is not simulated.
    """
    _check(model, slices, size, reach, turn, seed)
    find_device(device)
    found = read_scene(find_scene(scene))
    truth = found.truth
    if truth is None:
        raise UserError(f"scene {found.name} is not simulated: without its truth there is no grasp error")
    hand = find_gripper(gripper)
    valid = valid_grasps(truth.objects, hand)
    try:
        grasp, source = central_grasp(truth, valid, found.workspace, seed)
    except UserError as error:
        raise UserError(f"scene {found.name}: {error}") from error
    cuts = [
        cut_slice(grasp, name, found.workspace, size=size, axes=axes, reach=reach, turn=math.radians(turn))
        for name in slices
    ]
    methods = {name: Psi.from_pretrained(name, device=device) for name in model}
    destination = Path(f"{found.name}-slices") if out is None else Path(out)
    with publishing(destination) as results:
        true = [true_values(cut, valid) for cut in cuts]
        compared = _compare(methods, found, cuts, true)
        print("\n".join(table(cuts, compared)), flush=True)
        settings = {"scene": found.name, "axes": axes, "size": size, "reach": reach, "turn": turn, "seed": seed}
        header = {"format": 1, **settings, "versions": {"nerfgrasp": __version__, "torch": version("torch")}}
        grasp_data = {"T_world_grasp": tensor_to_json(grasp), "source": source}
        data = {**header, "note": NOTE, "grasp": grasp_data, **to_json(cuts, true, compared)}
        write_json(results / "slices.json", data, indent=2)
        shown = found.observations.select(slice(max(method.images for method in methods.values())))
        slice_sheet(shown, grasp, hand, cuts, _rows(cuts, true, compared)).save(results / "slices.png")
    print(f"wrote slices.json, slices.png to {destination}")


def table(cuts: Sequence[Slice], compared: Mapping[str, Compared]) -> list[str]:
    """Returns the lines of a table of rank correlations: a slice each, then the means of each kind."""
    widths = {name: max(len(name), 6) for name in compared}
    lines = [f"{'slice':<20}" + "  ".join(f"{name:>{width}}" for name, width in widths.items())]
    rows: dict[str, list[float | None]] = {
        f"{cut.name:<6}  {cut.kind}": [each.correlations[cut.name] for each in compared.values()] for cut in cuts
    }
    kinds = dict.fromkeys(kind for each in compared.values() for kind in each.means)
    rows |= {f"mean of {kind}": [each.means.get(kind) for each in compared.values()] for kind in kinds}
    for title, row in rows.items():
        cells = [f"{_number(value):>{width}}" for value, width in zip(row, widths.values(), strict=True)]
        lines.append(f"{title:<20}" + "  ".join(cells))
    return [*lines, "(Spearman's rank correlation with the negative grasp error; values of one scene and one grasp)"]


def to_json(cuts: Sequence[Slice], true: Sequence[Tensor], compared: Mapping[str, Compared]) -> dict[str, Any]:
    """Returns what `slices.json` holds of the slices and of the models."""
    planes = [
        {
            "name": cut.name,
            "kind": cut.kind,
            "from": [cut.across.low, cut.upward.low],
            "to": [cut.across.high, cut.upward.high],
            "poses": int(cut.inside.sum()),
            "truth": _summary(cut, values),
        }
        for cut, values in zip(cuts, true, strict=True)
    ]
    models = [
        {
            "model": name,
            "means": each.means,
            "slices": {
                cut.name: {"correlation": each.correlations[cut.name], **_summary(cut, values)}
                for cut, values in zip(cuts, each.values, strict=True)
            },
        }
        for name, each in compared.items()
    ]
    return {"units": "metres and radians from the grasp", "slices": planes, "models": models}


def _check(models: Sequence[str], names: Sequence[str], size: int, reach: float | None, turn: float, seed: int) -> None:
    for option, given in (("model", models), ("slices", names)):
        if not given:
            raise UserError(f"--{option} names nothing")
        for place, name in enumerate(given):
            if name in given[:place]:
                raise UserError(f"--{option} names {name} twice")
    check_ranges("slices", size=size, seed=seed)
    if reach is not None and not 0 < reach < math.inf:
        raise UserError(f"reach is {reach}: it must be a positive number of metres")
    if not 0 < turn <= 180:
        raise UserError(f"turn is {turn}: it must be more than 0 and at most 180 degrees")


def _compare(
    methods: Mapping[str, Psi], scene: Scene, cuts: Sequence[Slice], true: Sequence[Tensor]
) -> dict[str, Compared]:
    poses = len(methods) * sum(int(cut.inside.sum()) for cut in cuts)
    compared = {}
    with tqdm(total=poses, desc=f"slicing {scene.name}", unit="pose", disable=None) as bar:
        for name, method in methods.items():
            try:
                values = learned_values(method, scene.observations, scene.workspace, cuts, bar.update)
            except UserError as error:
                raise UserError(f"model {name}: {error}") from error
            found = {cut.name: rank_correlation(one, other) for cut, one, other in zip(cuts, values, true, strict=True)}
            compared[name] = Compared(values, found, means_by_kind(cuts, found))
    return compared


def _rows(
    cuts: Sequence[Slice], true: Sequence[Tensor], compared: Mapping[str, Compared]
) -> dict[str, list[tuple[Tensor, str]]]:
    """Returns the sheet's rows: headings, and of each slice its values and caption."""
    heading = "negative grasp error (truth); first coordinate to the right, second upward; bright is high"
    rows = {heading: [(values, spans(cut)) for cut, values in zip(cuts, true, strict=True)]}
    for name, each in compared.items():
        means = ", ".join(f"{kind} {mean:.2f}" for kind, mean in each.means.items())
        captions = [f"{cut.name}: rho {_number(each.correlations[cut.name])}" for cut in cuts]
        rows[f"{name}: mean rank correlation {means or '-'}"] = list(zip(each.values, captions, strict=True))
    return rows


def _summary(cut: Slice, values: Tensor) -> dict[str, Any]:
    """Returns least, mean and greatest value, and where the greatest lies."""
    known = values[cut.inside]
    if len(known) == 0:
        return {}
    row, column = divmod(int(values.nan_to_num(-math.inf).argmax()), values.shape[1])
    shares = (column / (values.shape[1] - 1), row / (values.shape[0] - 1))
    at = [
        axis.low + share * (axis.high - axis.low) for axis, share in zip((cut.across, cut.upward), shares, strict=True)
    ]
    return {"min": float(known.min()), "mean": float(known.mean()), "max": float(known.max()), "max_at": at}


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
