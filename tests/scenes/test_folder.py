import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nerfgrasp.errors import UserError
from nerfgrasp.geometry import Camera, look_at, project
from nerfgrasp.scenes.folder import read_scene, read_truth, write_scene
from nerfgrasp.scenes.prisms import Prism
from nerfgrasp.scenes.scene import Observations, Scene, Truth, Workspace
from nerfgrasp.scenes.shipped import find_scene, shipped_scenes

Edit = Callable[[dict[str, Any]], object]
WIDTH, HEIGHT = 8, 6


def example_scene(name: str = "example") -> Scene:
    """Three views of different intrinsics, with everything that a scene can hold."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (3, 3, HEIGHT, WIDTH), generator=generator) / 255
    eyes = torch.rand(3, 3, generator=generator) + torch.tensor([0.1, 0.2, 0.3])
    intrinsics = torch.tensor([[10.1, 0.0, 4.2], [0.0, 9.7, 3.1], [0.0, 0.0, 1.0]]).repeat(3, 1, 1)
    intrinsics[:, 0, 0] += torch.arange(3) / 3
    camera = Camera(intrinsics, look_at(eyes, torch.zeros(3)), WIDTH, HEIGHT)
    workspace = Workspace(torch.tensor([-0.1, -0.2, 0.01]), torch.tensor([0.1, 0.3, 0.4]))
    parts = (((0.0, 0.0), (0.1, 0.0), (1 / 3, 0.2)),)
    prism = Prism("triangle", parts, 0.07, (0.1, 1 / 3, 0.9), 400.0, look_at(eyes[0], eyes[1]))
    truth = Truth("simple", 7, 3, (prism,), look_at(eyes[1], eyes[2]))
    return Scene(name, Observations(images, camera), workspace, truth)


def edited(folder: Path, edit: Edit) -> Path:
    """A scene folder with its `transforms.json` changed."""
    write_scene(folder, example_scene())
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data))
    return folder


def minimal(folder: Path, frame: dict[str, Any] | None = None, **top: Any) -> Path:
    """A folder as another program would write it: one white frame and nothing of ours."""
    folder.mkdir()
    Image.new("RGB", (WIDTH, HEIGHT), "white").save(folder / "a.png")
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), **(frame or {})}]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 10.0, **top, "frames": frames}))
    return folder


def test_round_trip_is_exact(tmp_path: Path) -> None:
    scene = example_scene()
    write_scene(tmp_path / "example", scene)
    again = read_scene(tmp_path / "example")

    assert again.name == "example"
    assert torch.equal(again.observations.images, scene.observations.images)
    assert torch.equal(again.observations.camera.intrinsics, scene.observations.camera.intrinsics)
    assert torch.equal(again.observations.camera.T_world_camera, scene.observations.camera.T_world_camera)
    assert (again.observations.camera.width, again.observations.camera.height) == (WIDTH, HEIGHT)
    assert torch.equal(again.workspace.minimum, scene.workspace.minimum)
    assert torch.equal(again.workspace.maximum, scene.workspace.maximum)


def test_truth_round_trip_is_exact(tmp_path: Path) -> None:
    scene = example_scene()
    write_scene(tmp_path / "example", scene)
    truth, again = scene.truth, read_truth(tmp_path / "example")

    assert truth is not None
    assert again is not None
    assert (again.task, again.seed, again.index) == ("simple", 7, 3)
    assert again.objects[0].parts == truth.objects[0].parts
    assert again.objects[0].colour == truth.objects[0].colour
    assert torch.equal(again.objects[0].T_world_object, truth.objects[0].T_world_object)
    assert again.demonstration is not None
    assert truth.demonstration is not None
    assert torch.equal(again.demonstration, truth.demonstration)


def test_writing_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_scene(tmp_path / name, example_scene())
    for path in sorted((tmp_path / "a").rglob("*.*")):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()


def test_opengl_axes_by_hand(tmp_path: Path) -> None:
    # At (0, 0, 1), looking straight down with the image's upper edge towards +y: OpenGL's camera axes are then
    # the world's; OpenCV's y and z point the other way.
    matrix = np.eye(4)
    matrix[2, 3] = 1.0
    scene = read_scene(minimal(tmp_path / "s", {"transform_matrix": matrix.tolist()}))
    expected = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])

    assert torch.equal(scene.observations.camera.T_world_camera[0], expected)
    # 0.1 m towards +x is one pixel (f = 10, depth 1) right of the centre, towards +y one pixel up.
    pixels, depth = project(scene.observations.camera, torch.tensor([[[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]]))
    assert torch.allclose(pixels[0], torch.tensor([[5.0, 3.0], [4.0, 2.0]]))
    assert torch.allclose(depth, torch.ones(1, 2))


def test_disk_holds_opengl(tmp_path: Path) -> None:
    scene = example_scene()
    write_scene(tmp_path / "s", scene)
    data = json.loads((tmp_path / "s" / "transforms.json").read_text())
    disk, memory = np.array(data["frames"][1]["transform_matrix"]), scene.observations.camera.T_world_camera[1].numpy()

    assert np.allclose(disk[:, [0, 3]], memory[:, [0, 3]])
    assert np.allclose(disk[:, [1, 2]], -memory[:, [1, 2]])
    assert (data["w"], data["h"]) == (WIDTH, HEIGHT)


def test_shared_intrinsics_stand_at_the_top(tmp_path: Path) -> None:
    scene = example_scene()
    scene.observations.camera.intrinsics[:] = scene.observations.camera.intrinsics[0].clone()
    write_scene(tmp_path / "s", scene)
    data = json.loads((tmp_path / "s" / "transforms.json").read_text())

    assert (data["fl_x"], data["fl_y"], data["cx"], data["cy"]) == (10.1, 9.7, 4.2, 3.1)
    assert torch.equal(read_scene(tmp_path / "s").observations.camera.intrinsics, scene.observations.camera.intrinsics)


@pytest.mark.parametrize(
    ("top", "frame", "expected"),
    [
        ({}, {}, (10.0, 10.0, 4.0, 3.0)),
        ({"fl_y": 11, "cx": 1.5, "cy": 2}, {}, (10.0, 11.0, 1.5, 2.0)),
        ({"fl_y": 11.0}, {"fl_x": 20.0, "fl_y": 21.0, "cx": 5.0}, (20.0, 21.0, 5.0, 3.0)),
        ({"k1": 0.0, "k2": 0, "camera_model": "OPENCV", "w": 8.0, "h": 6}, {}, (10.0, 10.0, 4.0, 3.0)),
    ],
)
def test_intrinsics(
    tmp_path: Path, top: dict[str, Any], frame: dict[str, Any], expected: tuple[float, float, float, float]
) -> None:
    fl_x, fl_y, cx, cy = expected
    camera = read_scene(minimal(tmp_path / "s", frame, **top)).observations.camera
    assert camera.intrinsics[0].tolist() == [[fl_x, 0.0, cx], [0.0, fl_y, cy], [0.0, 0.0, 1.0]]


def test_field_of_view(tmp_path: Path) -> None:
    def by_angle(data: dict[str, Any]) -> None:
        data["camera_angle_x"] = math.pi / 2
        for frame in data["frames"]:
            del frame["fl_x"], frame["fl_y"]

    # Half of the width of 8 pixels, over tan 45°, on both axes.
    intrinsics = read_scene(edited(tmp_path / "s", by_angle)).observations.camera.intrinsics
    assert torch.allclose(intrinsics[:, 0, 0], torch.full((3,), 4.0))
    assert torch.equal(intrinsics[:, 1, 1], intrinsics[:, 0, 0])


def test_file_path_without_suffix_and_default_workspace(tmp_path: Path) -> None:
    scene = read_scene(minimal(tmp_path / "s", {"file_path": "./a"}))
    assert scene.truth is None
    assert torch.equal(scene.workspace.minimum, Workspace().minimum)
    assert torch.equal(scene.workspace.maximum, Workspace().maximum)


def test_transparent_pixels_lie_on_white(tmp_path: Path) -> None:
    folder = minimal(tmp_path / "s")
    pixels = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    pixels[:, : WIDTH // 2] = (255, 0, 0, 255)
    Image.fromarray(pixels).save(folder / "a.png")
    image = read_scene(folder).observations.images[0]
    assert torch.equal(image[:, 0, 0], torch.tensor([1.0, 0.0, 0.0]))
    assert torch.equal(image[:, 0, -1], torch.ones(3))


def test_grey_images_are_read_as_rgb(tmp_path: Path) -> None:
    folder = minimal(tmp_path / "s")
    Image.new("L", (WIDTH, HEIGHT), 51).save(folder / "a.png")
    assert torch.allclose(read_scene(folder).observations.images, torch.tensor(0.2))


def one_frame(**values: Any) -> Edit:
    return lambda data: data["frames"][1].update(values)


def without(key: str) -> Edit:
    return lambda data: data["frames"][1].pop(key)


MATRIX = np.eye(4)
SCALED = np.diag([2.0, 2.0, 2.0, 1.0]).tolist()
MIRRORED = np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()
NOT_A_NUMBER = np.diag([1.0, 1.0, math.nan, 1.0]).tolist()
ENDLESS = np.where(MATRIX > 0, math.inf, 0.0).tolist()


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda data: data.pop("frames"), "transforms.json: no frames"),
        (lambda data: data.update(frames=[]), "transforms.json: no frames"),
        (lambda data: data.update(frames={"a": 1}), "transforms.json: no frames"),
        (lambda data: data["frames"].insert(1, 5), "frame 1: 'file_path' is missing"),
        (without("file_path"), "frame 1: 'file_path' is missing"),
        (without("transform_matrix"), "frame 1: 'transform_matrix' is missing"),
        (without("fl_x"), "frame 1: 'fl_x' is missing"),
        (one_frame(file_path="images/9.png"), "frame 1: the image images/9.png is missing"),
        (one_frame(file_path="images"), "frame 1: the image images is missing"),
        (one_frame(w=9), "frame 1: the image images/001.png is 8x6, but w is 9"),
        (one_frame(h=5), "frame 1: the image images/001.png is 8x6, but h is 5"),
        (one_frame(fl_x=math.nan), "frame 1: 'fl_x' is nan, which is no finite number"),
        (one_frame(fl_x="10"), "frame 1: 'fl_x' is '10', which is no finite number"),
        (one_frame(fl_x=10**400), "which is no finite number"),
        (one_frame(fl_x=True), "frame 1: 'fl_x' is True"),
        (one_frame(fl_y=-1), "frame 1: fl_y is -1, which is no focal length"),
        (one_frame(cx=math.inf), "frame 1: 'cx' is inf"),
        (one_frame(k1=0.01), "frame 1: the images are distorted (k1 is 0.01): undistort them first"),
        (lambda data: data.update(p2=-0.1), "frame 0: the images are distorted (p2 is -0.1)"),
        (lambda data: data.update(camera_model="OPENCV_FISHEYE"), "camera model 'OPENCV_FISHEYE' is no pinhole"),
        (one_frame(transform_matrix=SCALED), "frame 1: 'transform_matrix' is not a rigid transform"),
        (one_frame(transform_matrix=MIRRORED), "frame 1: 'transform_matrix' is not a rigid transform"),
        (one_frame(transform_matrix=NOT_A_NUMBER), "frame 1: 'transform_matrix' holds a number that is not finite"),
        (one_frame(transform_matrix=ENDLESS), "frame 1: 'transform_matrix' holds a number that is not finite"),
        (one_frame(transform_matrix=[[1, 0], [0]]), "frame 1: 'transform_matrix' is not 4x4 numbers"),
        (one_frame(transform_matrix="x"), "frame 1: 'transform_matrix' is not 4x4 numbers"),
        (one_frame(transform_matrix=None), "frame 1: 'transform_matrix' is not 4x4 numbers"),
        (one_frame(transform_matrix=MATRIX[:3].tolist()), "frame 1: 'transform_matrix' is not 4x4 numbers"),
        (lambda data: data.update(nerfgrasp={"version": 99}), "key 'nerfgrasp': not of version 1"),
        (lambda data: data.update(nerfgrasp=[]), "key 'nerfgrasp': not of version 1"),
        (lambda data: data["nerfgrasp"].update(workspace={"minimum": [0, 0, 0]}), "workspace needs"),
        (lambda data: data["nerfgrasp"]["workspace"].update(maximum=[0, 0]), "workspace needs"),
        (lambda data: data["nerfgrasp"]["workspace"].update(maximum=[-1, 1, 1]), "workspace is empty"),
        (lambda data: data["nerfgrasp"]["truth"].pop("seed"), "damaged truth"),
        (lambda data: data["nerfgrasp"].update(truth=5), "damaged truth"),
    ],
)
def test_bad_transforms_are_refused_in_one_line(tmp_path: Path, edit: Edit, message: str) -> None:
    folder = edited(tmp_path / "s", edit)
    with pytest.raises(UserError) as caught:
        read_scene(folder)
    assert message in str(caught.value)
    assert str(folder / "transforms.json") in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", ["", "{", "[]", '"x"', "[" * 100_000, b"\xff\xfe\x00"])
def test_bad_json_is_refused(tmp_path: Path, content: str | bytes) -> None:
    path = tmp_path / "transforms.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UserError, match=r"transforms\.json is not"):
        read_scene(tmp_path)


def test_missing_folder_and_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere: no such folder"):
        read_scene(tmp_path / "nowhere")
    with pytest.raises(UserError, match=r"transforms\.json: no such file"):
        read_scene(tmp_path)


@pytest.mark.parametrize("damage", [lambda b: b"", lambda b: b"no image", lambda b: b[: len(b) // 2]])
def test_unreadable_images_are_refused(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    write_scene(tmp_path / "s", example_scene())
    path = tmp_path / "s" / "images" / "001.png"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(UserError, match=r"frame 1: the image 001\.png cannot be read"):
        read_scene(tmp_path / "s")


def test_image_of_another_size_is_refused(tmp_path: Path) -> None:
    folder = edited(tmp_path / "s", lambda data: [data.pop(key) for key in "wh"])
    Image.new("RGB", (HEIGHT, WIDTH)).save(folder / "images" / "002.png")
    with pytest.raises(UserError, match="frame 2: the image is 6x8, but frame 0's is 8x6"):
        read_scene(folder)


def test_deep_images_are_refused(tmp_path: Path) -> None:
    folder = minimal(tmp_path / "s")
    Image.fromarray(np.full((HEIGHT, WIDTH), 40000, dtype=np.uint16)).save(folder / "a.png")
    with pytest.raises(UserError, match=r"frame 0: the image a\.png has more than 8 bits"):
        read_scene(folder)


def test_a_failed_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(UserError, match=r"cannot write .*scene: No space left on device"):
        write_scene(tmp_path / "scene", example_scene())
    assert list(tmp_path.iterdir()) == []


def test_writing_over_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "kept.txt").write_text("kept")
    with pytest.raises(UserError, match="already there"):
        write_scene(tmp_path, example_scene())
    with pytest.raises(UserError, match="already there"):
        write_scene(tmp_path / "kept.txt", example_scene())
    with pytest.raises(UserError, match="cannot write"):
        write_scene(tmp_path / "kept.txt" / "scene", example_scene())
    assert (tmp_path / "kept.txt").read_text() == "kept"
    assert len(list(tmp_path.iterdir())) == 1


def test_find_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path / "mine", example_scene())
    (tmp_path / "demo").mkdir()
    monkeypatch.setattr("nerfgrasp.scenes.shipped.shipped_scenes", lambda: {"demo": Path("/shipped/demo")})

    assert find_scene(str(tmp_path / "mine")) == tmp_path / "mine"
    assert find_scene("mine") == Path("mine")
    assert find_scene("demo") == Path("/shipped/demo")
    with pytest.raises(UserError, match=r"unknown scene 'dmeo': did you mean 'demo'\?"):
        find_scene("dmeo")
    with pytest.raises(UserError, match="nowhere/scene: no such folder"):
        find_scene("nowhere/scene")


def test_shipped_scenes_can_be_read() -> None:
    for name, folder in shipped_scenes().items():
        assert read_scene(folder).name == name
