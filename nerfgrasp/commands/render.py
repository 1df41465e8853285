"""`nerfgrasp render`: shows a scene as a model renders it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate
from tqdm import tqdm

from nerfgrasp import __version__
from nerfgrasp.commands.publishing import publishing
from nerfgrasp.devices import find_device
from nerfgrasp.errors import UserError
from nerfgrasp.files import write_json
from nerfgrasp.geometry import Camera, shrink
from nerfgrasp.models.folder import DEFAULT_MODEL, load_backbone
from nerfgrasp.models.mvnerf import MVNeRF
from nerfgrasp.models.scores import LPIPS_LEAST_SIDE, image_scores, load_lpips
from nerfgrasp.scenes.folder import read_scene
from nerfgrasp.scenes.scene import Observations, Scene
from nerfgrasp.scenes.shipped import find_scene
from nerfgrasp.viz.imagination import full_orbit
from nerfgrasp.viz.rendering_sheet import animation, orbit_sheet, views_sheet
from nerfgrasp.viz.renderings import RenderedView, render_views

Views = list[int] | int | str | None
"""Views by their numbers in the scene, counted from 0; on the command line `3` or `0,1,2`."""
LEAST_SIZE = 16
"""Pixels; below it SSIM means nothing."""
FRAME_MS = 100
"""Milliseconds that a frame of the animation stands."""
COLUMNS = {"psnr": "PSNR", "psnr_objects": "objects", "ssim": "SSIM", "lpips": "LPIPS"}
"""The table's columns by score."""
SCORES_NOTE = "PSNR in dB, over the pixels whose rays meet the workspace and over the objects'; LPIPS: less is better"

Scores = dict[str, float]


@dataclass(frozen=True)
class Seen:
    """The views that a model is given."""

    numbers: list[int]
    """Of the scene's views, counted from 0."""
    views: Observations
    """The views themselves."""


def render(
    scene: str,
    *,
    model: str = DEFAULT_MODEL,
    view: Views = None,
    orbit: int | None = None,
    inputs: Views = None,
    size: int = 128,
    device: str = "cpu",
    out: Path | None = None,
) -> None:
    """Renders a model's RGB and depth of a scene: of its views, scored against the truth, or on an orbit.

    Writes `render.png` (a sheet), `render.json` (scores and settings), `render.rrd` (open it with `rerun`) and, of
    an orbit, `orbit.gif`; all or none. Views are numbered from 0, as the scene's frames are.

    Args:
        scene: a scene's folder, or the name of a shipped one, e.g. `demo`.
        model: a model's folder, a Hugging Face repository id, or the name of a shipped one; of a grasp value, its
            backbone renders.
        view: the views to render, e.g. `3` or `3,4`; all that are no input if not given.
        orbit: in place of views, so many frames on a circle about the workspace.
        inputs: the views that the model is given, e.g. `0,1,2`; as many as it sees at once, from the front, if not
            given.
        size: the longer side of what is rendered, pixels; images that are smaller stay as they are.
        device: where to render: `cpu`, `cuda`, `mps`, or a numbered one, e.g. `cuda:1`.
        out: folder of the results; `SCENE-render` if not given.

    Raises:
        UserError: something asked for is not there, is damaged or cannot be written.
    """
    _check(view, orbit, size)
    where = find_device(device)
    found = read_scene(find_scene(scene))
    chosen = _numbers("view", view, found)
    network = load_backbone(model).to(where)
    seen = _seen(found, _numbers("inputs", inputs, found), network.config.views)
    numbers = [] if orbit else chosen or _others(found, seen)
    destination = Path(f"{found.name}-render") if out is None else Path(out)
    with publishing(destination) as results:
        header = {"format": 1, "scene": found.name, "model": model, "inputs": seen.numbers, "size": size}
        header["versions"] = {"nerfgrasp": __version__, "torch": version("torch")}
        if orbit:
            views = _render(network, seen, found, shrink(full_orbit(seen.views.camera, found.workspace, orbit), size))
            _write_orbit(results, found, seen, views)
            write_json(results / "render.json", {**header, "orbit": orbit}, indent=2)
        else:
            views, scores = _render_and_score(network, seen, found, numbers, size)
            print("\n".join(table(scores)), flush=True)
            _write_views(results, found, seen, dict(zip(numbers, views, strict=True)), scores)
            rows = [{"view": number, **row} for number, row in scores.items()]
            write_json(results / "render.json", {**header, "note": SCORES_NOTE, "views": rows}, indent=2)
        written = [path.name for path in sorted(results.iterdir())]
    print(f"wrote {', '.join(written)} to {destination}")


def table(scores: Mapping[int, Scores]) -> list[str]:
    """Returns the lines of a table of scores by view, with their mean where there are several views."""
    names = [name for name in COLUMNS if any(name in row for row in scores.values())]
    lines = ["view  " + "  ".join(f"{COLUMNS[name]:>7}" for name in names)]
    rows: dict[str, Scores] = {f"{number}": row for number, row in scores.items()}
    if len(scores) > 1:
        rows["mean"] = {name: mean(row[name] for row in scores.values() if name in row) for name in names}
    for title, row in rows.items():
        cells = [f"{row[name]:7.{2 if 'psnr' in name else 3}f}" if name in row else f"{'-':>7}" for name in names]
        lines.append(f"{title:>4}  " + "  ".join(cells))
    return [*lines, f"({SCORES_NOTE})"]


def _check(view: Views, orbit: int | None, size: int) -> None:
    if view is not None and orbit is not None:
        raise UserError("--view and --orbit are two ways to say what is rendered: give one of them")
    if orbit is not None and orbit < 1:
        raise UserError(f"orbit is {orbit}: it must be at least 1")
    if size < LEAST_SIZE:
        raise UserError(f"size is {size}: it must be at least {LEAST_SIZE}")


def _numbers(option: str, views: Views, scene: Scene) -> list[int]:
    """Returns the numbers of the scene's views that an option names; none if it is not given."""
    if views is None:
        return []
    try:
        named = views if isinstance(views, list) else [int(part) for part in str(views).split(",")]
    except ValueError:
        raise UserError(f"--{option} is {views!r}: give numbers of views, e.g. 0,1,2") from None
    last = len(scene.observations) - 1
    for place, number in enumerate(named):
        if not 0 <= number <= last:
            raise UserError(f"--{option} names view {number}: scene {scene.name} has views 0 to {last}")
        if number in named[:place]:
            raise UserError(f"--{option} names view {number} twice")
    return named


def _seen(scene: Scene, numbers: list[int], count: int) -> Seen:
    """Returns the inputs, or as many as the model sees at once from the front if none are named."""
    scene.observations.require(count)
    numbers = numbers or list(range(count))
    if len(numbers) != count:
        raise UserError(f"--inputs names {len(numbers)} of the views: the model sees {count} at once")
    return Seen(numbers, scene.observations.select(numbers))


def _others(scene: Scene, seen: Seen) -> list[int]:
    others = [number for number in range(len(scene.observations)) if number not in seen.numbers]
    if not others:
        raise UserError(f"all {len(seen.numbers)} views of scene {scene.name} are inputs: give --orbit or --view")
    return others


def _render(network: MVNeRF, seen: Seen, scene: Scene, camera: Camera) -> list[RenderedView]:
    views = render_views(network, seen.views, camera, scene.workspace)
    return list(tqdm(views, total=len(camera), desc=f"rendering {scene.name}", unit="view", disable=None))


def _render_and_score(
    network: MVNeRF, seen: Seen, scene: Scene, numbers: list[int], size: int
) -> tuple[list[RenderedView], dict[int, Scores]]:
    """Returns the scene's views as rendered, each with the truth, and their scores by number."""
    targets = _shrunk(scene.observations.select(numbers), size)
    masks, depth = _simulated(scene, targets.camera)
    views = [
        replace(view, truth=image.movedim(0, -1), true_depth=None if depth is None else depth[i])
        for i, (view, image) in enumerate(
            zip(_render(network, seen, scene, targets.camera), targets.images, strict=True)
        )
    ]
    return views, dict(zip(numbers, _scores(views, masks), strict=True))


def _shrunk(observations: Observations, size: int) -> Observations:
    camera = shrink(observations.camera, size)
    shape = (camera.height, camera.width)
    if shape == observations.images.shape[-2:]:
        return observations
    images = interpolate(observations.images, size=shape, mode="bilinear", align_corners=False, antialias=True)
    return Observations(images, camera)


def _simulated(scene: Scene, camera: Camera) -> tuple[Tensor, Tensor | None]:
    """Returns, of cameras `[V]`, where objects are seen and depth in metres, both `[V, H, W]`.

    Of a scene that is not simulated, or cannot be here: no objects, and no depth.
    """
    nothing = torch.zeros(len(camera), camera.height, camera.width, dtype=torch.bool)
    if scene.truth is None:
        return nothing, None
    try:
        from nerfgrasp.sim.rendering import render_scene

        _, masks, depth = render_scene(scene.truth, camera, depth=True)
    except (UserError, ModuleNotFoundError) as error:
        print(f"true depth and the objects' scores are left out: {error}", flush=True)
        return nothing, None
    return torch.from_numpy(masks > 0), torch.from_numpy(depth)


def _scores(views: Sequence[RenderedView], masks: Tensor) -> list[Scores]:
    """Returns what is known of each view: no score where nothing of the workspace is seen, or none is finite."""
    lpips = _lpips(views[0].camera)
    rows: list[Scores] = []
    for view, objects in zip(views, masks, strict=True):
        assert view.truth is not None
        if not view.inside.any():
            rows.append({})
            continue
        rgb, truth = view.rgb.movedim(-1, 0), view.truth.movedim(-1, 0)
        scores = image_scores(rgb, truth, view.inside, objects & view.inside)
        if lpips is not None:
            scores["lpips"] = lpips(torch.where(view.inside, rgb, truth)[None].clamp(0.0, 1.0), truth[None])
        rows.append({name: float(value) for name, value in scores.items() if isfinite(value)})
    return rows


def _lpips(camera: Camera) -> Any:
    """Returns LPIPS, or None with a line that says why not."""
    try:
        if min(camera.width, camera.height) < LPIPS_LEAST_SIDE:
            raise UserError(f"the images are smaller than {LPIPS_LEAST_SIDE} pixels")
        return load_lpips()
    except UserError as error:
        print(f"LPIPS is left out: {error}", flush=True)
        return None


def _write_views(
    folder: Path, scene: Scene, seen: Seen, views: Mapping[int, RenderedView], scores: Mapping[int, Scores]
) -> None:
    headings = [f"view {number}{_facts(scores[number])}" for number in views]
    sheet = views_sheet(_input_images(seen), dict(zip(headings, views.values(), strict=True)))
    sheet.save(folder / "render.png")
    if _rerun_is_here():
        from nerfgrasp.viz.recording import record_views

        named = {f"rendered_{number}": view for number, view in views.items()}
        record_views(folder / "render.rrd", seen.views, _input_names(seen), scene.workspace, named)


def _write_orbit(folder: Path, scene: Scene, seen: Seen, views: Sequence[RenderedView]) -> None:
    captions = [f"{360 * frame / len(views):.0f}°, frame {frame}" for frame in range(len(views))]
    orbit_sheet(_input_images(seen), dict(zip(captions, views, strict=True))).save(folder / "render.png")
    first, *others = animation(views)
    first.save(folder / "orbit.gif", save_all=True, append_images=others, duration=FRAME_MS, loop=0)
    if _rerun_is_here():
        from nerfgrasp.viz.recording import record_orbit

        record_orbit(folder / "render.rrd", seen.views, _input_names(seen), scene.workspace, views)


def _facts(scores: Scores) -> str:
    known = [f"{COLUMNS[name]} {value:.2f}{' dB' if 'psnr' in name else ''}" for name, value in scores.items()]
    return f": {', '.join(known)}" if known else ""


def _input_images(seen: Seen) -> dict[str, Tensor]:
    images = seen.views.images.movedim(1, -1)
    return {f"view {number}": image for number, image in zip(seen.numbers, images, strict=True)}


def _input_names(seen: Seen) -> list[str]:
    return [f"input_{number}" for number in seen.numbers]


def _rerun_is_here() -> bool:
    if find_spec("rerun") is None:
        print("rerun is not installed: no render.rrd is written")
        return False
    return True
