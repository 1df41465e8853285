import numpy as np
import torch

from nerfgrasp.geometry import Camera
from nerfgrasp.grippers import ROBOTIQ_2F85
from nerfgrasp.scenes.scene import Grasps, Observations
from nerfgrasp.viz.contact_sheet import CAPTION, MARGIN
from nerfgrasp.viz.figures import PANEL_WIDTH, Panel, picture, to_image

WIDTH, HEIGHT = 3 * (PANEL_WIDTH + MARGIN) + MARGIN, PANEL_WIDTH * 48 // 64 + CAPTION


def test_to_image_rounds_and_clips() -> None:
    rgb = torch.tensor([[[0.0, 0.5, 1.0], [-1.0, 2.0, 0.2]]])
    assert np.asarray(to_image(rgb)).tolist() == [[[0, 128, 255], [0, 255, 51]]]


def test_picture_holds_inputs_above_and_imagined_below(
    observations: Observations, grasps: Grasps, camera: Camera
) -> None:
    green = torch.tensor([0.0, 1.0, 0.0]).expand(48, 64, 3)
    imagined = [[Panel("render", green, camera[1])], [Panel("closer", 1 - green, camera[1])]]
    image = picture(observations, grasps, ROBOTIQ_2F85, imagined, ["best grasp", "somewhere"])
    assert image.size == (WIDTH, 3 * (HEIGHT + MARGIN))
    assert image.getpixel((MARGIN + 5, CAPTION + 5)) == (128, 128, 128)
    assert image.getpixel((MARGIN + 5, HEIGHT + MARGIN + CAPTION + 5)) == (0, 255, 0)
    assert image.getpixel((MARGIN + 5, 2 * (HEIGHT + MARGIN) + CAPTION + 5)) == (255, 0, 255)
    facts = np.asarray(image.crop((2 * MARGIN + PANEL_WIDTH, 2 * (HEIGHT + MARGIN), WIDTH, image.height)))
    assert facts.min() < 60  # something is written there


def test_only_the_best_grasp_is_drawn(observations: Observations, grasps: Grasps) -> None:
    best = Grasps(grasps.T_world_grasp[:1], grasps.value[:1])
    other = Grasps(grasps.T_world_grasp[1:], grasps.value[1:])
    drawn = [np.asarray(picture(observations, each, ROBOTIQ_2F85)) for each in (grasps, best, other)]
    assert drawn[0].shape == (HEIGHT + MARGIN, WIDTH, 3)
    assert np.array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
