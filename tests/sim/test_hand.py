"""The hand: its fingers move as the gripper's should."""

import numpy as np
import pybullet as p
import pytest

from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.sim.hand import Hand
from nerfgrasp.sim.physics import PHYSICS
from nerfgrasp.sim.world import World


def test_fingers_open_to_the_stroke_and_close_on_the_middle():
    grasp = np.diag([1.0, -1.0, -1.0, 1.0])
    grasp[2, 3] = 0.2
    with World([], PHYSICS) as world:
        hand = Hand(world, ROBOTIQ_2F85, grasp)
        world.step(24)
        assert pad_faces(hand) == pytest.approx([-0.0425, 0.0425], abs=1e-3)
        hand.close()
        world.step(world.steps(PHYSICS.close_time))
        assert pad_faces(hand) == pytest.approx([0.0, 0.0], abs=2e-3)
        states = [p.getLinkState(hand.body, link, physicsClientId=world.client) for link in (0, 1)]
        assert [state[0][2] for state in states] == pytest.approx([0.2, 0.2], abs=2e-3)


def pad_faces(hand):
    """Where the pads' inner faces are along world x."""
    middle = [p.getLinkState(hand.body, link, physicsClientId=hand.client)[0][0] for link in (0, 1)]
    half = ROBOTIQ_2F85.fingers.thickness / 2
    return [middle[0] + half, middle[1] - half]
