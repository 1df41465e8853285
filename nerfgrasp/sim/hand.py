"""A gripper that floats in a PyBullet world."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfgrasp.errors import UserError
from nerfgrasp.grippers import Gripper, HandModel
from nerfgrasp.sim.bullet import Pose, box_compound, matrix, p, quaternion, silence
from nerfgrasp.sim.world import World


@dataclass(frozen=True)
class Finger:
    """One of a hand's two fingers: a link on a prismatic joint."""

    link: int
    """Number of the link and of its joint."""
    open: float = 0.0
    """The joint's position when the hand is open, metres."""
    closing: float = 1.0
    """1 if the joint's position grows as the finger closes, otherwise -1."""


@dataclass(frozen=True)
class _Body:
    """A hand's body in a world."""

    number: int
    T_grasp_body: Pose
    """Pose of the body's centre of mass in the grasp frame."""
    fingers: tuple[Finger, Finger]
    """The finger at -x and the one at +x."""


class Hand:
    """A gripper in a world. A constraint of limited force holds it on its path.

    Raises:
        UserError: PyBullet cannot load the gripper's URDF.
    """

    def __init__(self, world: World, gripper: Gripper, T_world_grasp: Pose) -> None:
        self.world, self.client = world, world.client
        model = gripper.hand_model
        made = _of_boxes(world, gripper, T_world_grasp) if model is None else _of_urdf(world, model, T_world_grasp)
        self.body, self.fingers = made.number, made.fingers
        self._T_body_grasp = np.linalg.inv(made.T_grasp_body)
        self._offset = T_world_grasp[:3, :3] @ made.T_grasp_body[:3, 3]
        self._orientation = quaternion(T_world_grasp[:3, :3] @ made.T_grasp_body[:3, :3])
        position, physics = self._body_position(T_world_grasp[:3, 3]), world.physics
        for finger in self.fingers:
            p.changeDynamics(
                self.body,
                finger.link,
                lateralFriction=physics.pad_friction,
                contactStiffness=physics.pad_stiffness,
                contactDamping=physics.pad_damping,
                frictionAnchor=int(physics.pad_anchor),
                physicsClientId=self.client,
            )
        self._hold = p.createConstraint(
            self.body, -1, -1, -1, p.JOINT_FIXED, [0, 0, 0], [0, 0, 0], position,
            childFrameOrientation=self._orientation, physicsClientId=self.client,
        )  # fmt: skip
        p.changeConstraint(self._hold, maxForce=physics.hand_force, physicsClientId=self.client)
        self._gear = self._couple()
        for finger in self.fingers:
            self._drive(finger, p.POSITION_CONTROL, targetPosition=finger.open, force=physics.hand_force)

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
        for finger in self.fingers:
            speed = finger.closing * physics.finger_speed
            self._drive(finger, p.VELOCITY_CONTROL, targetVelocity=speed, force=physics.closing_force)

    def remove(self) -> None:
        """Takes the hand out of the world, as if it had opened and withdrawn without touching anything."""
        for constraint in (self._hold, self._gear):
            p.removeConstraint(constraint, physicsClientId=self.client)
        p.removeBody(self.body, physicsClientId=self.client)

    def state(self) -> tuple[Pose, tuple[float, float]]:
        """Returns `T_world_grasp` `[4, 4]` of the hand, and the distance in metres by which each finger has closed."""
        T = matrix(*p.getBasePositionAndOrientation(self.body, physicsClientId=self.client))
        T[:3, 3] += T[:3, :3] @ self._T_body_grasp[:3, 3]
        T[:3, :3] = T[:3, :3] @ self._T_body_grasp[:3, :3]
        left, right = (
            finger.closing * (p.getJointState(self.body, finger.link, physicsClientId=self.client)[0] - finger.open)
            for finger in self.fingers
        )
        return T, (left, right)

    def held(self) -> list[int]:
        """Returns the numbers of the objects that both fingers touch."""
        touch = self.world.touch
        bodies = enumerate(self.world.objects)
        return [i for i, body in bodies if all(touch(self.body, body, finger.link) > 0 for finger in self.fingers)]

    def _drive(self, finger: Finger, mode: int, **target: float) -> None:
        p.setJointMotorControl2(self.body, finger.link, mode, physicsClientId=self.client, **target)

    def _body_position(self, position: NDArray[np.float64]) -> list[float]:
        """Returns the position of the body's centre of mass with the tool centre point at `position` `[3]`."""
        body: list[float] = (position + self._offset).tolist()
        return body

    def _couple(self) -> int:
        """Couples the fingers, so that they stay centred, and returns the constraint."""
        one, other = self.fingers
        gear: int = p.createConstraint(
            self.body, one.link, self.body, other.link, p.JOINT_GEAR, [1, 0, 0], [0, 0, 0], [0, 0, 0],
            physicsClientId=self.client,
        )  # fmt: skip
        physics, ratio = self.world.physics, -one.closing * other.closing
        target = one.open + ratio * other.open
        p.changeConstraint(
            gear,
            gearRatio=ratio,
            erp=physics.gear_erp,
            maxForce=physics.gear_force,
            physicsClientId=self.client,
            **({"relativePositionTarget": target} if target else {}),
        )
        return gear


def _of_boxes(world: World, gripper: Gripper, T_world_grasp: Pose) -> _Body:
    """Builds an open hand of boxes."""
    fingers, client = gripper.fingers, world.client
    grasp_in_body = gripper.body[2] / 2 - gripper.palm
    offset = (fingers.stroke + fingers.thickness) / 2
    body: int = p.createMultiBody(
        baseMass=gripper.body_mass,
        baseCollisionShapeIndex=p.createCollisionShape(
            p.GEOM_BOX, halfExtents=[size / 2 for size in gripper.body], physicsClientId=client
        ),
        basePosition=(T_world_grasp[:3, 3] - grasp_in_body * T_world_grasp[:3, 2]).tolist(),
        baseOrientation=quaternion(T_world_grasp[:3, :3]),
        linkMasses=[gripper.finger_mass] * 2,
        linkCollisionShapeIndices=[_finger_shape(client, gripper, side) for side in (-1.0, 1.0)],
        linkVisualShapeIndices=[-1, -1],
        linkPositions=[[side * offset, 0.0, grasp_in_body] for side in (-1.0, 1.0)],
        linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * 2,
        linkInertialFramePositions=[[0.0, 0.0, 0.0]] * 2,
        linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * 2,
        linkParentIndices=[0, 0],
        linkJointTypes=[p.JOINT_PRISMATIC] * 2,
        linkJointAxis=[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
        physicsClientId=client,
    )
    for link in (0, 1):
        p.changeDynamics(body, link, jointLowerLimit=0.0, jointUpperLimit=fingers.stroke / 2, physicsClientId=client)
    T_grasp_body = np.eye(4)
    T_grasp_body[2, 3] = -grasp_in_body
    return _Body(body, T_grasp_body, (Finger(0), Finger(1)))


def _finger_shape(client: int, gripper: Gripper, side: float) -> int:
    """Returns a finger's shape: the pad around the origin and, set back, the finger between pad and palm."""
    fingers = gripper.fingers
    above = gripper.finger_length - fingers.pad_height
    pad = (fingers.thickness / 2, fingers.pad_width / 2, fingers.pad_height / 2)
    upper = ((fingers.thickness - gripper.setback) / 2, fingers.pad_width / 2, above / 2)
    centre = (side * gripper.setback / 2, 0.0, -(fingers.pad_height + above) / 2)
    return box_compound(client, [(0.0, 0.0, 0.0), centre], [pad, upper])


def _of_urdf(world: World, model: HandModel, T_world_grasp: Pose) -> _Body:
    """Loads a URDF and opens its fingers."""
    client, T_world_base = world.client, T_world_grasp @ np.linalg.inv(np.asarray(model.T_base_tcp))
    try:
        with silence():
            body: int = p.loadURDF(
                str(model.path),
                T_world_base[:3, 3].tolist(),
                quaternion(T_world_base[:3, :3]),
                flags=p.URDF_MERGE_FIXED_LINKS,
                physicsClientId=client,
            )
    except p.error as error:
        raise UserError(f"{model.path}: PyBullet cannot load the hand: {error}") from error
    T_world_body = matrix(*p.getBasePositionAndOrientation(body, physicsClientId=client))
    T_grasp_body: Pose = np.linalg.inv(T_world_grasp) @ T_world_body
    joints = [p.getJointInfo(body, joint, physicsClientId=client) for joint in range(p.getNumJoints(body, client))]
    limits = {info[1].decode(): (info[0], info[8], info[9]) for info in joints}
    fingers = [limits[name] for name in model.finger_joints]

    def places(share: float) -> NDArray[np.float64]:
        """Moves both fingers to a share of their range; returns their places along the closing axis `[2]`."""
        for link, low, high in fingers:
            p.resetJointState(body, link, low + share * (high - low), physicsClientId=client)
        p.performCollisionDetection(physicsClientId=client)
        return (
            np.array([np.mean(p.getAABB(body, link, client), axis=0) for link, _, _ in fingers]) @ T_world_grasp[:3, 0]
        )

    travel = places(1.0) - places(0.0)
    found = []
    for number, side in zip(np.argsort(places(0.5)), (-1.0, 1.0), strict=True):
        link, low, high = fingers[number]
        found.append(Finger(link, high, -1.0) if side * travel[number] > 0 else Finger(link, low, 1.0))
    for finger in found:
        p.resetJointState(body, finger.link, finger.open, physicsClientId=client)
    return _Body(body, T_grasp_body, (found[0], found[1]))
