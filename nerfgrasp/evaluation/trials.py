"""Trying a method in a scene: look, propose, carry out, and again until the attempts or the objects are used up."""

import hashlib
import json
import time
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import pairwise
from typing import Any

import roma
import torch
from torch import Tensor

from nerfgrasp import __version__
from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.results import Row, Times
from nerfgrasp.geometry import Camera, is_rigid, make_pose
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper
from nerfgrasp.methods.interface import Method
from nerfgrasp.methods.loading import blaming, load_method
from nerfgrasp.methods.spec import MethodSpec
from nerfgrasp.registry import BASELINES, described
from nerfgrasp.scenes.images import IMAGE_SIZE
from nerfgrasp.scenes.objects import object_name
from nerfgrasp.scenes.oracle import grasp_errors, valid_grasps
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Grasps, Observations, Truth
from nerfgrasp.scenes.truth import truth_to_json
from nerfgrasp.search.ranking import alike
from nerfgrasp.sim.attempt import Attempt, Outcome, attempt_grasp
from nerfgrasp.sim.physics import PHYSICS, physics_hash
from nerfgrasp.sim.rendering import render_scene
from nerfgrasp.sim.tasks import Task, scene_cameras, scene_generator, workspace

VIEWS = 3
"""Pictures that a method is given."""
_PROPOSAL_STREAM = 1000
"""Attempt k of a scene draws from its stream 1000 + k."""
_MOST_ASKED = 1000
"""Grasps that a method is asked for at most, where all that it proposes have failed."""


@dataclass(frozen=True)
class Trials:
    """Everything that the results of an evaluation depend on, but for how many scenes there are."""

    task: Task
    """What draws the scenes."""
    seed: int
    """Of the scene set."""
    method: MethodSpec
    """The method, the folder of its model and its options."""
    model: str | None
    """Hash of the method's weights; None for a method without a model."""
    size: int = IMAGE_SIZE
    """Width and height of a picture in pixels."""
    catalogue: str | None = None
    """Hash of the catalogue that the objects come from."""
    search: str | None = None
    """Name and hash of the method's search strategy; None for a method without one."""
    gripper: Gripper = DEFAULT_GRIPPER
    """The hand that carries grasps out."""

    @property
    def set(self) -> str:
        """What the scenes of the task and the seed are called, e.g. `simple-100` or `novel-ycb-100`."""
        return "-".join([self.task.name, *([self.task.catalogue] if self.task.catalogue else []), str(self.seed)])

    def settings(self) -> dict[str, Any]:
        """Returns as JSON data what tells these trials from others; where folders lie does not."""
        named = {name: getattr(self, name) for name in ("set", "seed", "model", "size", "catalogue", "search")}
        method = {"method": self.method.name, "options": self.method.options}
        return {
            "task": self.task.name,
            **named,
            **method,
            "physics": physics_hash(PHYSICS, self.gripper),
            "versions": versions(),
        }


def versions() -> dict[str, str]:
    """Returns the versions that results depend on."""
    return {"nerfgrasp": __version__, "torch": version("torch"), "pybullet": version("pybullet")}


def run_scene(trials: Trials, scene: int) -> list[tuple[Row, Times]]:
    """Returns every attempt of a method in one scene; a pure function of its arguments, but for the times.

    Each attempt looks anew, at what the last one left, and draws from a random stream of its own. After an object
    was lifted it is gone; the scene ends when the table is empty. What failed since the last success is not repeated
    while the method has anything else: of the grasps that it proposes, the best one that is not nearly the same is
    carried out.

    Raises:
        UserError: the method cannot be loaded, fails, or proposes what is no pose.
    """
    method = load_method(trials.method)
    truth, attempts = trials.task.draw(trials.seed, scene), []
    failed: list[Tensor] = []
    for number in range(trials.task.attempts):
        if not truth.objects:
            break
        row, times, after = _try(trials, method, truth, number, failed)
        attempts.append((row, times))
        if after.outcome == Outcome.SUCCESS:
            failed = []
        elif row.grasp is not None:
            failed.append(recorded_pose(row.grasp))
        truth = replace(truth, objects=after.after, demonstration=None)
    return attempts


def first_scene_hash(trials: Trials) -> str:
    """Returns the hash of the set's first scene, as its first attempt meets it."""
    truth = trials.task.draw(trials.seed, 0)
    return scene_hash(truth, scene_cameras(trials.seed, 0, VIEWS, trials.size))


def scene_hash(truth: Truth, camera: Camera) -> str:
    """Returns 16 hexadecimal digits over the objects, where they lie, and the cameras that look at them."""
    cameras = {
        "intrinsics": camera.intrinsics.double().tolist(),
        "T_world_camera": camera.T_world_camera.double().tolist(),
        "size": [camera.width, camera.height],
    }
    text = json.dumps([truth_to_json(replace(truth, demonstration=None)), cameras], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def recorded_pose(grasp: dict[str, list[float]]) -> Tensor:
    """Returns `T_world_grasp` `[4, 4]`, double, of a row's grasp: exactly what was carried out."""
    position, quaternion = (torch.tensor(grasp[key], dtype=torch.float64) for key in ("position", "quaternion"))
    return make_pose(roma.unitquat_to_rotmat(quaternion), position)


def _try(trials: Trials, method: Method, truth: Truth, number: int, failed: list[Tensor]) -> tuple[Row, Times, Attempt]:
    """Makes one attempt, number `number` of a scene, in the scene as it is now; grasps that failed are not repeated."""
    camera = scene_cameras(truth.seed, truth.index, VIEWS, trials.size)
    clock = [time.perf_counter()]
    where = f"scene {truth.index}, attempt {number}"
    with blaming(trials.method.name, where):
        needs = frozenset(method.needs)
    observations = observe(truth, camera, needs)
    clock.append(time.perf_counter())
    with blaming(trials.method.name, where):
        grasps = _untried(method, observations, (truth.seed, truth.index, number), failed)
    clock.append(time.perf_counter())
    grasp, value = _recorded(grasps, f"{described(BASELINES, trials.method.name)}, {where}")
    attempt = _carry_out(truth, grasp, trials.gripper)
    clock.append(time.perf_counter())
    row = Row(
        set=trials.set,
        task=trials.task.name,
        seed=trials.seed,
        scene=truth.index,
        attempt=number,
        method=trials.method.name,
        model=trials.model,
        scene_sha256=scene_hash(truth, camera),
        physics=physics_hash(PHYSICS, trials.gripper),
        objects=tuple(map(object_name, truth.objects)),
        grasp=grasp,
        value=value,
        outcome=str(attempt.outcome),
        object=attempt.object,
        lifted_mm=1000 * attempt.lifted,
        dropped=attempt.dropped,
        errors=None if grasp is None else pose_errors(truth, recorded_pose(grasp), trials.gripper),
        versions=versions(),
        search=trials.search,
        gripper=None if trials.gripper == DEFAULT_GRIPPER else trials.gripper.name,
        options=trials.method.options or None,
    )
    return row, Times(truth.index, number, *(after - before for before, after in pairwise(clock))), attempt


def proposal_generator(seed: int, index: int, attempt: int) -> torch.Generator:
    """Returns the generator that a method draws from in one attempt, a function of the three alone."""
    rng = scene_generator(seed, index, _PROPOSAL_STREAM + attempt)
    return torch.Generator().manual_seed(int(rng.integers(2**63)))


def observe(truth: Truth, camera: Camera, needs: frozenset[str] = frozenset()) -> Observations:
    """Returns what a method may see: RGB, and only if it declares so, by its `needs`, depth or the truth."""
    depth = None
    if "depth" in needs:
        images, _, metres = render_scene(truth, camera, depth=True)
        depth = torch.from_numpy(metres)
    else:
        images, _ = render_scene(truth, camera)
    colours = (torch.from_numpy(images).movedim(-1, -3) / 255).contiguous()
    return Observations(colours, camera, depth, truth if "truth" in needs else None)


def _untried(method: Method, observations: Observations, attempt: tuple[int, int, int], failed: list[Tensor]) -> Grasps:
    """Returns what a method proposes, less what is nearly the same as a grasp that failed; all, if it has no others.

    Many grasps that differ may be like one that failed. So while all of them are, twice as many are asked for, of the
    same random stream, until no more come.
    """
    count = 1 + len(failed)
    while True:
        grasps = method.propose(observations, workspace, generator=proposal_generator(*attempt), count=count)
        _check(grasps)
        if len(grasps) == 0 or not failed:
            return grasps
        T = grasps.T_world_grasp.detach().cpu().double()
        again = alike(T[:, None], torch.stack(failed)).any(dim=1)
        kept = torch.nonzero(~again)[:, 0]
        if len(kept):
            return Grasps(T[kept], grasps.value.detach().cpu()[kept])
        if len(grasps) < count or count >= _MOST_ASKED:
            return grasps
        count = min(2 * count, _MOST_ASKED)


def _check(grasps: object) -> None:
    """Checks the form of what a stranger's method returned; what the best grasp is worth is seen later."""
    if not isinstance(grasps, Grasps):
        raise TypeError(f"propose returned {type(grasps).__name__}, not Grasps")
    poses, values = tuple(grasps.T_world_grasp.shape), tuple(grasps.value.shape)
    if len(values) != 1 or poses != (*values, 4, 4):
        raise ValueError(f"propose returned poses {poses} and values {values}, not [N, 4, 4] and [N]")


def _recorded(grasps: Grasps, where: str) -> tuple[dict[str, list[float]] | None, float | None]:
    """Returns the best grasp as results keep it, and its value; None for both if there is none."""
    if len(grasps) == 0:
        return None, None
    T, value = grasps.T_world_grasp[0].detach().cpu().double(), grasps.value[0].detach().cpu().double()
    if not (T.isfinite().all() and value.isfinite() and is_rigid(T)):
        raise UserError(f"{where}: it proposed what is no pose, or a value that is no number (the plug-in is at fault)")
    quaternion = roma.rotmat_to_unitquat(T[:3, :3])
    return {"position": T[:3, 3].tolist(), "quaternion": quaternion.tolist()}, float(value)


def _carry_out(truth: Truth, grasp: dict[str, list[float]] | None, gripper: Gripper) -> Attempt:
    if grasp is None:
        return Attempt(Outcome.NO_GRASP, after=truth.objects, remaining=tuple(range(len(truth.objects))))
    return attempt_grasp(truth, recorded_pose(grasp), gripper=gripper)


def pose_errors(truth: Truth, T_world_grasp: Tensor, gripper: Gripper = DEFAULT_GRIPPER) -> dict[str, float] | None:
    """Returns the errors of a grasp `[4, 4]` to the nearest valid one: `distance_mm` and `angle_deg`.

    None where one of the objects is no prism, or there is no valid grasp.
    """
    prisms = [thing for thing in truth.objects if isinstance(thing, Prism)]
    valid = valid_grasps(prisms, gripper)
    if len(prisms) < len(truth.objects) or len(valid) == 0:
        return None
    distance, angle = grasp_errors(T_world_grasp, valid)
    return {"distance_mm": 1000 * float(distance), "angle_deg": float(torch.rad2deg(angle))}
