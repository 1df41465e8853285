import math

import pytest
import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import invert, is_rigid, make_pose, transform

DTYPES = (torch.float32, torch.float64)


def random_poses(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return make_pose(roma.random_rotmat(shape, dtype=dtype), torch.randn(*shape, 3, dtype=dtype))


def test_make_pose_by_hand() -> None:
    rotation = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    pose = make_pose(rotation, torch.tensor([1.0, 2.0, 3.0]))
    assert pose.tolist() == [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


def test_make_pose_broadcasts() -> None:
    rotations, positions = roma.random_rotmat((4, 1)), torch.randn(5, 3)
    poses = make_pose(rotations, positions)
    assert poses.shape == (4, 5, 4, 4)
    assert torch.equal(poses[2, 3], make_pose(rotations[2, 0], positions[3]))
    assert make_pose(torch.eye(3), positions).shape == (5, 4, 4)


def test_transform_by_hand() -> None:
    # A quarter turn about z, then 1 m along x.
    T = torch.tensor([[0.0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    assert transform(T, torch.tensor([[1.0, 0.0, 0.0], [0.0, 2.0, 5.0]])).tolist() == [[1, 1, 0], [-1, 0, 5]]


def test_frames_cancel() -> None:
    T_a_b, T_b_c, points = random_poses(3, 2), random_poses(3, 2), torch.randn(3, 2, 6, 3, dtype=torch.float64)
    assert torch.allclose(transform(T_a_b @ T_b_c, points), transform(T_a_b, transform(T_b_c, points)))


@pytest.mark.parametrize("dtype", DTYPES)
def test_invert(dtype: torch.dtype) -> None:
    T = random_poses(20, dtype=dtype)
    identity = torch.eye(4, dtype=dtype).expand(20, 4, 4)
    assert invert(T).dtype == dtype
    assert torch.allclose(invert(T) @ T, identity, atol=1e-5)
    assert torch.allclose(T @ invert(T), identity, atol=1e-5)
    assert torch.allclose(invert(invert(T)), T, atol=1e-5)


def test_invert_and_transform_are_differentiable() -> None:
    T, points = random_poses(2).requires_grad_(), torch.randn(2, 3, 3, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda T, points: transform(invert(T), points), (T, points))


@pytest.mark.parametrize("dtype", DTYPES)
def test_rigid_transforms_are_rigid(dtype: torch.dtype) -> None:
    assert is_rigid(random_poses(7, 3, dtype=dtype)).all()
    assert is_rigid(random_poses(7, 3, dtype=dtype)).shape == (7, 3)
    assert is_rigid(torch.eye(4, dtype=dtype)).shape == ()


def test_other_matrices_are_not_rigid() -> None:
    scaled, mirrored, sheared = torch.eye(4), torch.diag(torch.tensor([-1.0, 1, 1, 1])), torch.eye(4)
    scaled[:3, :3] *= 1.001
    sheared[0, 1] = 0.01
    perspective, nan_position, inf_rotation = torch.eye(4), torch.eye(4), torch.eye(4)
    perspective[3, 0] = 0.1
    nan_position[0, 3] = math.nan
    inf_rotation[0, 0] = math.inf
    matrices = [scaled, mirrored, sheared, perspective, nan_position, inf_rotation, torch.zeros(4, 4), torch.eye(4)]
    assert is_rigid(torch.stack(matrices)).tolist() == [False] * 7 + [True]


def test_tolerance() -> None:
    slightly = torch.eye(4)
    slightly[0, 1] = 0.01
    assert not is_rigid(slightly)
    assert is_rigid(slightly, tolerance=0.1)
