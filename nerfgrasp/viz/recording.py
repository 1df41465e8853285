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
from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search.ascent import Trace
from nerfgrasp.viz.figures import Panel
from nerfgrasp.viz.gripper import gripper_strip
from nerfgrasp.viz.renderings import RenderedView, grey_outside

TIMELINE = "iteration"
FRAMES = "frame"
"""The timeline of an orbit."""
MOST_CANDIDATES = 256
_WINNER, _BOX = (255, 106, 19), (150, 150, 160)
_CURVES = {"best": _WINNER, "median": (90, 130, 220)}


def record_search(
    path: Path,
    observations: Observations,
    workspace: Workspace,
    trace: Trace,
    grasps: Grasps,
    imagined: Sequence[Panel] = (),
) -> None:
    """Writes a search as an `.rrd` file that opens with its own blueprint.

    Args:
        path: the file.
        observations: the views that the search used.
        workspace: where it searched.
        trace: of the candidates; the best `MOST_CANDIDATES` of them are shown.
        grasps: the result, best first.
        imagined: renders, of one size and camera each.
    """
    names = [f"camera_{i}" for i in range(len(observations))]
    blueprint = _blueprint(len(observations), len(imagined))
    recording = _start("nerfgrasp_optimize", path, blueprint, workspace, observations, names)
    for i, panel in enumerate(imagined):
        _log_image(recording, f"world/imagined_{i}", panel.image, panel.camera)
    _log_trace(recording, trace)
    winner = gripper_strip(grasps.T_world_grasp[:1]).cpu().numpy()
    label = f"value {float(grasps.value[0]):.2f}"
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


def _log_trace(recording: rr.RecordingStream, trace: Trace) -> None:
    shown = trace.value[-1].nan_to_num(-torch.inf).topk(min(MOST_CANDIDATES, trace.value.shape[1])).indices
    strips = gripper_strip(trace.T_world_grasp[:, shown]).detach().cpu().numpy()
    colours = _colours(trace.value[:, shown].detach().cpu().numpy())
    for name, colour in _CURVES.items():
        recording.log(f"value/{name}", rr.SeriesLines(colors=[colour], names=[name], widths=[2.0]), static=True)
    for iteration, value in enumerate(trace.value.detach().cpu()):
        recording.set_time(TIMELINE, sequence=iteration)
        grippers = rr.LineStrips3D(strips[iteration], colors=colours[iteration], radii=[0.0007])
        recording.log("world/candidates", grippers)
        for name, number in (("best", value.max()), ("median", value.median())):
            recording.log(f"value/{name}", rr.Scalars([float(number)]))
    recording.reset_time()


def _colours(value: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours `[I, P, 4]` of values `[I, P]`, one scale over all iterations, outliers cut."""
    from matplotlib import colormaps

    low, high = np.nanquantile(value, [0.05, 1.0])
    share = np.clip((value - low) / max(high - low, 1e-6), 0.0, 1.0)
    return (colormaps["viridis"](share) * 255).astype(np.uint8)


def _size(workspace: Workspace) -> list[float]:
    return (workspace.maximum - workspace.minimum).tolist()


def _blueprint(views: int, imagined: int) -> rrb.Blueprint:
    """The 3D view left; images (the grasp drawn over each) and curves right."""
    names = [(f"world/camera_{i}", f"view {i + 1}") for i in range(views)]
    names += [(f"world/imagined_{i}", f"imagined {i + 1}") for i in range(imagined)]
    images = [
        rrb.Spatial2DView(origin=origin, contents=["$origin/**", "world/grasp"], name=name) for origin, name in names
    ]
    curves = rrb.TimeSeriesView(origin="value", name="value (logit, comparable within this scene only)")
    right = rrb.Vertical(rrb.Grid(*images), curves, row_shares=[2, 1])
    space = rrb.Spatial3DView(origin="world", name="search")
    layout = rrb.Horizontal(space, right, column_shares=[3, 2])
    return rrb.Blueprint(layout, rrb.TimePanel(timeline=TIMELINE, state="expanded"), collapse_panels=True)


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
