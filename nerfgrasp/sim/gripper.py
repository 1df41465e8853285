"""Parallel grippers as measurements. The grasp frame: origin at the tool centre point, x closes, z approaches."""

from dataclasses import dataclass, field

from nerfgrasp.scenes.bars import FINGERS_2F85, Fingers


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


ROBOTIQ_2F85 = Gripper("Robotiq 2F-85", FINGERS_2F85)
"""Measurements from its manual. Its mass, 0.925 kg, is shared out between body and fingers."""
