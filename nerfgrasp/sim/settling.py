"""How objects come to lie where a scene shows them: dropped, piled up or pushed together, then left to rest.

Time is counted in simulation steps, so the same objects come to rest in the same poses on every call.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from nerfgrasp.scenes.objects import SceneObject
from nerfgrasp.sim.bullet import p
from nerfgrasp.sim.physics import PHYSICS, Physics
from nerfgrasp.sim.world import World

Thing = TypeVar("Thing", bound=SceneObject)

DROP_HEIGHT = 0.03
"""Metres between an object let go and what lies below the highest point so far."""
REST_TURN = 0.1
"""Objects that turn more slowly rest (rad/s)."""
REST_TESTS = 40
"""Tests of rest, at most: 10 s."""
STABLE_TIME = 1.0
"""Seconds for which stable objects do not move by more than"""
STABLE_SHIFT = 0.001
"""metres along any axis, or turn by more than"""
STABLE_TURN = 0.0175
"""radians."""
PUSH = 8.0
"""m/s² with which objects are pushed: friction takes 4.9 of them."""
PUSH_SPEED = 0.15
"""m/s above which they are not."""
PUSH_TIME = 1.5
"""Seconds."""


def drop(objects: tuple[Thing, ...], physics: Physics = PHYSICS) -> tuple[Thing, ...]:
    """Lets objects go, all at once, from the poses given and returns them at rest (or after 10 s)."""
    with World(objects, physics) as world:
        rest(world)
        return moved(objects, world)


def pile(objects: tuple[Thing, ...], physics: Physics = PHYSICS) -> tuple[Thing, ...]:
    """Drops objects one after another, each from just above all that lies there; returns them at rest.

    An object keeps its orientation and its x and y; its height is found.
    """
    with World((), physics) as world:
        for number, thing in enumerate(objects):
            world.add(thing)
            _lift_above(world, number)
            rest(world)
        return moved(objects, world)


def huddle(objects: tuple[Thing, ...], physics: Physics = PHYSICS) -> tuple[Thing, ...]:
    """Lets objects rest, pushes them all towards the workspace's centre, and returns them at rest again."""
    with World(objects, physics) as world:
        rest(world)
        for _ in range(world.steps(PUSH_TIME)):
            _push(world)
            world.step()
        rest(world)
        return moved(objects, world)


def rest(world: World) -> None:
    """Waits until all objects rest at two tests in a row: one at the top of its path is slow as well."""
    calm = 0
    for _ in range(REST_TESTS):
        world.step(world.steps(world.physics.rest_time))
        calm = calm + 1 if _calm(world) else 0
        if calm == 2:
            return


def stable(objects: Sequence[SceneObject], physics: Physics = PHYSICS) -> bool:
    """Whether objects stay where they are in a world built anew, to 1 mm and 1°, for a second.

    One that balances on an edge may be slow enough to count as resting, and fall over all the same.
    """
    with World(objects, physics) as world:
        before = world.poses()
        world.step(world.steps(STABLE_TIME))
        change = np.abs(world.poses() - before)
    return bool((change[:, :3, 3] <= STABLE_SHIFT).all() and (change[:, :3, :3] <= STABLE_TURN).all())


def moved(objects: Sequence[Thing], world: World) -> tuple[Thing, ...]:
    """Returns the objects where `world` has them."""
    poses = torch.from_numpy(world.poses()).float()
    return tuple(replace(thing, T_world_object=pose) for thing, pose in zip(objects, poses, strict=True))


def _calm(world: World) -> bool:
    for body in world.objects:
        linear, angular = p.getBaseVelocity(body, physicsClientId=world.client)
        if np.linalg.norm(linear) > world.physics.rest_speed or np.linalg.norm(angular) > REST_TURN:
            return False
    return True


def _bounds(world: World, body: int) -> NDArray[np.float64]:
    """Returns the lowest and the highest corner `[2, 3]` of a box around a body."""
    return np.array(p.getAABB(body, physicsClientId=world.client))


def _lift_above(world: World, number: int) -> None:
    body = world.objects[number]
    top = max((_bounds(world, other)[1, 2] for other in world.objects[:number]), default=0.0)
    (x, y, z), orientation = p.getBasePositionAndOrientation(body, physicsClientId=world.client)
    place = (x, y, z + top + DROP_HEIGHT - _bounds(world, body)[0, 2])
    p.resetBasePositionAndOrientation(body, place, orientation, physicsClientId=world.client)


def _push(world: World) -> None:
    """Pushes every object, at its centre of mass and along the table, towards the table's centre."""
    for body, centre in zip(world.objects, world.centres(), strict=True):
        inwards = -np.array([*centre[:2], 0.0]) / max(float(np.linalg.norm(centre[:2])), 1e-6)
        velocity, _ = p.getBaseVelocity(body, physicsClientId=world.client)
        if float(inwards @ velocity) < PUSH_SPEED:
            force = PUSH * p.getDynamicsInfo(body, -1, physicsClientId=world.client)[0] * inwards
            p.applyExternalForce(body, -1, force.tolist(), centre.tolist(), p.WORLD_FRAME, physicsClientId=world.client)
