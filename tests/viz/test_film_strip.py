import pytest
import torch

from nerfgrasp.geometry import make_pose, project

pytest.importorskip("pybullet")

from nerfgrasp.sim.film import Frame
from nerfgrasp.sim.tasks import simple_scene
from nerfgrasp.viz.film_strip import CAPTIONS, SIDE, close_up, film_strip

DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


@pytest.mark.parametrize("closing", [DOWN, DOWN[:, [2, 0, 1]]])  # the second closes upright, so y is level
def test_the_close_up_has_the_grasp_in_its_middle(closing: torch.Tensor) -> None:
    grasp = make_pose(closing, torch.tensor([0.1, -0.05, 0.1]))
    camera = close_up(grasp)
    pixel, depth = project(camera[0], grasp[None, :3, 3])
    assert pixel[0].tolist() == pytest.approx([camera.width / 2] * 2, abs=1.0)
    assert float(depth) == pytest.approx(0.6, abs=1e-3)


def test_a_grasp_whose_third_axis_is_upright_is_seen_too() -> None:
    upright = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # y points up: it has no side
    assert close_up(make_pose(upright, torch.tensor([0.1, 0.0, 0.1]))).T_world_camera.isfinite().all()


def test_frames_stand_side_by_side_with_what_has_been_done() -> None:
    truth = simple_scene(7, 0)
    camera = close_up(make_pose(DOWN, torch.tensor([0.0, 0.0, 0.05])))
    section = film_strip("how it went", (Frame("pregrasp", truth), Frame("after", truth)), camera)
    assert section.heading == "how it went"
    assert section.captions == (CAPTIONS["pregrasp"], CAPTIONS["after"])
    assert [image.size for image in section.images] == [(SIDE, SIDE)] * 2
