"""Rerun recordings: a search and its candidates, rendered views with their depth, and pictures of a training."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import torch
from numpy.typing import NDArray
from torch import Tensor

from nerfgrasp.geometry import Camera
from nerfgrasp.grippers import Gripper
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search.ascent import Trace
from nerfgrasp.search.ranking import alike, grasp_angle
from nerfgrasp.viz.gripper import gripper_strip
from nerfgrasp.viz.renderings import RenderedView, grey_outside

TIMELINE = "iteration"
FRAMES = "frame"
"""The timeline of an orbit."""
MOST_CANDIDATES = 256
PSI, WITH_FEASIBILITY = "Ψ", "Ψ and feasibility"
"""What a grasp's value is: the learned value alone, or with what the model's density adds."""
CURVES_TITLE = f"{PSI} during the climb (logit, comparable within this scene only)"
_LEVER = 0.05
"""Metres from the tool centre point at which a turn counts as much as a shift."""
_WINNER, _BOX = (255, 106, 19), (150, 150, 160)
_CURVES = {"winner": _WINNER, "best": (225, 185, 60), "median": (90, 130, 220)}
"""Of the candidate that became the result, and over all candidates at each iteration."""


def record_search(
    path: Path,
    observations: Observations,
    workspace: Workspace,
    trace: Trace,
    grasps: Grasps,
    imagined: Mapping[str, RenderedView] | None = None,
    *,
    gripper: Gripper,
    judged: str = PSI,
) -> None:
    """Writes a search's climb, and the best grasp found, as an `.rrd` file that opens with its own blueprint.

    Args:
        path: the file.
        observations: the views that the search used.
        workspace: where it searched.
        trace: of the candidates' climb, by Ψ; the best `MOST_CANDIDATES` of them are shown.
        grasps: the result, best first.
        imagined: what the model renders, by name, see `nerfgrasp.viz.imagination`.
        gripper: the hand to draw.
        judged: what the values of `grasps` are; those of the trace are Ψ alone.
    """
    imagined = imagined or {}
    names = [f"camera_{i}" for i in range(len(observations))]
    blueprint = _blueprint(names, list(imagined))
    recording = _start("nerfgrasp_optimize", path, blueprint, workspace, observations, names)
    for name, view in imagined.items():
        _log_view(recording, f"world/{name}", view, static=True)
    _log_trace(recording, trace, _winner(trace, grasps), gripper)
    winner = gripper_strip(grasps.T_world_grasp[:1], gripper).cpu().numpy()
    label = f"{judged} {float(grasps.value[0]):.2f}"
    recording.log("world/grasp", rr.LineStrips3D(winner, colors=[_WINNER], radii=[0.004], labels=[label]), static=True)
    _end(recording)


def record_views(
    path: Path, inputs: Observations, names: Sequence[str], workspace: Workspace, views: Mapping[str, RenderedView]
) -> None:
    """Writes rendered views as an `.rrd` file: each a camera with RGB, depth and, where it is known, the truth.

    Args:
        path: the file.
        inputs: the views that the model saw.
        names: of the inputs; entities are called by them.
        workspace: where the scene is.
        views: by name, each other than the inputs'.
    """
    recording = _start("nerfgrasp_render", path, _views_blueprint(views), workspace, inputs, names)
    for name, view in views.items():
        _log_view(recording, f"world/{name}", view, static=True)
    _end(recording)


def record_orbit(
    path: Path, inputs: Observations, names: Sequence[str], workspace: Workspace, views: Sequence[RenderedView]
) -> None:
    """Writes an orbit as an `.rrd` file: one camera that moves over the timeline `frame`; otherwise as above."""
    space = rrb.Spatial3DView(origin="world", name="scene")
    layout = rrb.Horizontal(space, _view_layout("orbit", views[0]), column_shares=[3, 2])
    blueprint = rrb.Blueprint(layout, rrb.TimePanel(timeline=FRAMES, state="expanded"), collapse_panels=True)
    recording = _start("nerfgrasp_render", path, blueprint, workspace, inputs, names)
    for frame, view in enumerate(views):
        recording.set_time(FRAMES, sequence=frame)
        _log_view(recording, "world/orbit", view, static=False)
    _end(recording)


def _start(
    application: str,
    path: Path,
    blueprint: rrb.Blueprint,
    workspace: Workspace,
    inputs: Observations,
    names: Sequence[str],
) -> rr.RecordingStream:
    """Opens a recording that holds what all have: the world's axes, the workspace and the input views."""
    recording = rr.RecordingStream(application)
    recording.save(path, default_blueprint=blueprint)
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    box = rr.Boxes3D(mins=[workspace.minimum.tolist()], sizes=[_size(workspace)], colors=[_BOX], radii=[0.0005])
    recording.log("world/workspace", box, static=True)
    for name, image, i in zip(names, inputs.images.permute(0, 2, 3, 1), range(len(inputs)), strict=True):
        _log_image(recording, f"world/{name}", image, inputs.camera[i])
    return recording


def _end(recording: rr.RecordingStream) -> None:
    recording.flush()
    recording.disconnect()


def record_pictures(path: Path) -> rr.RecordingStream:
    """Opens an `.rrd` file for the pictures of a training; the caller disconnects it."""
    recording = rr.RecordingStream("nerfgrasp_fit")
    recording.save(path)
    return recording


def log_pictures(recording: rr.RecordingStream, entity: str, pictures: Mapping[str, Tensor], step: int) -> None:
    """Logs pictures `[H, W, 3]` in [0, 1] under `entity`, each by its name, on the timeline `step`."""
    recording.set_time("step", sequence=step)
    for name, picture in pictures.items():
        recording.log(f"{entity}/{name}", rr.Image(_bytes(picture)))


def _log_view(recording: rr.RecordingStream, entity: str, view: RenderedView, *, static: bool) -> None:
    _log_image(recording, entity, grey_outside(view.rgb, view.inside), view.camera, static=static)
    depth = torch.where(view.inside, view.depth, torch.zeros_like(view.depth)).detach().cpu().numpy()
    recording.log(f"{entity}/depth", rr.DepthImage(depth, meter=1.0), static=static)
    if view.truth is not None:
        recording.log(f"{entity}_truth/image", rr.Image(_bytes(view.truth)), static=static)


def _log_image(
    recording: rr.RecordingStream, entity: str, image: Tensor, camera: Camera, *, static: bool = True
) -> None:
    T = camera.T_world_camera.detach().cpu().numpy()
    recording.log(entity, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=static)
    pinhole = rr.Pinhole(
        image_from_camera=camera.intrinsics.detach().cpu().numpy(),
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.1,
    )
    recording.log(entity, pinhole, static=static)
    recording.log(f"{entity}/image", rr.Image(_bytes(image)), static=static)


def _bytes(image: Tensor) -> NDArray[np.uint8]:
    pixels: NDArray[np.uint8] = (image.detach().clamp(0.0, 1.0) * 255).round().byte().cpu().numpy()
    return pixels


def _winner(trace: Trace, grasps: Grasps) -> int | None:
    """The number of the candidate that ended nearest to the best grasp; None if none ended nearly there.

    What is polished after the climb moves on a little.
    """
    ends, best = trace.T_world_grasp[-1], grasps.T_world_grasp[0]
    moved = (ends[:, :3, 3] - best[:3, 3]).norm(dim=-1) + _LEVER * grasp_angle(ends[:, :3, :3], best[:3, :3])
    nearest = int(moved.argmin())
    return nearest if bool(alike(ends[nearest], best)) else None


def _log_trace(recording: rr.RecordingStream, trace: Trace, winner: int | None, gripper: Gripper) -> None:
    shown = trace.value[-1].nan_to_num(-torch.inf).topk(min(MOST_CANDIDATES, trace.value.shape[1])).indices
    strips = gripper_strip(trace.T_world_grasp, gripper).detach().cpu()
    value = trace.value.detach().cpu()
    colours = _colours(value[:, shown].numpy())
    curves = {"best": value.nan_to_num(-torch.inf).amax(dim=1), "median": value.nanmedian(dim=1).values}
    if winner is not None:
        curves["winner"] = value[:, winner]
    for name in curves:
        lines = rr.SeriesLines(colors=[_CURVES[name]], names=[name], widths=[2.0])
        recording.log(f"value/{name}", lines, static=True)
    for iteration in range(len(value)):
        recording.set_time(TIMELINE, sequence=iteration)
        grippers = rr.LineStrips3D(strips[iteration, shown].numpy(), colors=colours[iteration], radii=[0.0007])
        recording.log("world/candidates", grippers)
        if winner is not None:
            moving = rr.LineStrips3D(strips[iteration, winner, None].numpy(), colors=[_WINNER], radii=[0.0025])
            recording.log("world/winner", moving)
        for name, curve in curves.items():
            recording.log(f"value/{name}", rr.Scalars([float(curve[iteration])]))
    recording.reset_time()


def _colours(value: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours `[I, P, 4]` of values `[I, P]`, one scale over all iterations, outliers cut."""
    from matplotlib import colormaps

    low, high = np.nanquantile(value, [0.05, 1.0])
    share = np.clip((value - low) / max(high - low, 1e-6), 0.0, 1.0)
    return (colormaps["viridis"](share) * 255).astype(np.uint8)


def _size(workspace: Workspace) -> list[float]:
    return (workspace.maximum - workspace.minimum).tolist()


def _blueprint(views: Sequence[str], imagined: Sequence[str]) -> rrb.Blueprint:
    """The 3D view left; right the input views, what the model imagines (the grasp drawn over each) and the curves."""
    hidden = [f"- /world/{name}/depth" for name in imagined]  # as point clouds they would hide the candidates
    space = rrb.Spatial3DView(origin="world", contents=["$origin/**", *hidden], name="search")
    rows = [rrb.Horizontal(*[_with_grasp(name, "image", f"view {i + 1}") for i, name in enumerate(views)])]
    if imagined:
        titles = [(name, kind, f"{name}: {kind}".replace("_", " ")) for name in imagined for kind in ("image", "depth")]
        rows.append(rrb.Horizontal(*[_with_grasp(*each) for each in titles]))
    curves = rrb.TimeSeriesView(origin="value", name=CURVES_TITLE)
    right = rrb.Vertical(*rows, curves)
    layout = rrb.Horizontal(space, right, column_shares=[3, 2])
    return rrb.Blueprint(layout, rrb.TimePanel(timeline=TIMELINE, state="expanded"), collapse_panels=True)


def _with_grasp(name: str, kind: str, title: str) -> rrb.Spatial2DView:
    contents = ["$origin", f"$origin/{kind}", "/world/grasp"]
    return rrb.Spatial2DView(origin=f"world/{name}", contents=contents, name=title)


def _views_blueprint(views: Mapping[str, RenderedView]) -> rrb.Blueprint:
    """The 3D view left; a tab for each rendered view right."""
    tabs = rrb.Tabs(*[_view_layout(name, view) for name, view in views.items()])
    space = rrb.Spatial3DView(origin="world", name="scene")
    return rrb.Blueprint(rrb.Horizontal(space, tabs, column_shares=[3, 2]), collapse_panels=True)


def _view_layout(name: str, view: RenderedView) -> rrb.Container:
    shown = [("rendered", f"world/{name}/image"), ("depth", f"world/{name}/depth")]
    if view.truth is not None:
        shown.insert(0, ("truth", f"world/{name}_truth/image"))
    return rrb.Vertical(*[rrb.Spatial2DView(origin=origin, name=title) for title, origin in shown], name=name)
