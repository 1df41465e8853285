"""A parallel gripper by its dimensions, and the geometry that follows from them.

The grasp frame has its origin at the tool centre point (TCP), which is the middle of the pads. The fingers close along
x and the hand approaches along z.
"""

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfgrasp.errors import UserError

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Centre and half extents in metres."""
Lines = tuple[Tensor, Tensor]
"""Start points and vectors, `[L, 3]` each, metres in the grasp frame."""
_SHAPE = ("finger_length", "setback", "body")
_MAY_BE_ZERO = ("clearance", "setback")


@dataclass(frozen=True)
class Fingers:
    """The measurements that decide where a parallel gripper fits."""

    stroke: float = 0.085
    """Distance between the pads when the gripper is open, metres."""
    max_width: float = 0.07
    """Width of the widest object that is worth grasping, metres."""
    thickness: float = 0.008
    """Thickness of a finger along the closing axis, metres."""
    pad_width: float = 0.022
    """Width of a pad across the closing axis and the approach, metres."""
    pad_height: float = 0.0375
    """Height of a pad along the approach, metres."""
    clearance: float = 0.003
    """Free space to keep around the open fingers, metres."""
    palm: float = 0.035
    """Distance from the TCP that an object may reach towards the palm, metres."""


@dataclass(frozen=True)
class Probes:
    """Where Ψ reads the scene around a TCP. The defaults are the paper's, in metres, for the Robotiq 2F-85."""

    closing: float = 0.02
    """Distance of the inward rays from the TCP along the closing axis."""
    across: float = 0.015
    """Distance of all rays from the x-z plane."""
    approach: float = 0.0125
    """Distance of the inward rays from the TCP along the approach."""
    reach: float = 0.015
    """Distance along a ray, to both sides, of its outermost points."""

    def rays(self) -> Tensor:
        """Returns `T_grasp_ray` `[6, 4, 4]`: ray bases around the TCP with the viewing direction along z.

        Two rays look along the approach. Four look inward from the fingers.
        """
        along = [_ray((0.0, y, 0.0), 0.0) for y in (self.across, -self.across)]
        inward = [
            _ray((x, y, self.approach), -math.copysign(math.pi / 2, x))
            for x in (self.closing, -self.closing)
            for y in (self.across, -self.across)
        ]
        return torch.stack(along + inward)

    def steps(self) -> Tensor:
        """Returns the seven distances `[7]` along each ray in metres."""
        return torch.linspace(-self.reach, self.reach, 7)

    def mirror_orders(self) -> Tensor:
        """Returns `[4, 6]`: for each mirror image of the gripper, the ray on which each ray falls.

        The rays are symmetric about the x-z and y-z planes. Mirroring at both is a half turn.
        """
        positions = self.rays()[:, :3, 3]
        mirrors = torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [-1.0, -1.0, 1.0]])
        return torch.stack([torch.cdist(positions * mirror, positions).argmin(dim=1) for mirror in mirrors])


@dataclass(frozen=True)
class HandModel:
    """A URDF of a hand, which physics uses in place of boxes."""

    path: Path
    """The URDF, an absolute path."""
    finger_joints: tuple[str, str]
    """Names of the two prismatic joints that move the fingers."""
    T_base_tcp: tuple[tuple[float, float, float, float], ...]
    """Pose of the TCP in the frame of the URDF's base link, `4 x 4`, metres."""
    sha256: str
    """Hash of the URDF and of the meshes that it names."""

    def settings(self) -> dict[str, Any]:
        """Returns JSON data that differs between models with different physics. It does not depend on the path."""
        return {"finger_joints": self.finger_joints, "T_base_tcp": self.T_base_tcp, "sha256": self.sha256}


@dataclass(frozen=True)
class Gripper:
    """A parallel gripper with a box-shaped body and two fingers that slide along the closing axis.

    Example:
        >>> hand = Gripper("my_hand", "My hand", Fingers(stroke=0.1, max_width=0.09), finger_length=0.06)
        >>> round(hand.palm, 5)
        -0.04125

    Raises:
        UserError: a dimension is out of its range, or two dimensions contradict each other.
    """

    name: str
    """Name by which commands, models and results refer to the gripper."""
    title: str
    """Name of the product."""
    fingers: Fingers = field(default_factory=Fingers)
    """Stroke, pads and clearances."""
    finger_length: float = 0.059
    """Distance from the palm to the fingertips when the gripper is open, metres."""
    setback: float = 0.002
    """Difference in thickness between a pad and the finger above it, on the inside, metres."""
    body: tuple[float, float, float] = (0.085, 0.075, 0.093)
    """Extents of the body along x, y and z of the grasp frame, metres."""
    body_mass: float = 0.825
    """Mass of the body, kg."""
    finger_mass: float = 0.05
    """Mass of each finger, kg."""
    own_probes: Probes | None = None
    """Ψ's probes; None scales the paper's to the gripper's dimensions."""
    hand_model: HandModel | None = None
    """A URDF for physics; None builds the hand of boxes."""

    def __post_init__(self) -> None:
        """Checks the dimensions."""
        fingers = self.fingers
        sizes = {**vars(fingers), **{key: getattr(self, key) for key in (*_SHAPE, "body_mass", "finger_mass")}}
        for key, size in sizes.items():
            lengths = size if isinstance(size, tuple) else (size,)
            if not all(0 <= one < math.inf and (one or key in _MAY_BE_ZERO) for one in lengths):
                raise UserError(f"{key} is {size}: it must be positive and finite")
        for key, size, limit, name in (
            ("max_width", fingers.max_width, fingers.stroke, "the stroke"),
            ("pad_height", fingers.pad_height, self.finger_length, "the finger_length"),
            ("setback", self.setback, fingers.thickness, "the thickness of a finger"),
            ("palm", fingers.palm, -self.palm, "the distance from the TCP to the palm"),
        ):
            if size > limit + 1e-9:
                raise UserError(f"{key} is {size}: it must be at most {limit:g}, {name}")

    @property
    def max_width(self) -> float:
        """Width of the widest object that is worth grasping, metres."""
        return self.fingers.max_width

    @property
    def tip(self) -> float:
        """The fingertips' z in the grasp frame, metres."""
        return self.fingers.pad_height / 2

    @property
    def palm(self) -> float:
        """The palm's z in the grasp frame, metres. It is negative: the palm lies behind the TCP."""
        return self.tip - self.finger_length

    @property
    def probes(self) -> Probes:
        """Ψ's probes for this gripper."""
        if self.own_probes is not None:
            return self.own_probes
        paper, mine, reference = Probes(), self.fingers, Fingers()
        stroke = mine.stroke / reference.stroke
        return Probes(
            closing=paper.closing * stroke,
            across=paper.across * (mine.pad_width / reference.pad_width),
            approach=paper.approach * (mine.pad_height / reference.pad_height),
            reach=paper.reach * stroke,
        )

    @property
    def gap_spacing(self) -> float:
        """Distance across a pad between neighbouring lines of `gap_lines`, metres."""
        return 0.36 * self.fingers.pad_width

    def settings(self) -> dict[str, Any]:
        """Returns the measurements that physics depends on as JSON data, for hashes."""
        shape = {key: getattr(self, key) for key in (*_SHAPE, "body_mass", "finger_mass")}
        model = {} if self.hand_model is None else {"hand_model": self.hand_model.settings()}
        return {"name": self.title, "fingers": asdict(self.fingers), **shape, **model}

    def open_boxes(self) -> list[Box]:
        """Returns the open gripper as three boxes in the grasp frame: the body, the finger at -x and the one at +x."""
        half = (self.fingers.thickness / 2, self.fingers.pad_width / 2, self.finger_length / 2)
        x = self.fingers.stroke / 2 + half[0]
        sides = [((side * x, 0.0, self.tip - half[2]), half) for side in (-1.0, 1.0)]
        body = ((0.0, 0.0, self.palm - self.body[2] / 2), (self.body[0] / 2, self.body[1] / 2, self.body[2] / 2))
        return [body, *sides]

    def lowest(self, T_world_grasp: Tensor) -> Tensor:
        """Returns the height `[...]` in metres of the lowest point of the open gripper at grasps `[..., 4, 4]`."""
        centre, half = torch.tensor(self.open_boxes()).to(T_world_grasp).unbind(1)
        up = T_world_grasp[..., 2, :3]
        below = (up @ centre.T - up.abs() @ half.T).amin(dim=-1)
        return T_world_grasp[..., 2, 3] + below

    def finger_lines(self, reach: float) -> Lines:
        """Returns the 12 lines along which points of the open fingertips cover the last `reach` metres."""
        fingers = self.fingers
        inner, outer = (fingers.stroke / 2 + share * fingers.thickness for share in (0.125, 0.75))
        y = self.gap_spacing
        return _approaches(
            [(side * x, w, self.tip) for side in (-1.0, 1.0) for x in (inner, outer) for w in (-y, 0.0, y)], reach
        )

    def palm_lines(self, reach: float) -> Lines:
        """Returns the 9 lines along which points of the palm cover the last `reach` metres."""
        x, y = 0.35 * self.body[0], 0.33 * self.body[1]
        return _approaches([(a * x, b * y, self.palm) for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0)], reach)

    def gap_lines(self) -> Lines:
        """Returns the 9 lines from pad to pad: three by three, across the pad and along it."""
        y, z = self.gap_spacing, 0.32 * self.fingers.pad_height
        starts = [(-self.fingers.stroke / 2, a * y, b * z) for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0)]
        return torch.tensor(starts), torch.tensor([[self.fingers.stroke, 0.0, 0.0]]).repeat(len(starts), 1)

    def outline(self) -> Tensor:
        """Returns a polyline `[7, 3]` for drawings, metres in the grasp frame.

        It runs from a fingertip over the palm to the end of a stem, back to the palm and to the other fingertip.
        """
        half, stem = self.fingers.stroke / 2, self.palm - 0.65 * self.body[2]
        x = torch.tensor([-half, -half, 0.0, 0.0, 0.0, half, half])
        z = torch.tensor([self.tip, self.palm, self.palm, stem, self.palm, self.palm, self.tip])
        return torch.stack([x, torch.zeros(7), z], dim=-1)


def _approaches(ends: list[tuple[float, float, float]], reach: float) -> Lines:
    """Returns the lines that end at points in the grasp frame and follow the approach for `reach` metres."""
    way = torch.tensor([0.0, 0.0, reach])
    return torch.tensor(ends) - way, way.repeat(len(ends), 1)


def _ray(position: tuple[float, float, float], about_y: float) -> Tensor:
    c, s = math.cos(about_y), math.sin(about_y)
    x, y, z = position
    return torch.tensor([[c, 0.0, s, x], [0.0, 1.0, 0.0, y], [-s, 0.0, c, z], [0.0, 0.0, 0.0, 1.0]])
