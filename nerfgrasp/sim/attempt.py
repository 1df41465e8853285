"""One grasp attempt, from the pre-grasp to the verdict, and demonstrations that are known to lift."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nerfgrasp.scenes.gripper import ROBOTIQ_2F85, Gripper
from nerfgrasp.scenes.oracle import sample_top_down, valid_grasps
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.physics import PHYSICS, Physics
from nerfgrasp.sim.tasks import scene_generator, workspace
from nerfgrasp.sim.world import Hand, Pose, World

DEMONSTRATION_TRIES = 5
_DEMONSTRATION_STREAM = 20


class Outcome(StrEnum):
    """How an attempt ends: always in exactly one of these."""

    SUCCESS = "success"
    """Both pads touch the object, and its centre of mass is 50 mm above where it rested, 1 s after the lift."""
    NO_GRASP = "no_grasp"
    """The method proposed nothing."""
    OBJECT_COLLISION = "approach_collision_object"
    """The open gripper pressed on an object on its way."""
    TABLE_COLLISION = "approach_collision_table"
    """It pressed on the table on its way, or the grasp was refused because the gripper there would cut it."""
    NOTHING_BETWEEN_FINGERS = "nothing_between_fingers"
    """No object was touched by both closed fingers."""
    SLIPPED = "slipped"
    """An object was held, and was not when the lift was over."""


@dataclass(frozen=True)
class Attempt:
    """What became of one grasp."""

    outcome: Outcome
    """The verdict."""
    object: int | None = None
    """The number of the object that both fingers held once closed; None if there was none."""
    lifted: float = 0.0
    """Metres by which that object's centre of mass was above its place of rest at the end."""
    dropped: tuple[int, ...] = ()
    """The numbers of objects that are outside of the workspace at the end, seen from above."""


def attempt_grasp(
    truth: Truth,
    T_world_grasp: NDArray[np.floating] | Tensor,
    *,
    physics: Physics = PHYSICS,
    gripper: Gripper = ROBOTIQ_2F85,
) -> Attempt:
    """Carries a grasp out in a world built for it alone and reports how it ended.

    The open hand starts 75 mm back along its approach, goes straight to the grasp, closes, lifts, and holds for a
    second. Time is counted in simulation steps, so the outcome does not depend on the machine's load.

    Args:
        truth: the scene.
        T_world_grasp: `[4, 4]`.
        physics: constants of the simulation.
        gripper: that carries it out.
    """
    grasp = np.asarray(T_world_grasp, dtype=np.float64)
    if cuts_table(grasp, gripper):
        return Attempt(Outcome.TABLE_COLLISION)
    with World(truth.objects, physics) as world:
        world.settle()
        rest = world.centres()
        start = _shifted(grasp, -physics.approach_distance * grasp[:3, 2])
        hand = Hand(world, gripper, start)
        collision = _approach(world, hand, start, grasp)
        if collision is not None:
            return Attempt(collision, dropped=_dropped(world))
        hand.close()
        world.step(world.steps(physics.close_time))
        held = hand.held()
        if not held:
            return Attempt(Outcome.NOTHING_BETWEEN_FINGERS, dropped=_dropped(world))
        _lift(world, hand, grasp)
        return _verdict(world, hand, held[0], rest)


def demonstrate(truth: Truth) -> Tensor | None:
    """Returns `T_world_grasp` `[4, 4]` of a random valid top-down grasp that lifts its object.

    Up to five are drawn, from a random stream of the scene's own, and carried out; None where none lifts.
    """
    valid = valid_grasps(truth.objects)
    if len(valid) == 0:
        return None
    rng = scene_generator(truth.seed, truth.index, _DEMONSTRATION_STREAM)
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    for _ in range(DEMONSTRATION_TRIES):
        grasp = sample_top_down(valid, generator)
        if attempt_grasp(truth, grasp).outcome == Outcome.SUCCESS:
            return grasp
    return None


def cuts_table(T_world_grasp: NDArray[np.floating] | Tensor, gripper: Gripper = ROBOTIQ_2F85) -> bool:
    """Whether any part of the open gripper at a grasp `[4, 4]` lies below the table's top, z = 0."""
    return bool(gripper.lowest(torch.as_tensor(T_world_grasp)) < 0)


def _approach(world: World, hand: Hand, start: Pose, grasp: Pose) -> Outcome | None:
    """Moves the hand to the grasp; returns the collision that stopped it, or None."""
    count = world.steps(world.physics.approach_distance / world.physics.approach_speed)
    rest = world.steps(world.physics.approach_settle)
    for done in np.concatenate([np.linspace(0.0, 1.0, count + 1)[1:], np.ones(rest)]):
        hand.move_to(_shifted(start, done * (grasp[:3, 3] - start[:3, 3])))
        world.step()
        if world.touch(hand.body, world.table) > world.physics.approach_force:
            return Outcome.TABLE_COLLISION
        if any(world.touch(hand.body, body) > world.physics.approach_force for body in world.objects):
            return Outcome.OBJECT_COLLISION
    return None


def _lift(world: World, hand: Hand, grasp: Pose) -> None:
    physics = world.physics
    count = world.steps(physics.lift_height / physics.lift_speed)
    for height in np.linspace(0.0, physics.lift_height, count + 1)[1:]:
        hand.move_to(_shifted(grasp, np.array([0.0, 0.0, height])))
        world.step()
    world.step(world.steps(physics.hold_time))


def _verdict(world: World, hand: Hand, number: int, rest: NDArray[np.float64]) -> Attempt:
    lifted = float(world.centres()[number, 2] - rest[number, 2])
    success = number in hand.held() and lifted >= world.physics.success_height
    outcome = Outcome.SUCCESS if success else Outcome.SLIPPED
    return Attempt(outcome, number, lifted, _dropped(world))


def _dropped(world: World) -> tuple[int, ...]:
    low, high = (bound.double().numpy()[:2] for bound in (workspace.minimum, workspace.maximum))
    inside = ((world.centres()[:, :2] >= low) & (world.centres()[:, :2] <= high)).all(axis=1)
    return tuple(np.flatnonzero(~inside).tolist())


def _shifted(T: Pose, by: NDArray[np.float64]) -> Pose:
    moved = T.copy()
    moved[:3, 3] += by
    return moved
