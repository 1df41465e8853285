"""Grippers: their dimensions, and what follows from them."""

from dataclasses import replace

import pytest
import torch

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.grippers import (
    DEFAULT_GRIPPER,
    FRANKA,
    ROBOTIQ_2F85,
    ROBOTIQ_2F140,
    Fingers,
    Gripper,
    Probes,
    find_gripper,
)
from nerfgrasp.testing import ConformanceError, check_gripper

BUILT_IN = [ROBOTIQ_2F85, ROBOTIQ_2F140, FRANKA]


@pytest.mark.parametrize("gripper", BUILT_IN, ids=lambda gripper: gripper.name)
def test_built_ins_are_registered_under_their_names(gripper: Gripper) -> None:
    assert find_gripper(gripper.name) == gripper
    check_gripper(gripper)


def test_the_default_is_the_papers() -> None:
    assert find_gripper() == DEFAULT_GRIPPER == ROBOTIQ_2F85


def test_an_unknown_name_lists_near_misses() -> None:
    with pytest.raises(UserError, match=r"unknown gripper 'frank': did you mean 'franka'\?"):
        find_gripper("frank")


def test_a_plug_in_that_is_not_a_gripper_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "load", lambda group, name: 3)
    with pytest.raises(
        UserError, match=r"gripper 'franka' \(nerfgrasp\.grippers:FRANKA of .*\) is of type int, not Gripper"
    ):
        find_gripper("franka")


@pytest.mark.parametrize("gripper", BUILT_IN, ids=lambda gripper: gripper.name)
def test_open_boxes_span_the_gripper(gripper: Gripper) -> None:
    body, left, right = gripper.open_boxes()
    assert left[0][2] + left[1][2] == pytest.approx(gripper.tip)
    assert right[0][0] - right[1][0] == pytest.approx(gripper.fingers.stroke / 2)
    assert left[0][0] == pytest.approx(-right[0][0])
    assert body[0][2] + body[1][2] == pytest.approx(left[0][2] - left[1][2]) == pytest.approx(gripper.palm)
    assert gripper.palm < 0.0 < gripper.tip


def test_masses_are_the_manuals() -> None:
    for gripper, mass in ((ROBOTIQ_2F85, 0.925), (ROBOTIQ_2F140, 1.025)):
        assert 2 * gripper.finger_mass + gripper.body_mass == pytest.approx(mass)


def test_settings_are_those_that_results_have_always_hashed() -> None:
    settings = ROBOTIQ_2F85.settings()
    assert set(settings) == {"name", "fingers", "finger_length", "setback", "body", "body_mass", "finger_mass"}
    assert settings["name"] == "Robotiq 2F-85"


def test_lines_start_behind_the_fingertips_and_the_palm() -> None:
    start, vector = FRANKA.finger_lines(0.05)
    assert start.shape == vector.shape == (12, 3)
    assert torch.allclose((start + vector)[:, 2], torch.tensor(FRANKA.tip))
    assert torch.allclose(vector, torch.tensor([0.0, 0.0, 0.05]))
    assert start[:, 0].abs().min() > FRANKA.fingers.stroke / 2
    start, vector = FRANKA.palm_lines(0.05)
    assert start.shape == (9, 3)
    assert torch.allclose((start + vector)[:, 2], torch.tensor(FRANKA.palm))


def test_gap_lines_run_from_pad_to_pad() -> None:
    start, vector = FRANKA.gap_lines()
    assert torch.allclose(start[:, 0], torch.tensor(-0.04))
    assert torch.allclose((start + vector)[:, 0], torch.tensor(0.04))
    assert start[:, 1].abs().max() < FRANKA.fingers.pad_width / 2
    assert start[:, 2].abs().max() < FRANKA.fingers.pad_height / 2


def test_probes_are_the_papers_for_its_gripper_and_scale_with_others() -> None:
    assert ROBOTIQ_2F85.probes == Probes()
    probes = ROBOTIQ_2F140.probes
    assert probes.closing / probes.reach == pytest.approx(Probes().closing / Probes().reach)
    assert probes.closing == pytest.approx(0.02 * 140 / 85)
    assert probes.across == pytest.approx(0.015 * 27 / 22)
    assert probes.approach == pytest.approx(0.0125 * 65 / 37.5)


def test_measured_probes_are_not_scaled() -> None:
    assert replace(FRANKA, measured_probes=Probes()).probes == Probes()


def test_the_outline_shows_the_fingers_and_the_palm() -> None:
    outline = FRANKA.outline()
    assert outline[0].tolist() == pytest.approx([-0.04, 0.0, FRANKA.tip])
    assert outline[-1].tolist() == pytest.approx([0.04, 0.0, FRANKA.tip])
    assert outline[1, 2].item() == pytest.approx(FRANKA.palm)
    assert outline[3, 2] < FRANKA.palm


@pytest.mark.parametrize(
    ("gripper", "rule"),
    [
        ("franka", "object of the class Gripper"),
        (replace(FRANKA, finger_mass=0.0), "positive and finite"),
        (replace(FRANKA, fingers=Fingers(max_width=0.1)), "widest object"),
        (replace(FRANKA, finger_length=0.01), "pads are not higher"),
        (replace(FRANKA, fingers=replace(FRANKA.fingers, palm=0.05)), "as far as the palm"),
        (replace(FRANKA, setback=0.02), "setback"),
    ],
)
def test_contradictory_grippers_do_not_conform(gripper: object, rule: str) -> None:
    with pytest.raises(ConformanceError, match=rule):
        check_gripper(gripper)
