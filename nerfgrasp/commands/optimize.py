"""`nerfgrasp optimize`: finds grasps in one scene."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import roma
import torch
from torch import Tensor

from nerfgrasp import __version__, registry
from nerfgrasp.commands.publishing import publishing
from nerfgrasp.commands.ranges import check_ranges
from nerfgrasp.devices import find_device
from nerfgrasp.errors import NoGraspError, UserError
from nerfgrasp.files import write_json
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper, find_gripper
from nerfgrasp.methods.loading import method_of
from nerfgrasp.methods.psi import Psi
from nerfgrasp.models.folder import DEFAULT_MODEL, find_model
from nerfgrasp.scenes.arrays import workspace_from_corners
from nerfgrasp.scenes.folder import read_scene
from nerfgrasp.scenes.scene import Grasps, Scene, Workspace
from nerfgrasp.scenes.shipped import find_scene
from nerfgrasp.scenes.truth import workspace_to_json
from nerfgrasp.search.ascent import Trace
from nerfgrasp.search.parameterization import DEFAULT_POSE, load_pose
from nerfgrasp.search.ranking import distinct
from nerfgrasp.search.strategies import DEFAULT_STRATEGY, Strategy, find_strategy
from nerfgrasp.viz.figures import picture
from nerfgrasp.viz.imagination import imagine, imagined_panels

VALUE_NOTE = "value is a logit, comparable within one scene only"
_HEADER = "rank  position x, y, z (m)      tilt (deg)   value"


def optimize(
    scene: str,
    *,
    model: str = DEFAULT_MODEL,
    strategy: str = DEFAULT_STRATEGY,
    pose: str = DEFAULT_POSE,
    candidates: int | None = None,
    keep: int | None = None,
    max_tilt: float | None = None,
    clearance: float | None = None,
    workspace: list[float] | None = None,
    device: str = "cpu",
    gripper: str | None = None,
    seed: int = 0,
    out: Path | None = None,
    execute: bool = False,
    count: int = 10,
    images: int | None = None,
    least_value: float | None = None,
) -> None:
    """Finds grasps in a scene by gradient ascent on a model's grasp value.

    Writes `grasps.json` (ranked), `picture.png` and `optimization.rrd` (open it with `rerun`), all or none.

    Args:
        scene: a scene's folder, or the name of a shipped one, e.g. `demo`.
        model: a model's folder, a Hugging Face repository id, or the name of a shipped one.
        strategy: how to search: `guided`, `resample`, `alone`, `joint`, `prune`, `paper` (the paper's Algorithm 1), or
            `halving`; see docs/search.md.
        pose: the registered name of the pose parameterization to climb in.
        candidates: how many random poses are drawn; the strategy's own number if not given.
        keep: how many of them, the best, go on; the strategy's own number if not given.
        max_tilt: by how much an approach may differ from straight down at most, degrees; 180 for any.
        clearance: to keep free between the open gripper and the table, metres.
        workspace: where to search in place of the scene's own box: `[x, y, z, x, y, z]`, its lower and its upper
            corner in metres; the lower face is the table.
        device: where to search: `cpu`, `cuda`, `mps`, or a numbered one, e.g. `cuda:1`.
        gripper: the hand that grasps: a registered gripper (`nerfgrasp plugins list`) or a YAML file
            (docs/grippers.md); the Robotiq 2F-85 if not given.
        seed: the same seed finds the same grasps.
        out: folder of the results; `SCENE-grasp` if not given.
        execute: carry the best grasp out in physics; for simulated scenes.
        count: how many different grasps to list at most.
        images: how many of the scene's images are used, from the front; up to three, or as many as the model needs,
            if not given.
        least_value: what a grasp must be worth, for a model trained with the loss `binary`: others' values compare
            within one scene only. If none is, nothing is written and the exit status is 1.

    Raises:
        UserError: something asked for is not there, is damaged or cannot be written.
        NoGraspError: no grasp is worth `least_value`.
    """
    check_ranges(count=count, seed=seed, images=images)
    chosen = find_strategy(strategy, candidates=candidates, keep=keep, max_tilt=max_tilt, clearance=clearance)
    hand = DEFAULT_GRIPPER if gripper is None else find_gripper(gripper)
    find_device(device)
    found = read_scene(find_scene(scene))
    found = found if workspace is None else replace(found, workspace=_box(workspace))
    load_pose(pose, found.workspace)
    attempt = _attempt_in_physics(found, hand) if execute else None
    folder = find_model(model)
    destination = Path(f"{found.name}-grasp") if out is None else Path(out)
    with publishing(destination) as results:
        method = _load_method(model, folder, device=device, images=images, gripper=hand)
        if least_value is not None:
            method.check_least(least_value)
        asked = _Search(found, model, method, method.resolve(chosen), pose, seed, count, attempt, least_value)
        if asked.strategy.name != strategy:
            print(f"the model never learned to render, so {strategy} cannot guide its search", flush=True)
        _search_and_write(asked, results)
        written = [path.name for path in sorted(results.iterdir())]
    print(f"wrote {', '.join(written)} to {destination}")


@dataclass(frozen=True)
class _Search:
    """What was asked for, once it has been checked."""

    scene: Scene
    model: str
    method: Psi
    strategy: Strategy
    """What the method runs, which may differ from what was asked for."""
    pose: str
    seed: int
    count: int
    attempt: Callable[[Tensor], str] | None
    """What carries a grasp out, if that is to be done."""
    least_value: float | None
    """What a grasp must be worth."""


def _search_and_write(asked: _Search, folder: Path) -> None:
    """Searches, prints what is found, carries the best grasp out, and writes all files."""
    scene, method, strategy = asked.scene, asked.method, asked.strategy
    observed = method.observe(scene.observations, scene.workspace)
    print(f"searching {scene.name}: {strategy.name}, {strategy}", flush=True)
    generator = torch.Generator().manual_seed(asked.seed)
    climbed, trace = method.search(observed, generator=generator, pose=asked.pose, strategy=strategy)
    grasps = _worth(asked, distinct(climbed.to("cpu"), count=asked.count))
    print("\n".join(table(grasps)), flush=True)
    settings = {"scene": scene.name, "model": asked.model, "pose": asked.pose, "seed": asked.seed}
    settings["gripper"] = method.gripper.name
    settings |= {**strategy.settings(), "workspace": workspace_to_json(scene.workspace)}
    data = to_json(grasps, settings)
    if asked.attempt is not None:
        data["grasps"][0]["outcome"] = asked.attempt(grasps.T_world_grasp[0])
        print(f"the best grasp, carried out in physics: {data['grasps'][0]['outcome']}", flush=True)
    _write(folder, asked, grasps, trace.to("cpu"), data)


def _worth(asked: _Search, grasps: Grasps) -> Grasps:
    """Returns the grasps that are worth what was asked for."""
    if asked.least_value is None:
        return grasps
    kept = asked.method.at_least(grasps, asked.least_value)
    if len(kept) == 0:
        raise NoGraspError(
            f"scene {asked.scene.name}: the best grasp is worth {float(grasps.value[0]):.2f}, less than the "
            f"{asked.least_value:g} asked for"
        )
    return kept


def table(grasps: Grasps) -> list[str]:
    """Returns the lines of a ranked table of grasps."""
    rows = [_HEADER]
    for rank, (T, value) in enumerate(zip(grasps.T_world_grasp, grasps.value.tolist(), strict=True), start=1):
        x, y, z = T[:3, 3].tolist()
        rows.append(f"{rank:4d}  {x:8.3f} {y:8.3f} {z:8.3f}  {tilt_degrees(T):10.1f}  {value:8.2f}")
    return [*rows, f"({VALUE_NOTE})"]


def tilt_degrees(T_world_grasp: Tensor) -> float:
    """Returns the angle between a grasp's approach and straight down, in degrees."""
    return float(torch.rad2deg(torch.arccos((-T_world_grasp[2, 2]).clamp(-1.0, 1.0))))


def to_json(grasps: Grasps, settings: dict[str, Any]) -> dict[str, Any]:
    """Returns what `grasps.json` holds: how the grasps came about, then the grasps, best first."""
    header = {
        "format": 1,
        **settings,
        "versions": {"nerfgrasp": __version__, "torch": version("torch")},
        "frame": "world, metres; origin at the tool centre point, +z approach, +x closing axis; quaternion xyzw",
        "note": VALUE_NOTE,
    }
    T_world_grasp = grasps.T_world_grasp.double()
    quaternion = roma.rotmat_to_unitquat(T_world_grasp[:, :3, :3])
    rows = [
        {"rank": rank, "position": T[:3, 3].tolist(), "quaternion": q.tolist(), "T_world_grasp": T.tolist(), "value": v}
        for rank, (T, q, v) in enumerate(zip(T_world_grasp, quaternion, grasps.value.tolist(), strict=True), start=1)
    ]
    return {**header, "grasps": rows}


def _box(numbers: list[float]) -> Workspace:
    if len(numbers) != 6:
        raise UserError(
            f"workspace is {len(numbers)} numbers: it takes six, the box's lower and upper corner in metres"
        )
    return workspace_from_corners(numbers[:3], numbers[3:])


def _load_method(name: str, folder: Path, **options: Any) -> Psi:
    """Loads a model by the method that its folder names."""
    method = method_of(folder, name)
    kind = registry.load(registry.BASELINES, method)
    if not (isinstance(kind, type) and issubclass(kind, Psi)):
        raise UserError(f"model {name}: its method {method!r} does not search by gradient ascent")
    return kind.from_pretrained(str(folder), **options)


def _attempt_in_physics(scene: Scene, gripper: Gripper) -> Callable[[Tensor], str]:
    """Returns what carries a grasp `[4, 4]` out and names the outcome; fails before the search if it cannot."""
    truth = scene.truth
    if truth is None:
        raise UserError(f"scene {scene.name}: --execute needs a simulated scene, which says what it is made of")
    from nerfgrasp.sim.attempt import attempt_grasp

    return lambda T_world_grasp: str(attempt_grasp(truth, T_world_grasp, gripper=gripper).outcome)


def _write(folder: Path, asked: _Search, grasps: Grasps, trace: Trace, data: dict[str, Any]) -> None:
    scene, method = asked.scene, asked.method
    used = scene.observations.select(slice(method.images))
    renders = method.model.config.renders
    imagined = imagine(method.model, used, scene.workspace, grasps.T_world_grasp[0]) if renders else {}
    write_json(folder / "grasps.json", data, indent=2)
    picture(used, grasps, method.gripper, imagined_panels(imagined), _facts(grasps, data)).save(folder / "picture.png")
    if find_spec("rerun") is None:
        print("rerun is not installed: no optimization.rrd is written")
        return
    from nerfgrasp.viz.recording import PSI, WITH_FEASIBILITY, record_search

    judged = PSI if asked.strategy.feasibility is None else WITH_FEASIBILITY
    record_search(
        folder / "optimization.rrd",
        used,
        scene.workspace,
        trace,
        grasps,
        imagined,
        gripper=method.gripper,
        judged=judged,
    )


def _facts(grasps: Grasps, data: dict[str, Any]) -> list[str]:
    best = data["grasps"][0]
    x, y, z = best["position"]
    tilt = tilt_degrees(grasps.T_world_grasp[0])
    facts = ["best grasp", f"at {x:.3f}, {y:.3f}, {z:.3f} m", f"{tilt:.1f}° from straight down"]
    facts += [f"value {best['value']:.2f}", "(a logit, comparable within this scene only)"]
    return facts + ([f"in physics: {best['outcome']}"] if "outcome" in best else [])
