"""One grasp attempt, from the pre-grasp to the verdict, and demonstrations that are known to lift."""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper
from nerfgrasp.scenes.objects import SceneObject
from nerfgrasp.scenes.oracle import sample_top_down, valid_grasps
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.bullet import Pose
from nerfgrasp.sim.hand import Hand
from nerfgrasp.sim.physics import PHYSICS, Physics
from nerfgrasp.sim.settling import moved, rest
from nerfgrasp.sim.tasks import scene_generator, workspace
from nerfgrasp.sim.world import World

DEMONSTRATION_TRIES = 5
_UP = np.array([0.0, 0.0, 1.0])
_DEMONSTRATION_STREAM = 20

Observer = Callable[[str, World, Hand], None]
"""Told of each stage once it is reached: `pregrasp`, `grasp` or else `collision`, `closed`, `lifted`, `held`. It may
look at the world and the hand, and must not change them."""


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
    """The numbers of the objects that lie outside of the workspace once all is over, seen from above."""
    after: tuple[SceneObject, ...] = field(default=(), compare=False)
    """What remains on the table, at rest, once the hand is gone: all but the object that was lifted and those that
    were dropped, in the scene's order."""
    remaining: tuple[int, ...] = ()
    """Their numbers in the scene."""


@dataclass(frozen=True)
class _Verdict:
    """What the hand's part of an attempt came to."""

    outcome: Outcome
    object: int | None = None
    lifted: float = 0.0


def attempt_grasp(
    truth: Truth,
    T_world_grasp: NDArray[np.floating] | Tensor,
    *,
    physics: Physics = PHYSICS,
    gripper: Gripper = DEFAULT_GRIPPER,
    observe: Observer | None = None,
) -> Attempt:
    """Carries a grasp out in a world built for it alone and reports how it ended.

    The open hand starts 75 mm back along its approach, goes straight to the grasp, closes, lifts, and holds for a
    second (and is shaken, where the physics says so). A grasp is refused unexecuted only where the open gripper at it
    would cut the table; whatever it meets on its way is met in physics, with a limited force, and named in the
    outcome. At the end the hand vanishes where it is, a lifted object with it, and all else comes to rest. Time is
    counted in simulation steps, so the outcome does not depend on the machine's load.

    Args:
        truth: the scene.
        T_world_grasp: `[4, 4]`.
        physics: constants of the simulation.
        gripper: that carries it out.
        observe: watches the stages; a grasp that is refused has none.
    """
    grasp = np.asarray(T_world_grasp, dtype=np.float64)
    if cuts_table(grasp, gripper):
        return Attempt(Outcome.TABLE_COLLISION, after=truth.objects, remaining=tuple(range(len(truth.objects))))
    with World(truth.objects, physics) as world:
        world.settle()
        pregrasp = grasp.copy()
        pregrasp[:3, 3] -= physics.approach_distance * grasp[:3, 2]
        hand = Hand(world, gripper, pregrasp)
        verdict = _carry_out(world, hand, grasp, observe or _unobserved)
        hand.remove()
        return _aftermath(truth, world, verdict)


def demonstrate(truth: Truth, gripper: Gripper = DEFAULT_GRIPPER) -> Tensor | None:
    """Returns `T_world_grasp` `[4, 4]` of a random valid top-down grasp that lifts its object.

    Draws up to five grasps from the scene's own random stream and carries them out. Returns None if none of them lifts.
    """
    valid = valid_grasps(truth.objects, gripper)
    if len(valid) == 0:
        return None
    rng = scene_generator(truth.seed, truth.index, _DEMONSTRATION_STREAM)
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    for _ in range(DEMONSTRATION_TRIES):
        grasp = sample_top_down(valid, generator)
        if attempt_grasp(truth, grasp, gripper=gripper).outcome == Outcome.SUCCESS:
            return grasp
    return None


def cuts_table(T_world_grasp: NDArray[np.floating] | Tensor, gripper: Gripper) -> bool:
    """Whether any part of the open gripper at a grasp `[4, 4]` lies below the table's top, z = 0."""
    return bool(gripper.lowest(torch.as_tensor(T_world_grasp)) < 0)


def _unobserved(stage: str, world: World, hand: Hand) -> None:
    """Watches nothing."""


def _carry_out(world: World, hand: Hand, grasp: Pose, observe: Observer) -> _Verdict:
    """Moves the hand to the grasp, closes, lifts and holds; the first that fails ends it."""
    physics, rest = world.physics, world.centres()
    observe("pregrasp", world, hand)
    collision = _approach(world, hand, grasp)
    observe("grasp" if collision is None else "collision", world, hand)
    if collision is not None:
        return _Verdict(collision)
    hand.close()
    world.step(world.steps(physics.close_time))
    observe("closed", world, hand)
    held = hand.held()
    if not held:
        return _Verdict(Outcome.NOTHING_BETWEEN_FINGERS)
    _lift(world, hand, grasp)
    observe("lifted", world, hand)
    _hold(world, hand, grasp)
    observe("held", world, hand)
    lifted = float(world.centres()[held[0], 2] - rest[held[0], 2])
    success = held[0] in hand.held() and lifted >= physics.success_height
    return _Verdict(Outcome.SUCCESS if success else Outcome.SLIPPED, held[0], lifted)


def _approach(world: World, hand: Hand, grasp: Pose) -> Outcome | None:
    """Moves the hand straight to the grasp; returns the collision that stopped it, or None."""
    physics = world.physics
    start = grasp[:3, 3] - physics.approach_distance * grasp[:3, 2]
    count = world.steps(physics.approach_distance / physics.approach_speed)
    rest = world.steps(physics.approach_settle)
    for done in np.concatenate([np.linspace(0.0, 1.0, count + 1)[1:], np.ones(rest)]):
        hand.move_to(start + done * (grasp[:3, 3] - start))
        world.step()
        if world.touch(hand.body, world.table) > physics.approach_force:
            return Outcome.TABLE_COLLISION
        if any(world.touch(hand.body, body) > physics.approach_force for body in world.objects):
            return Outcome.OBJECT_COLLISION
    return None


def _lift(world: World, hand: Hand, grasp: Pose) -> None:
    """Moves the hand straight up."""
    physics = world.physics
    count = world.steps(physics.lift_height / physics.lift_speed)
    for height in np.linspace(0.0, physics.lift_height, count + 1)[1:]:
        hand.move_to(grasp[:3, 3] + height * _UP)
        world.step()


def _hold(world: World, hand: Hand, grasp: Pose) -> None:
    """Holds still and, where the physics asks for it, shakes."""
    physics = world.physics
    world.step(world.steps(physics.hold_time))
    if physics.shake_distance:
        _shake(world, hand, grasp[:3, 3] + physics.lift_height * _UP)


def _shake(world: World, hand: Hand, centre: NDArray[np.float64]) -> None:
    """Moves the hand to and fro along each of the world's axes in turn, starting and ending at rest."""
    physics = world.physics
    count = world.steps(physics.shake_periods / physics.shake_frequency)
    phase = np.linspace(0.0, 2 * np.pi * physics.shake_periods, count + 1)[1:]
    for axis in np.eye(3):
        for offset in physics.shake_distance * (1 - np.cos(phase)) / 2:
            hand.move_to(centre + offset * axis)
            world.step()


def _aftermath(truth: Truth, world: World, verdict: _Verdict) -> Attempt:
    """Takes a lifted object off the world and waits until the others rest."""
    numbers = list(range(len(truth.objects)))
    if verdict.outcome == Outcome.SUCCESS and verdict.object is not None:
        world.remove(numbers.pop(verdict.object))
    rest(world)
    left = moved([truth.objects[number] for number in numbers], world)
    inside = _inside(world.centres())
    return Attempt(
        verdict.outcome,
        verdict.object,
        verdict.lifted,
        dropped=tuple(number for number, stays in zip(numbers, inside, strict=True) if not stays),
        after=tuple(thing for thing, stays in zip(left, inside, strict=True) if stays),
        remaining=tuple(number for number, stays in zip(numbers, inside, strict=True) if stays),
    )


def _inside(centres: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns for each centre of mass `[N, 3]` whether it is within the workspace, seen from above."""
    low, high = (bound.double().numpy()[:2] for bound in (workspace.minimum, workspace.maximum))
    return np.all((centres[:, :2] >= low) & (centres[:, :2] <= high), axis=1)
