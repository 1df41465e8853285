"""What a grasp attempt looks like: its stages as scenes that hold the gripper beside the objects, ready to render."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.attempt import Attempt, attempt_grasp
from nerfgrasp.sim.bullet import Pose
from nerfgrasp.sim.hand import Hand
from nerfgrasp.sim.physics import PHYSICS, Physics
from nerfgrasp.sim.settling import moved
from nerfgrasp.sim.shapes import rectangle
from nerfgrasp.sim.world import World

BODY_COLOUR, FINGER_COLOUR = (0.23, 0.24, 0.27), (0.12, 0.12, 0.14)
"""RGB in [0, 1]."""


@dataclass(frozen=True)
class Frame:
    """One moment of an attempt."""

    stage: str
    """What has just been done: see `nerfgrasp.sim.attempt.Observer`; `refused` if nothing was carried out; and, last
    of all, `after`."""
    truth: Truth
    """The scene at that moment: the objects, and after them the gripper's boxes as prisms, but for `after`."""


def film_grasp(
    truth: Truth,
    T_world_grasp: NDArray[np.floating] | Tensor,
    *,
    physics: Physics = PHYSICS,
    gripper: Gripper = DEFAULT_GRIPPER,
) -> tuple[Attempt, tuple[Frame, ...]]:
    """Carries a grasp out as `attempt_grasp` does, and returns its stages as well; being seen changes nothing.

    A grasp that is refused is seen where it was asked to be. The last frame is what remains on the table.

    Args:
        truth: the scene.
        T_world_grasp: `[4, 4]`.
        physics: constants of the simulation.
        gripper: that carries it out.
    """
    frames: list[Frame] = []

    def observe(stage: str, world: World, hand: Hand) -> None:
        T, closed = hand.state()
        seen = (*moved(truth.objects, world), *gripper_prisms(T, closed, gripper))
        frames.append(Frame(stage, replace(truth, objects=seen)))

    attempt = attempt_grasp(truth, T_world_grasp, physics=physics, gripper=gripper, observe=observe)
    if not frames:
        asked = gripper_prisms(np.asarray(T_world_grasp, dtype=np.float64), (0.0, 0.0), gripper)
        frames.append(Frame("refused", replace(truth, objects=(*truth.objects, *asked))))
    return attempt, (*frames, Frame("after", replace(truth, objects=attempt.after)))


def gripper_prisms(T_world_grasp: Pose, closed: tuple[float, float], gripper: Gripper) -> list[Prism]:
    """Returns the gripper's body and fingers as prisms, to be drawn.

    Args:
        T_world_grasp: `[4, 4]`, where it is.
        closed: metres by which each finger has moved inwards, the one at -x first.
        gripper: what it is.
    """
    body, left, right = gripper.open_boxes()
    shifts = (0.0, closed[0], -closed[1])
    colours = (BODY_COLOUR, FINGER_COLOUR, FINGER_COLOUR)
    prisms = []
    for (centre, (x, y, z)), shift, colour in zip((body, left, right), shifts, colours, strict=True):
        T_grasp_box = np.eye(4)
        T_grasp_box[:3, 3] = np.add(centre, (shift, 0.0, -z))
        pose = torch.from_numpy(T_world_grasp @ T_grasp_box).float()
        prisms.append(Prism("box", (rectangle(-x, -y, x, y),), 2 * z, colour, 1000.0, pose))
    return prisms
