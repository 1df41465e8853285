"""Attempts of a results file, carried out again: what each met, what the method saw, and how it went."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.results import Row
from nerfgrasp.evaluation.trials import VIEWS, observe, recorded_pose, scene_hash
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper
from nerfgrasp.scenes.images import IMAGE_SIZE
from nerfgrasp.scenes.scene import Observations, Truth
from nerfgrasp.sim.attempt import Outcome
from nerfgrasp.sim.film import Frame, film_grasp
from nerfgrasp.sim.physics import PHYSICS, physics_hash
from nerfgrasp.sim.tasks import Task, scene_cameras


@dataclass(frozen=True)
class Replay:
    """One attempt, made again."""

    row: Row
    """What results tell of it."""
    truth: Truth
    """The scene as it met it."""
    observations: Observations
    """The RGB images that the method was given."""
    frames: tuple[Frame, ...]
    """How it went; `untouched` alone if there was no grasp."""


def replay_scene(
    task: Task, rows: Sequence[Row], size: int = IMAGE_SIZE, gripper: Gripper = DEFAULT_GRIPPER
) -> Iterator[Replay]:
    """Yields the attempts of one scene, each in what the one before left.

    Args:
        task: what drew the scene.
        rows: of one run and scene, from the first attempt on.
        size: width and height of the pictures in pixels.
        gripper: the hand that carried the grasps out.

    Raises:
        UserError: the rows are of another physics, objects or pictures, or an attempt ends otherwise now.
    """
    truth = task.draw(rows[0].seed, rows[0].scene)
    camera = scene_cameras(truth.seed, truth.index, VIEWS, size)
    for row in rows:
        where = f"scene {row.scene}, attempt {row.attempt}"
        if row.physics != (here := physics_hash(PHYSICS, gripper)):
            with_hand = f"this program's with the gripper {gripper.name} is {here}"
            raise UserError(f"{where} is of physics {row.physics}: {with_hand}")
        if row.scene_sha256 != scene_hash(truth, camera):
            raise UserError(f"{where} had other objects, or pictures of another size than {size} (--size)")
        frames: tuple[Frame, ...]
        if row.grasp is None:
            outcome, after, frames = str(Outcome.NO_GRASP), truth.objects, (Frame("untouched", truth),)
        else:
            attempt, frames = film_grasp(truth, recorded_pose(row.grasp), gripper=gripper)
            outcome, after = str(attempt.outcome), attempt.after
        if row.outcome != outcome:
            raise UserError(f"{where} ended as {row.outcome}, and ends as {outcome} now; made with {row.versions}")
        yield Replay(row, truth, observe(truth, camera), frames)
        truth = replace(truth, objects=after, demonstration=None)
