"""Grippers: their dimensions, and what follows from them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

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


def test_own_probes_are_not_scaled() -> None:
    assert replace(FRANKA, own_probes=Probes()).probes == Probes()


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
        (replace(FRANKA, name="my hand"), "a name has only letters, digits, _, . and -, not 'my hand'"),
    ],
)
def test_the_check_names_the_rule(gripper: object, rule: str) -> None:
    with pytest.raises(ConformanceError, match=rule):
        check_gripper(gripper)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"finger_mass": 0.0}, "finger_mass is 0.0: it must be positive and finite"),
        ({"body": (0.1, float("nan"), 0.1)}, "body is .*: it must be positive and finite"),
        ({"fingers": Fingers(max_width=0.1)}, "max_width is 0.1: it must be at most 0.085, the stroke"),
        ({"finger_length": 0.01}, "pad_height is 0.0185: it must be at most 0.01, the finger_length"),
        ({"setback": 0.02}, "setback is 0.02: it must be at most 0.0152, the thickness of a finger"),
        ({"fingers": replace(FRANKA.fingers, palm=0.05)}, "palm is 0.05: it must be at most 0.03775, the distance"),
    ],
)
def test_contradictory_dimensions_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        replace(FRANKA, **changes)


HAND = {
    "name": "my_hand",
    "stroke": 0.09,
    "finger_length": 0.06,
    "finger_thickness": 0.01,
    "pad_width": 0.02,
    "pad_height": 0.03,
    "body": [0.1, 0.06, 0.08],
}
URDF = """<robot name="hand"><link name="base"/><link name="a"/><link name="b"/>
<joint name="left" type="prismatic"><parent link="base"/><child link="a"/></joint>
<joint name="right" type="fixed"><parent link="base"/><child link="b"/></joint></robot>"""


def write(folder: Path, **changes: Any) -> Path:
    path = folder / "my-hand.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in {**HAND, **changes}.items() if value != "absent"}))
    return path


def test_a_file_gives_a_gripper(tmp_path: Path) -> None:
    hand = find_gripper(str(write(tmp_path)))
    assert (hand.name, hand.title, hand.fingers.stroke, hand.body) == ("my_hand", "my_hand", 0.09, (0.1, 0.06, 0.08))
    assert hand.palm == pytest.approx(-0.045)
    assert hand.max_width == pytest.approx(0.075)
    assert hand.fingers.palm == pytest.approx(0.04)
    assert hand.probes.closing == pytest.approx(0.02 * 90 / 85)
    assert hand.hand_model is None
    check_gripper(hand)


def test_a_file_gives_optional_dimensions(tmp_path: Path) -> None:
    probes = {"closing": 0.03, "across": 0.01, "approach": 0.02, "reach": 0.02}
    changes = {"title": "My hand", "max_width": 0.08, "palm_reach": 0.02, "setback": 0, "probes": probes}
    hand = find_gripper(write(tmp_path, **changes))
    assert (hand.title, hand.max_width, hand.fingers.palm, hand.setback) == ("My hand", 0.08, 0.02, 0.0)
    assert hand.probes == Probes(0.03, 0.01, 0.02, 0.02)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stroke": "absent"}, "stroke is missing: distance between the pads when open, metres"),
        ({"stroke": 85.0}, "stroke is 85.0: input should be less than or equal to 1"),
        ({"stroke": 0}, "stroke is 0: input should be greater than 0"),
        ({"stroke": "wide"}, "stroke is 'wide': input should be a valid number"),
        ({"stroke": True}, "stroke is True: input should be a valid number"),
        ({"pad_widht": 0.02}, "pad_widht is unknown: did you mean pad_width?"),
        ({"xyz": 0.02}, "xyz is unknown: the keys are name, stroke, "),
        ({"name": "my hand"}, "name is 'my hand': string should match pattern"),
        ({"name": "franka"}, "name is 'franka': that is a registered gripper"),
        ({"body": [0.1, 0.1]}, "body is [0.1, 0.1]: list should have at least 3 items"),
        ({"body": [0.1, 0.1, -1.0]}, "body.2 is -1.0: input should be greater than 0"),
        ({"max_width": 0.1}, "max_width is 0.1: it must be at most 0.09, the stroke"),
        ({"pad_height": 0.07}, "pad_height is 0.07: it must be at most 0.06, the finger_length"),
        ({"probes": {"closing": 0.02}}, "probes.across is missing: distance of all rays from the closing plane"),
        ({"tcp_offset": 0.1}, "tcp_offset is given without urdf"),
        ({"urdf": "hand.urdf", "tcp_offset": 0.1}, "finger_joints is missing: the names of the two prismatic joints"),
        ({"urdf": "hand.urdf", "finger_joints": ["left", "right"]}, "urdf needs either tcp_offset, along z of its"),
        (
            {"urdf": "no.urdf", "finger_joints": ["left", "right"], "tcp_offset": 0.1},
            "urdf: cannot read FOLDER/no.urdf: No such file",
        ),
        (
            {"urdf": "my-hand.yaml", "finger_joints": ["left", "right"], "tcp_offset": 0.1},
            "urdf: FOLDER/my-hand.yaml is not valid XML",
        ),
        (
            {"urdf": "hand.urdf", "finger_joints": ["left", "right"], "tcp_offset": 0.1},
            "finger_joints: 'right' is not a prismatic joint of FOLDER/hand.urdf (choices: left)",
        ),
        (
            {"urdf": "hand.urdf", "finger_joints": ["left", "left"], "T_base_tcp": [[1.0, 0, 0, 0]] * 4},
            "T_base_tcp is not a rigid 4x4 transform",
        ),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    (tmp_path / "hand.urdf").write_text(URDF)
    path = write(tmp_path, **changes)
    with pytest.raises(UserError) as caught:
        find_gripper(path)
    assert str(caught.value).startswith(f"{path}: {message.replace('FOLDER', str(tmp_path))}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [("a: [", "is not valid YAML"), ("just words", "does not hold a gripper's keys"), ("", "does not hold")],
)
def test_a_file_that_is_no_mapping_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "hand.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as caught:
        find_gripper(path)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none\.yaml: no such file"):
        find_gripper(tmp_path / "none.yaml")


def test_a_models_hash_follows_its_files_and_not_their_place(tmp_path: Path) -> None:
    mesh = "<visual><geometry><mesh filename='pad.stl'/></geometry></visual>"
    text = URDF.replace('<link name="a"/>', f'<link name="a">{mesh}</link>').replace("fixed", "prismatic")
    settings = []
    for name, pad in (("one", b"x"), ("two", b"x"), ("three", b"y")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "hand.urdf").write_text(text)
        with pytest.raises(UserError, match="names the mesh 'pad.stl', which cannot be read"):
            find_gripper(write(tmp_path / name, urdf="hand.urdf", finger_joints=["left", "right"], tcp_offset=0.1))
        (tmp_path / name / "pad.stl").write_bytes(pad)
        settings.append(find_gripper(tmp_path / name / "my-hand.yaml").settings())
    assert settings[0] == settings[1] != settings[2]
