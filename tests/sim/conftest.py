"""Scenes of one known object."""

from collections.abc import Callable

import pytest
import torch

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.prisms import Polygon, Prism
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim import shapes


@pytest.fixture
def scene_of() -> Callable[..., Truth]:
    """Returns a function that puts one red prism, upright and unturned, on the table."""

    def make(
        kind: str = "box", parts: tuple[Polygon, ...] | None = None, height: float = 0.1, density: float = 400.0
    ) -> Truth:
        place = torch.tensor([0.05, -0.02, 0.0])
        parts = shapes.box(0.04, 0.08) if parts is None else parts
        prism = Prism(kind, parts, height, (1.0, 0.0, 0.0), density, make_pose(torch.eye(3), place))
        return Truth("simple", 0, 0, (prism,))

    return make


@pytest.fixture
def grasp_at() -> Callable[..., torch.Tensor]:
    """Returns a function of the tool centre point: the grasp from above that closes along world x."""

    def make(x: float = 0.05, y: float = -0.02, z: float = 0.075) -> torch.Tensor:
        return make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([x, y, z]))

    return make
