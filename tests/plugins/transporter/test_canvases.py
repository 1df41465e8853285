"""Canvases: cells and the grasps that they stand for, and what the network makes of a turned scene."""

import math

import numpy as np
import pytest
import torch
from nerfgrasp_baselines.transporter.canvases import (
    canvas_side,
    cell_centres,
    cell_grasps,
    cut,
    grasp_cell,
    planar_pose,
    turned,
    upright,
)
from nerfgrasp_baselines.transporter.data import moved_canvas
from nerfgrasp_baselines.transporter.network import Attention, TransporterConfig

from nerfgrasp.geometry import is_rigid, make_pose
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.ranking import grasp_angle

SIDE, PIXEL, COUNT = 48, 0.02, 18


@pytest.fixture
def moved(workspace: Workspace) -> torch.Tensor:
    """The canvases `[18, 3, 3]` of an augmented scene."""
    first = moved_canvas(upright(workspace), torch.zeros(2), 0.05, 1.0, np.random.default_rng(0))
    return turned(first, COUNT)


def test_a_planar_pose_by_hand() -> None:
    T = planar_pose(torch.tensor(math.pi / 2), torch.tensor([0.1, 0.2]))
    torch.testing.assert_close(T @ torch.tensor([1.0, 0.0, 1.0]), torch.tensor([0.1, 1.2, 1.0]))
    last = turned(T, 4)[3]
    torch.testing.assert_close(last[:2, 0], torch.tensor([-(0.5**0.5), -(0.5**0.5)]))
    torch.testing.assert_close(last[:2, 2], T[:2, 2])


def test_cells_by_hand() -> None:
    assert cell_centres(2, 0.5).tolist() == [[[-0.25, -0.25], [0.25, -0.25]], [[-0.25, 0.25], [0.25, 0.25]]]
    T = cell_grasps(torch.tensor([[0, 0, 1]]), torch.eye(3)[None], 2, 0.5)[0]
    assert T.tolist() == [[1.0, 0.0, 0.0, 0.25], [0.0, -1.0, 0.0, -0.25], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    assert canvas_side((160, 160), 8) == 224


def test_a_cell_is_that_of_its_grasp(moved: torch.Tensor) -> None:
    rng = np.random.default_rng(1)
    cells = torch.from_numpy(np.stack([rng.integers(0, most, 50) for most in (COUNT, SIDE, SIDE)], axis=-1))
    T = cell_grasps(cells, moved, SIDE, PIXEL)
    assert is_rigid(T).all()
    assert (T[:, 2, 2] == -1).all()
    assert torch.equal(torch.stack([grasp_cell(one, moved, SIDE, PIXEL) for one in T]), cells)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_grasp_is_that_of_its_cell(moved: torch.Tensor, sign: float) -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        angle, (x, y) = rng.uniform(-math.pi, math.pi), rng.uniform(-0.2, 0.2, 2)
        closing = sign * torch.tensor([math.cos(angle), math.sin(angle), 0.0])
        down = torch.tensor([0.0, 0.0, -1.0])
        rotation = torch.stack([closing, torch.linalg.cross(down, closing), down], dim=-1)
        T = make_pose(rotation, torch.tensor([x, y, 0.05]).float())
        again = cell_grasps(grasp_cell(T, moved, SIDE, PIXEL)[None], moved, SIDE, PIXEL)[0]
        assert (again[:2, 3] - T[:2, 3]).norm() <= PIXEL * 0.5**0.5 + 1e-6
        assert grasp_angle(again[:3, :3], T[:3, :3]) <= math.pi / COUNT / 2 + 1e-3


def test_a_canvas_that_is_not_turned_is_the_map(workspace: Workspace) -> None:
    maps = torch.rand(4, 25, 25, generator=torch.Generator().manual_seed(0))
    canvases = turned(upright(workspace), 2)
    pictures, inside = cut(maps, workspace, canvases, 25, 0.02)
    torch.testing.assert_close(pictures[0], maps, atol=1e-5, rtol=0)
    # Its x axis is the world's y, its y axis against the world's x.
    torch.testing.assert_close(pictures[1], torch.rot90(maps, 1, (1, 2)), atol=1e-5, rtol=0)
    assert inside.all()


def test_what_is_not_on_the_map_is_marked(workspace: Workspace) -> None:
    pictures, inside = cut(torch.ones(4, 25, 25), workspace, turned(upright(workspace), 4), 35, 0.02)
    assert inside[0].sum() == 25**2
    assert inside[0, 5:30, 5:30].all()
    # Turned by 45°, the map's corners reach out to the sides' middles.
    assert inside[1, 17, [1, 33]].all()
    assert not inside[1, 5, 5]
    assert (pictures[:, :, 17, 17] == 1).all()
    assert (pictures[0, :, 0] == 0).all()


def test_the_label_is_where_the_scene_went(workspace: Workspace) -> None:
    spot = torch.tensor([0.07, 0.11])
    column, row = ((spot - workspace.minimum[:2]) / 0.01).long()
    maps = torch.zeros(4, 50, 50)
    maps[3, row, column] = 1.0
    T = make_pose(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([*spot, 0.05]))
    rng = np.random.default_rng(3)
    for _ in range(5):
        canvases = turned(moved_canvas(upright(workspace), spot, 0.05, 0.3, rng), COUNT)
        pictures, _ = cut(maps, workspace, canvases, 72, 0.01)
        canvas, *cell = grasp_cell(T, canvases, 72, 0.01).tolist()
        brightest = divmod(int(pictures[canvas, 3].argmax()), 72)
        assert max(abs(a - b) for a, b in zip(brightest, cell, strict=True)) <= 1


def test_a_shift_keeps_the_grasp_on_the_canvas(workspace: Workspace) -> None:
    rng, corner = np.random.default_rng(4), workspace.maximum[:2] - 0.02
    middles = [moved_canvas(upright(workspace), corner, 0.05, 0.25, rng)[:2, 2] for _ in range(10)]
    assert all(torch.equal(middle, upright(workspace)[:2, 2]) for middle in middles)
    near = upright(workspace)[:2, 2]
    middles = [moved_canvas(upright(workspace), near, 0.05, 0.25, rng)[:2, 2] for _ in range(10)]
    assert len({tuple(middle.tolist()) for middle in middles}) == 10
    assert all((middle - near).abs().max() <= 0.05 for middle in middles)


def test_a_turned_scene_has_turned_values(workspace: Workspace) -> None:
    torch.manual_seed(0)
    network = Attention(TransporterConfig(widths=(4, 8), blocks=1, fold=2, rotations=4, pixel=0.025, skips=True))
    for block in (module for module in network.modules() if hasattr(module, "third")):
        torch.nn.init.normal_(block.third.weight, std=0.3)
    maps = torch.rand(4, 20, 20)
    with torch.no_grad():
        values, _ = network.look(maps, workspace)
        # A quarter turn of the scene, from x to y, is two of four steps.
        again, _ = network.look(torch.rot90(maps, -1, (1, 2)), workspace)
    assert values.shape == (4, 28, 28)
    inside = values[:2].isfinite() & again[2:].isfinite()
    assert inside.float().mean() > 0.4
    torch.testing.assert_close(again[2:][inside], values[:2][inside], atol=1e-4, rtol=1e-3)
    assert values[values.isfinite()].std() > 0.01


def test_mixed_precision_leaves_canvases_alone() -> None:
    maps, grasp = torch.rand(4, 30, 40), make_pose(torch.eye(3), torch.tensor([0.13, 0.07, 0.0]))

    def all_of_it() -> list[torch.Tensor]:
        canvases = turned(upright(Workspace()), 5)
        cell = grasp_cell(grasp, canvases, 16, 0.02)
        found = cell_grasps(cell[None], canvases, 16, 0.02)
        return [canvases, *cut(maps, Workspace(), canvases, 16, 0.02), cell, found]

    with torch.autocast("cpu", torch.bfloat16):
        mixed = all_of_it()
    assert all(torch.equal(*pair) for pair in zip(mixed, all_of_it(), strict=True))
