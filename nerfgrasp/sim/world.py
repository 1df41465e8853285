"""A PyBullet world: a table, and the objects of a scene where they stand."""

import math
from collections.abc import Sequence
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from nerfgrasp.scenes.meshes import MeshObject
from nerfgrasp.scenes.objects import SceneObject
from nerfgrasp.scenes.prisms import MassProperties, Prism, mass_properties
from nerfgrasp.sim.bullet import HULL_MARGIN, Pose, box_compound, matrix, p, quaternion
from nerfgrasp.sim.physics import Physics


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
        T_world_centre = matrix(*p.getBasePositionAndOrientation(body, physicsClientId=self.client))
        T_object_centre = matrix(*p.getDynamicsInfo(body, -1, physicsClientId=self.client)[3:5])
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
            baseOrientation=quaternion(pose[:3, :3]),
            baseInertialFramePosition=solid.centre.tolist(),
            baseInertialFrameOrientation=quaternion(axes),
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
        return box_compound(
            self.client,
            [(*(c.min(axis=0) + c.max(axis=0)) / 2, thing.height / 2) for c in corners],
            [(*(c.max(axis=0) - c.min(axis=0)) / 2, thing.height / 2) for c in corners],
        )


def _solid(thing: SceneObject) -> MassProperties:
    if isinstance(thing, MeshObject):
        return MassProperties(thing.mass, np.array(thing.centre), np.array(thing.inertia))
    return mass_properties(thing)


def _mesh_shape(client: int, thing: MeshObject) -> int:
    from nerfgrasp.sim.catalogue import model_of  # reads meshes: only where there are any

    # Every `o` of the file becomes a convex hull of its own.
    shape: int = p.createCollisionShape(p.GEOM_MESH, fileName=str(model_of(thing).collision), physicsClientId=client)
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
