import pytest
import roma
import torch

from nerfgrasp.geometry import Camera, look_at, make_pose
from nerfgrasp.scenes.scene import Grasps, Observations


@pytest.fixture
def camera() -> Camera:
    """Three cameras about the table, at azimuths 0°, 90° and 180°, 0.6 m out and 0.5 m up."""
    eye = torch.tensor([[0.6, 0.0, 0.5], [0.0, 0.6, 0.5], [-0.6, 0.0, 0.5]])
    intrinsics = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])
    return Camera(intrinsics.expand(3, 3, 3), look_at(eye, torch.zeros(3)), width=64, height=48)


@pytest.fixture
def observations(camera: Camera) -> Observations:
    return Observations(torch.full((3, 3, 48, 64), 0.5), camera)


@pytest.fixture
def grasps() -> Grasps:
    """Two grasps from above, the better one at the table's centre."""
    down = roma.rotvec_to_rotmat(torch.tensor([torch.pi, 0.0, 0.0]))
    T = make_pose(down, torch.tensor([[0.0, 0.0, 0.05], [0.1, 0.1, 0.05]]))
    return Grasps(T, torch.tensor([2.0, 1.0]))
