"""Parallel grippers as measurements. The grasp frame: origin at the tool centre point, x closes, z approaches."""

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True)
class Fingers:
    """What of a parallel gripper decides where it fits."""

    stroke: float = 0.085
    """Metres between the pads when open."""
    max_width: float = 0.07
    """The widest thing worth grasping, metres."""
    thickness: float = 0.008
    """Of a finger along the closing axis, metres."""
    pad_width: float = 0.022
    """Across the closing axis and the approach, metres."""
    pad_height: float = 0.0375
    """Along the approach, metres; the tool centre point is its middle."""
    clearance: float = 0.003
    """Metres to keep free around the open fingers."""
    palm: float = 0.035
    """Metres from the tool centre point that an object may reach towards the palm."""


@dataclass(frozen=True)
class Gripper:
    """A parallel gripper of a box body and two fingers that slide along the closing axis."""

    name: str
    """What the gripper is called."""
    fingers: Fingers = field(default_factory=Fingers)
    """Stroke, pads and clearances."""
    finger_length: float = 0.059
    """From the palm to the fingertips, metres, when open."""
    setback: float = 0.002
    """Metres by which the finger above the pad is thinner than the pad, on the inside."""
    body: tuple[float, float, float] = (0.085, 0.075, 0.093)
    """Metres along x, y and z of the grasp frame."""
    body_mass: float = 0.825
    """kg."""
    finger_mass: float = 0.05
    """kg, each."""

    @property
    def palm(self) -> float:
        """The palm's z in the grasp frame in metres, negative: it lies behind the tool centre point."""
        return self.fingers.pad_height / 2 - self.finger_length

    def open_boxes(self) -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
        """Returns the open gripper as boxes in the grasp frame: centres and half extents in metres."""
        tip = self.fingers.pad_height / 2
        half = (self.fingers.thickness / 2, self.fingers.pad_width / 2, self.finger_length / 2)
        x = self.fingers.stroke / 2 + half[0]
        sides = [((side * x, 0.0, tip - half[2]), half) for side in (-1.0, 1.0)]
        body = ((0.0, 0.0, self.palm - self.body[2] / 2), (self.body[0] / 2, self.body[1] / 2, self.body[2] / 2))
        return [body, *sides]

    def lowest(self, T_world_grasp: Tensor) -> Tensor:
        """Returns the height `[...]` in metres of the lowest point of the open gripper at grasps `[..., 4, 4]`."""
        centre, half = torch.tensor(self.open_boxes()).to(T_world_grasp).unbind(1)
        up = T_world_grasp[..., 2, :3]
        below = (up @ centre.T - up.abs() @ half.T).amin(dim=-1)
        return T_world_grasp[..., 2, 3] + below


ROBOTIQ_2F85 = Gripper("Robotiq 2F-85")
"""Measurements from its manual. Its mass, 0.925 kg, is shared out between body and fingers."""
ROBOTIQ_2F140 = Gripper(
    "Robotiq 2F-140",
    Fingers(stroke=0.14, max_width=0.125, thickness=0.012, pad_width=0.027, pad_height=0.065, palm=0.082),
    finger_length=0.12,
    body=(0.12, 0.075, 0.091),
    body_mass=0.925,
)
"""Measurements from its manual: stroke 140 mm, pad 27 x 65 mm, palm to fingertip 120 mm when open, mass 1.025 kg."""
