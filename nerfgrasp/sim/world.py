"""A PyBullet world: a table, the objects of a scene where they stand, and a gripper that floats."""

import math
from collections.abc import Sequence
from types import TracebackType

import numpy as np
import roma
import torch
from numpy.typing import NDArray

from nerfgrasp.scenes.gripper import Gripper
from nerfgrasp.scenes.meshes import MeshObject
from nerfgrasp.scenes.objects import SceneObject
from nerfgrasp.scenes.prisms import MassProperties, Prism, mass_properties
from nerfgrasp.sim.bullet import HULL_MARGIN, p
from nerfgrasp.sim.physics import Physics

FINGERS = (0, 1)
"""The gripper's links."""

Pose = NDArray[np.float64]
"""`[4, 4]`."""


class World:
    """One simulation in a process of its own connection; closed on leaving the `with` block.

    It is built anew for every attempt: a restored state is not exactly the saved one, a rebuilt one is.
    """

    def __init__(self, objects: Sequence[SceneObject], physics: Physics) -> None:
        self.physics = physics
        self.client = p.connect(p.DIRECT)
        p.setPhysicsEngineParameter(
            fixedTimeStep=physics.time_step,
            numSolverIterations=physics.solver_iterations,
            deterministicOverlappingPairs=1,
            physicsClientId=self.client,
        )
        p.setGravity(0.0, 0.0, -physics.gravity, physicsClientId=self.client)
        self.table = self._add_table()
        self.objects: list[int] = []
        for thing in objects:
            self.add(thing)

    def __enter__(self) -> "World":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        p.disconnect(self.client)

    def add(self, thing: SceneObject) -> None:
        """Puts one more object where its pose says."""
        self.objects.append(self._add_object(thing))

    def remove(self, number: int) -> None:
        """Takes an object off the world; those after it move up by one number."""
        p.removeBody(self.objects.pop(number), physicsClientId=self.client)

    def step(self, count: int = 1) -> None:
        """Simulates `count` steps."""
        for _ in range(count):
            p.stepSimulation(physicsClientId=self.client)

    def steps(self, seconds: float) -> int:
        """Returns how many steps `seconds` are."""
        return max(1, math.ceil(seconds / self.physics.time_step))

    def settle(self) -> None:
        """Waits until the objects rest, at most as long as the physics says."""
        for _ in range(self.physics.rest_tests):
            self.step(self.steps(self.physics.rest_time))
            if all(self._speed(body) <= self.physics.rest_speed for body in self.objects):
                return

    def poses(self) -> NDArray[np.float64]:
        """Returns `T_world_object` `[N, 4, 4]` of the objects."""
        return np.array([self._pose(body) for body in self.objects]).reshape(-1, 4, 4)

    def centres(self) -> NDArray[np.float64]:
        """Returns the objects' centres of mass `[N, 3]` in the world."""
        poses = [p.getBasePositionAndOrientation(body, physicsClientId=self.client) for body in self.objects]
        return np.array([position for position, _ in poses]).reshape(-1, 3)

    def touch(self, a: int, b: int, link: int | None = None) -> float:
        """Returns the sum of the normal forces in newtons between body `a` (its `link`, if given) and body `b`."""
        where = {} if link is None else {"linkIndexA": link}
        contacts = p.getContactPoints(bodyA=a, bodyB=b, physicsClientId=self.client, **where)
        return float(sum(contact[9] for contact in contacts))

    def _pose(self, body: int) -> Pose:
        T_world_centre = _matrix(*p.getBasePositionAndOrientation(body, physicsClientId=self.client))
        T_object_centre = _matrix(*p.getDynamicsInfo(body, -1, physicsClientId=self.client)[3:5])
        return T_world_centre @ np.linalg.inv(T_object_centre)

    def _speed(self, body: int) -> float:
        linear, _ = p.getBaseVelocity(body, physicsClientId=self.client)
        return float(np.linalg.norm(linear))

    def _add_table(self) -> int:
        shape = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=self.client)
        body: int = p.createMultiBody(baseCollisionShapeIndex=shape, physicsClientId=self.client)
        p.changeDynamics(body, -1, lateralFriction=self.physics.table_friction, physicsClientId=self.client)
        return body

    def _add_object(self, thing: SceneObject) -> int:
        """Adds a body whose mass, centre of mass and inertia are those of the solid, not of its hull."""
        solid = _solid(thing)
        moments, axes = np.linalg.eigh(solid.inertia)
        axes = axes * np.sign(np.linalg.det(axes))
        pose = thing.T_world_object.double().numpy()
        body: int = p.createMultiBody(
            baseMass=solid.mass,
            baseCollisionShapeIndex=self._object_shape(thing),
            basePosition=pose[:3, 3].tolist(),
            baseOrientation=_quaternion(pose[:3, :3]),
            baseInertialFramePosition=solid.centre.tolist(),
            baseInertialFrameOrientation=_quaternion(axes),
            physicsClientId=self.client,
        )
        p.changeDynamics(
            body,
            -1,
            localInertiaDiagonal=moments.tolist(),
            lateralFriction=self.physics.object_friction,
            rollingFriction=self.physics.rolling_friction,
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=self.client,
        )
        return body

    def _object_shape(self, thing: SceneObject) -> int:
        if isinstance(thing, MeshObject):
            return _mesh_shape(self.client, thing)
        if thing.kind in ("cylinder", "triangle"):
            shape: int = p.createCollisionShape(
                p.GEOM_MESH, vertices=_inset_hull(thing).tolist(), physicsClientId=self.client
            )
            return shape
        corners = [np.asarray(part) for part in thing.parts]
        return _box_compound(
            self.client,
            [(*(c.min(axis=0) + c.max(axis=0)) / 2, thing.height / 2) for c in corners],
            [(*(c.max(axis=0) - c.min(axis=0)) / 2, thing.height / 2) for c in corners],
        )


class Hand:
    """A gripper in a world, held on its path by a constraint of limited force."""

    def __init__(self, world: World, gripper: Gripper, T_world_grasp: Pose) -> None:
        self.world, self.client = world, world.client
        self._grasp_in_body = gripper.body[2] / 2 - gripper.palm
        self._approach, self._orientation = T_world_grasp[:3, 2], _quaternion(T_world_grasp[:3, :3])
        position, orientation = self._body_position(T_world_grasp[:3, 3]), self._orientation
        self.body = self._add_body(gripper, position, orientation)
        physics = world.physics
        self._hold = p.createConstraint(
            self.body, -1, -1, -1, p.JOINT_FIXED, [0, 0, 0], [0, 0, 0], position,
            childFrameOrientation=orientation, physicsClientId=self.client,
        )  # fmt: skip
        p.changeConstraint(self._hold, maxForce=physics.hand_force, physicsClientId=self.client)
        self._gear = p.createConstraint(
            self.body, 0, self.body, 1, p.JOINT_GEAR, [1, 0, 0], [0, 0, 0], [0, 0, 0], physicsClientId=self.client
        )
        p.changeConstraint(
            self._gear, gearRatio=-1, erp=physics.gear_erp, maxForce=physics.gear_force, physicsClientId=self.client
        )
        for link in FINGERS:
            self._drive(link, p.POSITION_CONTROL, targetPosition=0.0, force=physics.hand_force)

    def move_to(self, position: NDArray[np.float64]) -> None:
        """Sets where the tool centre point `[3]` is pulled; the hand keeps its orientation."""
        p.changeConstraint(
            self._hold,
            jointChildPivot=self._body_position(position),
            jointChildFrameOrientation=self._orientation,
            maxForce=self.world.physics.hand_force,
            physicsClientId=self.client,
        )

    def close(self) -> None:
        """Starts to close the fingers, and keeps pressing."""
        physics = self.world.physics
        for link in FINGERS:
            self._drive(link, p.VELOCITY_CONTROL, targetVelocity=physics.finger_speed, force=physics.closing_force)

    def remove(self) -> None:
        """Takes the hand out of the world, as if it had been opened and withdrawn without touching a thing."""
        for constraint in (self._hold, self._gear):
            p.removeConstraint(constraint, physicsClientId=self.client)
        p.removeBody(self.body, physicsClientId=self.client)

    def state(self) -> tuple[Pose, tuple[float, float]]:
        """Returns `T_world_grasp` `[4, 4]` where the hand is, and metres by which either finger has closed."""
        T = _matrix(*p.getBasePositionAndOrientation(self.body, physicsClientId=self.client))
        T[:3, 3] += self._grasp_in_body * T[:3, 2]
        left, right = (p.getJointState(self.body, link, physicsClientId=self.client)[0] for link in FINGERS)
        return T, (left, right)

    def held(self) -> list[int]:
        """Returns the numbers of the objects that both fingers touch."""
        touch = self.world.touch
        bodies = enumerate(self.world.objects)
        return [i for i, body in bodies if all(touch(self.body, body, link) > 0 for link in FINGERS)]

    def _drive(self, link: int, mode: int, **target: float) -> None:
        p.setJointMotorControl2(self.body, link, mode, physicsClientId=self.client, **target)

    def _body_position(self, position: NDArray[np.float64]) -> list[float]:
        body: list[float] = (position - self._grasp_in_body * self._approach).tolist()
        return body

    def _add_body(self, gripper: Gripper, position: list[float], orientation: list[float]) -> int:
        fingers, client = gripper.fingers, self.client
        offset = (fingers.stroke + fingers.thickness) / 2
        body: int = p.createMultiBody(
            baseMass=gripper.body_mass,
            baseCollisionShapeIndex=p.createCollisionShape(
                p.GEOM_BOX, halfExtents=[size / 2 for size in gripper.body], physicsClientId=client
            ),
            basePosition=position,
            baseOrientation=orientation,
            linkMasses=[gripper.finger_mass] * 2,
            linkCollisionShapeIndices=[_finger(client, gripper, side) for side in (-1.0, 1.0)],
            linkVisualShapeIndices=[-1, -1],
            linkPositions=[[side * offset, 0.0, self._grasp_in_body] for side in (-1.0, 1.0)],
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * 2,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * 2,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * 2,
            linkParentIndices=[0, 0],
            linkJointTypes=[p.JOINT_PRISMATIC] * 2,
            linkJointAxis=[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
            physicsClientId=client,
        )
        for link in FINGERS:
            p.changeDynamics(
                body,
                link,
                lateralFriction=self.world.physics.pad_friction,
                contactStiffness=self.world.physics.pad_stiffness,
                contactDamping=self.world.physics.pad_damping,
                frictionAnchor=int(self.world.physics.pad_anchor),
                jointLowerLimit=0.0,
                jointUpperLimit=fingers.stroke / 2,
                physicsClientId=client,
            )
        return body


def _solid(thing: SceneObject) -> MassProperties:
    if isinstance(thing, MeshObject):
        return MassProperties(thing.mass, np.array(thing.centre), np.array(thing.inertia))
    return mass_properties(thing)


def _mesh_shape(client: int, thing: MeshObject) -> int:
    from nerfgrasp.sim.catalogue import model_of  # reads meshes: only where there are any

    # Every `o` of the file becomes a convex hull of its own.
    shape: int = p.createCollisionShape(p.GEOM_MESH, fileName=str(model_of(thing).collision), physicsClientId=client)
    return shape


def _quaternion(rotation: NDArray[np.float64]) -> list[float]:
    """Returns the quaternion xyzw of a rotation `[3, 3]`."""
    quaternion: list[float] = roma.rotmat_to_unitquat(torch.from_numpy(rotation.copy())).tolist()
    return quaternion


def _matrix(position: Sequence[float], orientation: Sequence[float]) -> Pose:
    """Returns the pose of a position and a quaternion xyzw."""
    T = np.eye(4)
    T[:3, :3] = roma.unitquat_to_rotmat(torch.tensor(orientation, dtype=torch.float64)).numpy()
    T[:3, 3] = position
    return T


def _finger(client: int, gripper: Gripper, side: float) -> int:
    """Returns a finger's shape: the pad about the origin and, set back, the finger between pad and palm."""
    fingers = gripper.fingers
    above = gripper.finger_length - fingers.pad_height
    pad = (fingers.thickness / 2, fingers.pad_width / 2, fingers.pad_height / 2)
    upper = ((fingers.thickness - gripper.setback) / 2, fingers.pad_width / 2, above / 2)
    centre = (side * gripper.setback / 2, 0.0, -(fingers.pad_height + above) / 2)
    return _box_compound(client, [(0.0, 0.0, 0.0), centre], [pad, upper])


def _box_compound(client: int, centres: Sequence[tuple[float, ...]], halves: Sequence[tuple[float, ...]]) -> int:
    count = len(centres)
    shape: int = p.createCollisionShapeArray(
        shapeTypes=[p.GEOM_BOX] * count,
        halfExtents=[list(half) for half in halves],
        collisionFramePositions=[list(centre) for centre in centres],
        physicsClientId=client,
    )
    return shape


def _inset_hull(prism: Prism) -> NDArray[np.float64]:
    """Returns the corners `[2K, 3]` of a convex prism that Bullet's margin inflates to the true size."""
    corners = np.asarray(prism.parts[0])
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    level = (corners * normals).sum(axis=1) - HULL_MARGIN
    pairs = np.stack([np.roll(normals, 1, axis=0), normals], axis=1)
    inset = np.linalg.solve(pairs, np.stack([np.roll(level, 1), level], axis=1)[..., None])[..., 0]
    floors = [np.full(len(inset), z) for z in (HULL_MARGIN, prism.height - HULL_MARGIN)]
    return np.concatenate([np.column_stack([inset, z]) for z in floors])
