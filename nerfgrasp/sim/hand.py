"""A gripper that floats in a PyBullet world."""

import numpy as np
from numpy.typing import NDArray

from nerfgrasp.grippers import Gripper
from nerfgrasp.sim.bullet import Pose, box_compound, matrix, p, quaternion
from nerfgrasp.sim.world import World

FINGERS = (0, 1)
"""The gripper's links."""


class Hand:
    """A gripper in a world, held on its path by a constraint of limited force."""

    def __init__(self, world: World, gripper: Gripper, T_world_grasp: Pose) -> None:
        self.world, self.client = world, world.client
        self._grasp_in_body = gripper.body[2] / 2 - gripper.palm
        self._approach, self._orientation = T_world_grasp[:3, 2], quaternion(T_world_grasp[:3, :3])
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
        T = matrix(*p.getBasePositionAndOrientation(self.body, physicsClientId=self.client))
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


def _finger(client: int, gripper: Gripper, side: float) -> int:
    """Returns a finger's shape: the pad about the origin and, set back, the finger between pad and palm."""
    fingers = gripper.fingers
    above = gripper.finger_length - fingers.pad_height
    pad = (fingers.thickness / 2, fingers.pad_width / 2, fingers.pad_height / 2)
    upper = ((fingers.thickness - gripper.setback) / 2, fingers.pad_width / 2, above / 2)
    centre = (side * gripper.setback / 2, 0.0, -(fingers.pad_height + above) / 2)
    return box_compound(client, [(0.0, 0.0, 0.0), centre], [pad, upper])
