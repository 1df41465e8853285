from dataclasses import replace

import pytest
import torch

from nerfgrasp.errors import UserError
from nerfgrasp.scenes.meshes import MeshObject
from nerfgrasp.scenes.objects import object_from_json, object_name
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.scenes.truth import truth_from_json, truth_to_json

BANANA = MeshObject(
    "banana", "ycb", "0123456789abcdef", 0.066, (0.1, 0.2, 1 / 3),
    ((1e-4, 0.0, 1e-7), (0.0, 2e-4, 0.0), (1e-7, 0.0, 3e-4)), torch.eye(4) * 1.1,
)  # fmt: skip
BOX = Prism("box", (((-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)),), 0.1, (1.0, 0.0, 0.0), 300.0, torch.eye(4))


@pytest.mark.parametrize("thing", [BANANA, BOX])
def test_json_gives_back_the_object(thing):
    back = object_from_json(thing.to_json())
    assert type(back) is type(thing)
    assert torch.equal(back.T_world_object, thing.T_world_object)
    assert replace(back, T_world_object=thing.T_world_object) == thing


def test_a_truth_may_mix_meshes_and_prisms():
    truth = truth_from_json(truth_to_json(Truth("novel", 1, 2, (BANANA, BOX))), "here")
    assert [object_name(thing) for thing in truth.objects] == ["banana", "box"]


def test_damage_is_told_with_its_place():
    data = truth_to_json(Truth("novel", 1, 2, (BANANA,)))
    data["objects"][0]["centre"] = [0.0, 1.0]
    with pytest.raises(UserError, match="^scene.json: damaged truth"):
        truth_from_json(data, "scene.json")
