"""The grippers that come with the package."""

from nerfgrasp.grippers.gripper import Fingers, Gripper

ROBOTIQ_2F85 = Gripper("robotiq_2f85", "Robotiq 2F-85")
"""Dimensions from its manual. The mass, 0.925 kg, is divided between body and fingers."""
ROBOTIQ_2F140 = Gripper(
    "robotiq_2f140",
    "Robotiq 2F-140",
    Fingers(stroke=0.14, max_width=0.125, thickness=0.012, pad_width=0.027, pad_height=0.065, palm=0.082),
    finger_length=0.12,
    body=(0.12, 0.075, 0.091),
    body_mass=0.925,
)
"""Dimensions from its manual: stroke 140 mm, pad 27 x 65 mm, palm to fingertip 120 mm when open, mass 1.025 kg."""
FRANKA = Gripper(
    "franka",
    "Franka Hand",
    Fingers(stroke=0.08, max_width=0.065, thickness=0.0152, pad_width=0.0175, pad_height=0.0185, palm=0.0325),
    finger_length=0.047,
    body=(0.204, 0.063, 0.066),
    body_mass=0.6544,
    finger_mass=0.0291,
)
"""Stroke, rubber tips (17.5 x 15.2 x 18.5 mm), TCP and masses from franka_description, the maker's URDF: the tips
end 112.9 mm from the flange. The body is the bounding box of the hand's mesh; its front lies 66 mm from the flange."""
DEFAULT_GRIPPER = ROBOTIQ_2F85
"""The gripper of the paper and of the shipped models."""
