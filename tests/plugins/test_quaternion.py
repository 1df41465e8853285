import math

import pytest
import torch
from nerfgrasp_poses.quaternion import Quaternion

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.testing import sample_poses


def test_decode_is_the_rotation_by_hand() -> None:
    half = math.sqrt(0.5)
    quarter_turn_about_z = {"position": torch.tensor([1.0, 2.0, 3.0]), "orientation": torch.tensor([0, 0, half, half])}
    expected = torch.tensor([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    torch.testing.assert_close(Quaternion().decode(quarter_turn_about_z), expected)


def test_a_quaternion_its_negative_and_its_multiples_are_one_rotation() -> None:
    pose = Quaternion()
    params = pose.encode(sample_poses())
    for factor in (-1.0, 0.1, 7.0):
        scaled = params | {"orientation": factor * params["orientation"]}
        torch.testing.assert_close(pose.decode(scaled), sample_poses())


def test_project_clips_positions_and_normalises(workspace: Workspace) -> None:
    params = {"position": torch.tensor([9.0, -9.0, 0.1]), "orientation": torch.tensor([0.0, 0.0, 0.0, 3.0])}
    projected = Quaternion().project(params, workspace)
    torch.testing.assert_close(projected["position"], torch.tensor([0.25, -0.2, 0.1]))
    torch.testing.assert_close(projected["orientation"], torch.tensor([0.0, 0.0, 0.0, 1.0]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_decode_tells_half_turns_apart(dtype: torch.dtype) -> None:
    about = [torch.diag(torch.tensor(d, dtype=dtype)) for d in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
    T = make_pose(torch.stack(about), torch.zeros(3, 3, dtype=dtype))
    torch.testing.assert_close(Quaternion().decode(Quaternion().encode(T)), T)
