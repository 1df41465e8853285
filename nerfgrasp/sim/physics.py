"""The frozen constants of the physics. A change of any of them changes every result, and the hash."""

import hashlib
import json
from dataclasses import asdict, dataclass, replace

from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper


@dataclass(frozen=True)
class Physics:
    """How grasps are carried out and judged. Metres, seconds, newtons."""

    time_step: float = 1 / 240
    """Of the simulation."""
    solver_iterations: int = 150
    """A step."""
    gravity: float = 9.81
    """Downwards."""
    object_friction: float = 0.5
    """Of objects; PyBullet multiplies the coefficients of the two bodies in touch."""
    pad_friction: float = 0.7
    """Of the gripper's pads."""
    pad_stiffness: float = 60000.0
    """N/m, of each point of contact with a pad. Rigid pads bear all their load in one corner, where it withstands
    no torque, and objects held off their centre swing down; rubber spreads it. Half as much would let a pad that
    presses on an edge in a single point sink in by more than 1 mm."""
    pad_damping: float = 1000.0
    """N s/m, likewise."""
    pad_anchor: bool = True
    """Whether a pad's friction holds a place, not only a speed: without, held objects creep."""
    table_friction: float = 1.0
    """Of the table."""
    rolling_friction: float = 1e-4
    """Of objects; without any, round ones roll for ever."""
    hand_force: float = 300.0
    """The most with which the hand is held on its path."""
    closing_force: float = 40.0
    """Of each finger."""
    gear_force: float = 50.0
    """The most with which the fingers are kept centred."""
    gear_erp: float = 0.1
    """How much of the fingers' difference is mended a step."""
    approach_distance: float = 0.075
    """From the pre-grasp to the grasp, along the approach."""
    approach_speed: float = 0.25
    """Of the hand on its way to the grasp."""
    approach_force: float = 5.0
    """More than this against an object or the table on that way is a collision."""
    approach_settle: float = 0.05
    """For the hand to come to rest at the grasp."""
    finger_speed: float = 0.1
    """Of each finger."""
    close_time: float = 0.6
    """For closing and settling."""
    lift_height: float = 0.1
    """Straight up."""
    lift_speed: float = 0.2
    """Of the hand on its way up."""
    hold_time: float = 1.0
    """After the lift, before the outcome is judged (or the shake begins)."""
    shake_distance: float = 0.0
    """Of a to-and-fro along each axis of the world after the hold: a stricter test, left out where zero."""
    shake_frequency: float = 3.0
    """Of the shake, a second."""
    shake_periods: int = 2
    """Along each axis."""
    success_height: float = 0.05
    """By which the object's centre of mass must have risen."""
    rest_speed: float = 0.01
    """Slower objects rest (m/s)."""
    rest_time: float = 0.25
    """Between tests of rest."""
    rest_tests: int = 8
    """At most, before the attempt goes on anyhow."""


PHYSICS = Physics()
"""The values of every reported result."""
SHAKEN = replace(PHYSICS, shake_distance=0.05)
"""The stricter test: accelerations of up to 8.9 m/s² along each axis before the outcome is judged."""


def physics_hash(physics: Physics = PHYSICS, gripper: Gripper = DEFAULT_GRIPPER) -> str:
    """Returns 16 hexadecimal digits that change with any constant of the physics or of the gripper.

    Example:
        >>> physics_hash() == physics_hash(Physics()) != physics_hash(Physics(object_friction=0.4))
        True
    """
    text = json.dumps([asdict(physics), gripper.settings()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
