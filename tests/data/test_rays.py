from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfgrasp.data.packed import PackedScenes
from nerfgrasp.data.rays import HeldOutViews, ImageBatch, RayBatch, RayData
from nerfgrasp.data.streams import SceneSet
from nerfgrasp.data.views import to_float
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import box_intersection, invert, project, transform


def rays(folder: Path, **changes: Any) -> RayData:
    scenes = SceneSet(folder, scenes=4, views=6, seed=5, size=32)
    data = RayData(scenes, scenes, **{"views": 2, "scenes_per_step": 3, "rays_per_scene": 40, **changes})
    data.check()
    data.setup("fit")
    return data


def batch(data: RayData, seed: int = 0) -> RayBatch:
    return data.draw(np.random.default_rng(seed))


def scene_of(scenes: PackedScenes, found: RayBatch, b: int) -> int:
    """The number of the scene that entry `b` of a batch shows."""
    cameras = torch.from_numpy(np.array(scenes.T_world_camera))
    return int((cameras == found.inputs.T_world_camera[b, 0]).all(-1).all(-1).nonzero()[0, 0])


def view_of(scenes: PackedScenes, scene: int, origin: torch.Tensor) -> int:
    """The number of the view from which a ray starts."""
    return int((scenes.camera(scene).T_world_camera[:, :3, 3] == origin).all(-1).nonzero()[0, 0])


def test_shapes(packed_set: Path) -> None:
    found = batch(rays(packed_set))
    assert found.inputs.images.shape == (3, 2, 3, 32, 32)
    assert found.inputs.camera().intrinsics.shape == (3, 2, 3, 3)
    assert found.origins.shape == found.directions.shape == found.colours.shape == (3, 40, 3)
    assert found.inputs.minimum.shape == found.inputs.maximum.shape == (3, 1, 3)
    torch.testing.assert_close(found.directions.norm(dim=-1), torch.ones(3, 40))
    assert all(part.dtype == torch.float32 for part in (*found.inputs, *found[1:]))


def test_colours_are_those_of_the_pixels_that_the_rays_pass(packed_set: Path) -> None:
    scenes = PackedScenes(packed_set)
    found = batch(rays(packed_set, target_views=3, object_share=0.5))
    for b in range(3):
        scene = scene_of(scenes, found, b)
        for r in range(40):
            view = view_of(scenes, scene, found.origins[b, r])
            ahead = (found.origins[b, r] + 0.7 * found.directions[b, r])[None]
            pixel, depth = project(scenes.camera(scene)[view], ahead)
            assert depth > 0
            x, y = pixel[0].tolist()
            assert x % 1 == pytest.approx(0.5, abs=1e-3), "rays pass pixels' centres"
            expected = scenes.images[scene, view, int(y), int(x)] / np.float32(255)
            assert np.array_equal(found.colours[b, r].numpy(), expected)


def test_inputs_and_targets_are_distinct_views(packed_set: Path) -> None:
    scenes, data = PackedScenes(packed_set), rays(packed_set, views=3, target_views=3)
    pairs = set()
    for seed in range(5):
        found = batch(data, seed)
        chosen = [scene_of(scenes, found, b) for b in range(3)]
        assert len(set(chosen)) == 3
        for b, scene in enumerate(chosen):
            inputs = {view_of(scenes, scene, T[:3, 3]) for T in found.inputs.T_world_camera[b]}
            targets = {view_of(scenes, scene, origin) for origin in found.origins[b]}
            assert len(inputs) == 3
            assert len(targets) == 3
            assert not inputs & targets
            pairs.add((tuple(sorted(inputs)), tuple(sorted(targets))))
    assert len(pairs) > 3, "views are drawn anew"


def test_object_rays_hit_the_object(packed_set: Path) -> None:
    scenes = PackedScenes(packed_set)
    found = batch(rays(packed_set, object_share=0.75, rays_per_scene=20))
    for b in range(3):
        box = scenes.truth(scene_of(scenes, found, b)).objects[0]
        T_object_world = invert(box.T_world_object)
        origins, directions = found.origins[b], found.directions[b] @ T_object_world[:3, :3].T
        least, most = torch.tensor([*box.parts[0][0], 0.0]), torch.tensor([*box.parts[0][2], box.height])
        near, far = box_intersection(transform(T_object_world, origins), directions, least, most)
        assert (far > near)[:15].all()
        colour = torch.tensor(box.colour).expand(15, 3)
        torch.testing.assert_close(found.colours[b, :15], colour, atol=0.003, rtol=0)


def test_other_rays_meet_the_workspace(packed_set: Path) -> None:
    found = batch(rays(packed_set))
    near, far = box_intersection(found.origins, found.directions, found.inputs.minimum, found.inputs.maximum)
    assert (far > near).all()


def test_without_objects_in_sight_rays_come_from_all_over(packed_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = rays(packed_set, object_share=1.0)
    assert data.train_scenes is not None
    monkeypatch.setattr(data.train_scenes, "masks", np.zeros_like(data.train_scenes.masks))
    assert batch(data).origins.shape == (3, 40, 3)


def test_a_draw_is_a_function_of_its_generator(packed_set: Path) -> None:
    data = rays(packed_set)
    torch.testing.assert_close(batch(data, 1), batch(data, 1), rtol=0, atol=0)
    assert not torch.equal(batch(data, 1).origins, batch(data, 2).origins)


def test_held_out_views(packed_set: Path) -> None:
    scenes, data = PackedScenes(packed_set), rays(packed_set, validation_scenes=2, validation_targets=3)
    items: list[ImageBatch] = list(data.val_dataloader())
    assert len(items) == 6
    item = items[4]  # scene 1, its second target, view 2 + 1
    assert torch.equal(item.inputs.images[0], to_float(scenes.images[1, :2]))
    assert torch.equal(item.inputs.T_world_camera[0], scenes.camera(1).T_world_camera[:2])
    assert torch.equal(item.target.images, to_float(scenes.images[1, 3]))
    assert torch.equal(item.target.T_world_camera, scenes.camera(1).T_world_camera[3])
    assert torch.equal(item.objects, torch.from_numpy(np.array(scenes.masks[1, 3]) > 0))
    assert len(rays(packed_set, validation_scenes=99).val_dataloader()) == 4
    skipped = HeldOutViews(scenes, 1, 2, 1, skip=5)[0]
    assert torch.equal(skipped.target.images, to_float(scenes.images[0, 5]))


def test_validation_opens_no_training_set(packed_set: Path, tmp_path: Path) -> None:
    nowhere = SceneSet(tmp_path / "nowhere", scenes=4, views=6, seed=0)
    data = RayData(nowhere, SceneSet(packed_set, scenes=4, views=6, seed=5))
    data.setup("validate")
    assert data.train_scenes is None
    with pytest.raises(UserError, match="nowhere is no data set"):
        data.setup("fit")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scenes_per_step": 5}, "train: 5 scenes are needed at once, the set has 4"),
        ({"views": 5, "target_views": 2}, "train: 7 views are needed at once, the set has 6"),
        ({"views": 5, "validation_targets": 2}, "validation: 7 views are needed at once, the set has 6"),
    ],
)
def test_more_than_the_set_holds_is_refused(packed_set: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        rays(packed_set, **change)
