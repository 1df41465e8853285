"""The hand: its fingers move as the gripper's should."""

from pathlib import Path

import numpy as np
import pybullet as p
import pytest
import torch

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import make_pose
from nerfgrasp.grippers import ROBOTIQ_2F85, Gripper, find_gripper
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim import shapes
from nerfgrasp.sim.attempt import Outcome, attempt_grasp
from nerfgrasp.sim.hand import Hand
from nerfgrasp.sim.physics import PHYSICS
from nerfgrasp.sim.world import World

GRASP = np.diag([1.0, -1.0, -1.0, 1.0])
GRASP[2, 3] = 0.2

# A hand whose base lies 0.1 m behind the TCP and whose fingers close along the base's y axis. PADS gives each finger's
# axis and where its pad is at joint position 0.
HAND = """<robot name="hand">
<link name="base"><inertial><origin xyz="0 0.01 0.02"/><mass value="0.7"/>
  <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0 0 0.025"/><geometry><box size="0.06 0.12 0.05"/></geometry></collision></link>
{fingers}</robot>"""
FINGER = """<link name="{name}_slide"><inertial><mass value="0.01"/>
  <inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="{name}_pad"><inertial><mass value="0.03"/>
  <inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0 {pad} 0"/><geometry><box size="0.02 0.01 0.04"/></geometry></collision></link>
<joint name="{name}" type="prismatic"><parent link="base"/><child link="{name}_slide"/><origin xyz="0 0 0.1"/>
  <axis xyz="0 {axis} 0"/><limit lower="0" upper="0.04" effort="100" velocity="1"/></joint>
<joint name="{name}_mount" type="fixed"><parent link="{name}_slide"/><child link="{name}_pad"/></joint>"""
YAML = """{name: test_hand, stroke: 0.08, finger_length: 0.07, finger_thickness: 0.01, pad_width: 0.02,
pad_height: 0.04, body: [0.12, 0.06, 0.05], urdf: hand.urdf, finger_joints: [one, two], T_base_tcp: """
TURNED = "[[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.1], [0.0, 0.0, 0.0, 1.0]]}"

KINDS = {
    "opens upwards": ((1, 0.005), (-1, -0.005)),
    "opens downwards": ((-1, 0.045), (1, -0.045)),
    "mixed": ((1, 0.005), (1, -0.045)),
    "listed the other way round": ((-1, -0.005), (1, 0.005)),
}


@pytest.fixture(params=KINDS.values(), ids=KINDS)
def urdf_gripper(request: pytest.FixtureRequest, tmp_path: Path) -> Gripper:
    fingers = zip(("one", "two"), request.param, strict=True)
    text = "".join(FINGER.format(name=name, axis=axis, pad=pad) for name, (axis, pad) in fingers)
    (tmp_path / "hand.urdf").write_text(HAND.format(fingers=text))
    (tmp_path / "hand.yaml").write_text(YAML + TURNED)
    return find_gripper(tmp_path / "hand.yaml")


def test_fingers_open_to_the_stroke_and_close_on_the_middle():
    with World([], PHYSICS) as world:
        hand = Hand(world, ROBOTIQ_2F85, GRASP)
        world.step(24)
        assert pad_faces(hand) == pytest.approx([-0.0425, 0.0425], abs=1e-3)
        hand.close()
        world.step(world.steps(PHYSICS.close_time))
        assert pad_faces(hand) == pytest.approx([0.0, 0.0], abs=2e-3)
        states = [p.getLinkState(hand.body, link, physicsClientId=world.client) for link in (0, 1)]
        assert [state[0][2] for state in states] == pytest.approx([0.2, 0.2], abs=2e-3)


def test_fingers_of_a_urdf_open_to_the_stroke_and_close_on_the_middle(urdf_gripper: Gripper) -> None:
    with World([], PHYSICS) as world:
        hand = Hand(world, urdf_gripper, GRASP)
        world.step(24)
        T, closed = hand.state()
        assert np.abs(T - GRASP).max() < 2e-3
        assert closed == pytest.approx((0.0, 0.0), abs=1e-3)
        assert boxes_along_x(hand) == pytest.approx([-0.045, 0.045], abs=1e-3)
        hand.close()
        world.step(world.steps(PHYSICS.close_time))
        assert hand.state()[1] == pytest.approx((0.04, 0.04), abs=2e-3)
        assert boxes_along_x(hand) == pytest.approx([-0.005, 0.005], abs=2e-3)
        hand.move_to(np.array([0.0, 0.05, 0.2]))
        world.step(60)
        assert hand.state()[0][:3, 3] == pytest.approx([0.0, 0.05, 0.2], abs=2e-3)


def test_a_hand_of_a_urdf_lifts_a_box_off_its_centre(urdf_gripper: Gripper) -> None:
    pose = make_pose(torch.eye(3), torch.tensor([0.012, 0.0, 0.0]))
    box = Prism("box", shapes.box(0.04, 0.06), 0.08, (1.0, 0.0, 0.0), 400.0, pose)
    grasp = GRASP.copy()
    grasp[2, 3] = 0.06
    attempt = attempt_grasp(Truth("simple", 0, 0, (box,)), grasp, gripper=urdf_gripper)
    assert attempt.outcome == Outcome.SUCCESS


def test_a_urdf_that_pybullet_cannot_load_is_a_users_mistake(urdf_gripper: Gripper) -> None:
    assert urdf_gripper.hand_model is not None
    urdf_gripper.hand_model.path.write_text("<robot/>")
    with World([], PHYSICS) as world, pytest.raises(UserError, match=r"hand\.urdf: PyBullet cannot load the hand"):
        Hand(world, urdf_gripper, GRASP)


def pad_faces(hand):
    """Where the pads' inner faces are along world x."""
    middle = [p.getLinkState(hand.body, link, physicsClientId=hand.client)[0][0] for link in (0, 1)]
    half = ROBOTIQ_2F85.fingers.thickness / 2
    return [middle[0] + half, middle[1] - half]


def boxes_along_x(hand: Hand) -> list[float]:
    """Returns the middles of both fingers' bounding boxes along world x."""
    boxes = [p.getAABB(hand.body, finger.link, hand.client) for finger in hand.fingers]
    return [(low[0] + high[0]) / 2 for low, high in boxes]
