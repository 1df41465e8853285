"""What each parameterization means, by hand; that it keeps its group's promises is tested in test_conformance.py."""

import math

import roma
import torch
from nerfgrasp_poses.axis_angle import AxisAngle
from nerfgrasp_poses.matrix import Matrix
from nerfgrasp_poses.rotvec import RotationVector
from nerfgrasp_poses.whole import Screw, Transform

from nerfgrasp.geometry import make_pose
from nerfgrasp.scenes.scene import Workspace

QUARTER_TURN_ABOUT_Z = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
ORIGIN = torch.zeros(3)


def test_a_rotation_vector_is_axis_times_angle(workspace: Workspace) -> None:
    pose, vector = RotationVector(), torch.tensor([0.0, 0.0, math.pi / 2])
    torch.testing.assert_close(pose.encode(make_pose(QUARTER_TURN_ABOUT_Z, ORIGIN))["orientation"], vector)
    more = {"position": ORIGIN, "orientation": 5 * vector}
    torch.testing.assert_close(pose.project(more, workspace)["orientation"], vector, atol=1e-5, rtol=0)


def test_axis_and_angle_by_hand(workspace: Workspace) -> None:
    pose, about_z = AxisAngle(), torch.tensor([0.0, 0.0, 1.0, math.pi / 2])
    torch.testing.assert_close(pose.encode(make_pose(QUARTER_TURN_ABOUT_Z, ORIGIN))["orientation"], about_z)
    long = {"position": ORIGIN, "orientation": torch.tensor([0.0, 0.0, 3.0, math.pi / 2 + 2 * math.pi])}
    torch.testing.assert_close(pose.decode(long)[:3, :3], QUARTER_TURN_ABOUT_Z, atol=1e-6, rtol=0)
    torch.testing.assert_close(pose.project(long, workspace)["orientation"], about_z, atol=1e-6, rtol=0)
    still = {"position": ORIGIN, "orientation": torch.tensor([0.6, 0.8, 0.0, 0.0])}
    assert torch.equal(pose.project(still, workspace)["orientation"], still["orientation"]), "the axis is kept"


def test_a_matrix_stands_for_the_nearest_rotation() -> None:
    stretched = QUARTER_TURN_ABOUT_Z @ torch.diag(torch.tensor([2.0, 0.5, 3.0]))
    params = {"position": ORIGIN, "orientation": stretched.flatten()}
    torch.testing.assert_close(Matrix().decode(params)[:3, :3], QUARTER_TURN_ABOUT_Z)
    mirrored = {"position": ORIGIN, "orientation": torch.diag(torch.tensor([1.0, 1.0, -0.1])).flatten()}
    assert torch.det(Matrix().decode(mirrored)[:3, :3]) > 0.999


def test_a_transform_s_last_row_counts_for_nothing(workspace: Workspace) -> None:
    T = make_pose(QUARTER_TURN_ABOUT_Z, torch.tensor([0.1, 0.0, 9.0]))
    spoiled = T.clone()
    spoiled[3] = 7.0
    torch.testing.assert_close(Transform().decode({"pose": spoiled.flatten()}), T)
    expected = make_pose(QUARTER_TURN_ABOUT_Z, torch.tensor([0.1, 0.0, workspace.maximum[2]]))
    torch.testing.assert_close(Transform().project({"pose": spoiled.flatten()}, workspace)["pose"], expected.flatten())


def test_a_screw_turns_about_its_axis() -> None:
    """A quarter turn about the vertical through (1, 0, 0): that point stays, the origin goes to (1, -1, 0)."""
    turn = torch.tensor([0.0, 0.0, math.pi / 2])
    slide = -torch.linalg.cross(turn, torch.tensor([1.0, 0.0, 0.0]))
    T = Screw().decode({"pose": torch.cat([turn, slide])})
    torch.testing.assert_close(T, make_pose(QUARTER_TURN_ABOUT_Z, torch.tensor([1.0, -1.0, 0.0])), atol=1e-6, rtol=0)
    lift = Screw().decode({"pose": torch.cat([turn, torch.tensor([0.0, 0.0, 0.2])])})
    torch.testing.assert_close(lift[:3, 3], torch.tensor([0.0, 0.0, 0.2]))


def test_a_screw_is_the_exponential_of_its_twist() -> None:
    twists = torch.randn(20, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    matrices = torch.zeros(20, 4, 4, dtype=torch.float64)
    matrices[:, :3, 3] = twists[:, 3:]
    for i, (x, y, z) in enumerate(twists[:, :3].tolist()):
        matrices[i, :3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    torch.testing.assert_close(Screw().decode({"pose": twists}), torch.linalg.matrix_exp(matrices))


def test_only_whole_transforms_move_the_position_by_turning() -> None:
    T = make_pose(roma.rotvec_to_rotmat(torch.tensor([0.3, 2.0, -1.0])), torch.tensor([0.2, 0.1, 0.15]))
    for pose, group in ((Screw(), "pose"), (RotationVector(), "orientation")):
        params = pose.encode(T)
        params[group][..., :3] += 0.1
        moved = (pose.decode(params)[:3, 3] - T[:3, 3]).norm()
        assert (moved > 0.005) == (group == "pose")
