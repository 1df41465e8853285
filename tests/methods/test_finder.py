"""The Python interface, on a network of the real kind that computes in no time."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nerfgrasp
from nerfgrasp import GraspFinder, UserError, find_strategy
from nerfgrasp.geometry import Camera
from nerfgrasp.methods import psi
from nerfgrasp.methods.psi import Psi
from nerfgrasp.models.grasp_value import GraspValue, GraspValueConfig
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search import search
from nerfgrasp.search.ranking import grasp_angle

DOCS = Path(__file__).parents[2] / "docs" / "search.md"
FEW = find_strategy("prune", candidates=24, keep=6)


@pytest.fixture(scope="module")
def model(tiny_network: Callable[..., Any]) -> GraspValue:
    torch.manual_seed(0)
    return GraspValue(GraspValueConfig(tiny_network()))


@pytest.fixture
def finder(model: GraspValue) -> GraspFinder:
    return GraspFinder(Psi(model), remember=2)


@pytest.fixture
def seen(cameras: Callable[..., Camera]) -> tuple[Any, Any, Any]:
    """Images, intrinsics and poses of three views, as NumPy arrays."""
    camera = cameras(3)
    images = np.random.default_rng(0).integers(0, 256, (3, 32, 32, 3), dtype=np.uint8)
    return images, camera.intrinsics.double().numpy(), camera.T_world_camera.double().numpy()


def test_three_lines_find_different_grasps(finder: GraspFinder, seen: tuple[Any, Any, Any]) -> None:
    scene = finder.observe(*seen)
    grasps = finder.grasps(scene, count=4, strategy=FEW)
    assert 1 <= len(grasps) <= 4
    assert torch.equal(grasps.value, grasps.value.sort(descending=True).values)
    T = grasps.T_world_grasp
    near = torch.cdist(T[:, :3, 3], T[:, :3, 3]) < 0.02
    alike = grasp_angle(T[:, None, :3, :3].expand(-1, len(T), 3, 3), T[None, :, :3, :3]) < 0.52
    assert not (near & alike).fill_diagonal_(False).any()
    again = finder.grasps(scene, count=4, strategy=FEW)
    other = finder.grasps(scene, count=4, strategy=FEW, seed=1)
    assert torch.equal(T, again.T_world_grasp)
    assert not torch.equal(T[0], other.T_world_grasp[0])


def test_what_is_not_worth_enough_is_left_out(
    finder: GraspFinder, seen: tuple[Any, Any, Any], tiny_network: Callable[..., Any]
) -> None:
    binary = GraspFinder(Psi(GraspValue(GraspValueConfig(tiny_network(), loss="binary"))))
    scene = binary.observe(*seen)
    every = binary.grasps(scene, count=4, strategy=FEW)
    assert len(every) > 1
    for least, count in ((float(every.value[-1]), len(every)), (float(every.value[0]), 1), (1e6, 0)):
        kept = binary.grasps(scene, count=4, strategy=FEW, least_value=least)
        assert torch.equal(kept.value, every.value[:count])
        assert kept.T_world_grasp.shape == (count, 4, 4)
    with pytest.raises(UserError, match="least_value is nan: it must be a finite number"):
        binary.grasps(scene, strategy=FEW, least_value=float("nan"))
    with pytest.raises(UserError, match="least_value is 0: the model's values compare within one scene only"):
        finder.grasps(finder.observe(*seen), strategy=FEW, least_value=0.0)


def test_what_was_observed_is_remembered_by_its_content(
    finder: GraspFinder, seen: tuple[Any, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded = []
    monkeypatch.setattr(
        Psi, "observe", lambda self, observations, workspace: encoded.append(len(observations)) or object()
    )
    images, intrinsics, poses = seen
    first = finder.observe(images, intrinsics, poses)
    assert finder.observe(images.copy(), torch.from_numpy(intrinsics), poses) is first
    assert finder.observe(np.concatenate([images, images]), intrinsics[0], np.concatenate([poses, poses])) is first
    assert encoded == [3]  # of six views three are used
    assert finder.observe(255 - images, intrinsics, poses) is not first
    assert finder.observe(images, intrinsics, poses, [(-0.1, -0.1, 0.0), (0.1, 0.1, 0.1)]) is not first
    assert len(encoded) == 3
    assert finder.observe(images, intrinsics, poses) is not first  # two are remembered
    assert len(encoded) == 4


def test_a_memory_of_nothing_keeps_nothing(model: GraspValue, seen: tuple[Any, Any, Any]) -> None:
    finder = GraspFinder(Psi(model), remember=0)
    assert finder.observe(*seen) is not finder.observe(*seen)
    with pytest.raises(UserError, match="remember is -1"):
        GraspFinder(Psi(model), remember=-1)


@pytest.mark.parametrize(
    ("workspace", "message"),
    [
        ([(0, 0, 0), (0.1, 0.1, -0.1)], "workspace is empty"),
        (Workspace(torch.zeros(3), torch.full((3,), torch.nan)), "not finite"),
        (3, "workspace needs two corners"),
        ([(5, 5, 5), (6, 6, 6)], "camera 0 sees nothing of the workspace"),
    ],
)
def test_what_is_no_workspace_is_told(
    workspace: Any, message: str, finder: GraspFinder, seen: tuple[Any, Any, Any]
) -> None:
    with pytest.raises(UserError, match=message):
        finder.observe(*seen, workspace)


def test_what_cannot_be_searched_is_told(finder: GraspFinder, seen: tuple[Any, Any, Any]) -> None:
    images, intrinsics, poses = seen
    with pytest.raises(UserError, match="the model needs 3 views, the scene has 2"):
        finder.observe(images[:2], intrinsics[:2], poses[:2])
    opengl = poses @ np.diag([1.0, -1.0, -1.0, 1.0])
    with pytest.raises(UserError, match="camera 0 sees nothing of the workspace"):
        finder.observe(images, intrinsics, opengl)
    scene = finder.observe(*seen)
    for arguments, message in (
        ({"count": 0}, "count is 0"),
        ({"strategy": "papper"}, "unknown strategy 'papper'"),
        ({"pose": "quaternoin"}, "unknown pose 'quaternoin'"),
    ):
        with pytest.raises(UserError, match=message):
            finder.grasps(scene, **arguments)


def test_images_may_be_asked_for(
    model: GraspValue, seen: tuple[Any, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(psi, "load_model", lambda name: model)
    finder = GraspFinder.from_pretrained("any", images=5)
    assert finder.method.images == 5
    with pytest.raises(UserError, match="images is 5: the scene has 3"):
        finder.observe(*seen)
    GraspFinder.from_pretrained("any", images=3).observe(*seen)


def test_the_package_offers_what_it_says() -> None:
    assert nerfgrasp.GraspFinder is GraspFinder
    assert all(hasattr(nerfgrasp, name) for name in nerfgrasp.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Graspfinder'"):
        nerfgrasp.Graspfinder  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.skipif(not DOCS.exists(), reason="the documentation stands in the checkout")
def test_the_documented_program_runs(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"candidates": 8, "keep": 2}
    monkeypatch.setattr(psi, "search", lambda *args, **kwargs: search(*args, **{**kwargs, **small}))
    program = "\n".join(re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), flags=re.DOTALL))
    assert "GraspFinder.from_pretrained(" in program
    exec(compile(program, str(DOCS), "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) >= 3
