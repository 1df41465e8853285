"""Parallel grippers: the only place that states a hand's dimensions."""

from nerfgrasp.grippers.built_in import DEFAULT_GRIPPER, FRANKA, ROBOTIQ_2F85, ROBOTIQ_2F140
from nerfgrasp.grippers.finding import find_gripper, read_gripper
from nerfgrasp.grippers.gripper import Fingers, Gripper, HandModel, Probes

__all__ = [
    "DEFAULT_GRIPPER",
    "FRANKA",
    "ROBOTIQ_2F85",
    "ROBOTIQ_2F140",
    "Fingers",
    "Gripper",
    "HandModel",
    "Probes",
    "find_gripper",
    "read_gripper",
]
