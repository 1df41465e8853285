import pytest
import torch
from torch import Tensor

from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.occupancy import grid, occupancy, occupied_candidates

LOW, HIGH = torch.tensor([0.03, -0.06, 0.0]), torch.tensor([0.09, 0.03, 0.06])


class Block:
    """A model that sees one block and the table."""

    def __init__(self, density: float = 300.0) -> None:
        self.inside = density

    def density(self, features: object, points: Tensor, directions: Tensor) -> Tensor:
        assert (*points.shape[:1], 3) == directions.shape
        within = ((points > LOW) & (points < HIGH)).all(dim=-1)
        return self.inside * (within | (points[..., 2] < 0.005)).float()


def draw(model: Block, spacing: float = 0.01, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    occupied = occupancy(model, None, Workspace(), spacing)  # type: ignore[arg-type]
    return occupied_candidates(400, Workspace(), generator, 0.5, occupied=occupied)


def test_the_grid_fills_the_workspace() -> None:
    points, cell = grid(Workspace(), 0.03)
    assert points.shape == (17 * 17, 7, 3)
    torch.testing.assert_close(cell, torch.tensor([0.5 / 17, 0.5 / 17, 0.2 / 7]))
    flat = points.flatten(0, 1)
    torch.testing.assert_close(flat.amin(dim=0) - cell / 2, Workspace().minimum)
    torch.testing.assert_close(flat.amax(dim=0) + cell / 2, Workspace().maximum)


def test_candidates_lie_where_the_density_is_and_not_in_the_table() -> None:
    poses = draw(Block())
    position = poses[:, :3, 3]
    assert ((position > LOW - 0.005) & (position < HIGH + 0.005)).all()
    assert position[:, 2].min() > 0.009  # the lowest cell's centre is below 6 mm: that may be the table
    assert position.std(dim=0).min() > 0.01  # all over the block
    assert (-poses[:, 2, 2]).min() > torch.tensor(0.5).cos() - 1e-5


@pytest.mark.parametrize("density", [0.0, float("nan")])
def test_where_nothing_is_seen_they_lie_anywhere(density: float) -> None:
    position = draw(Block(density))[:, :3, 3]
    assert position.isfinite().all()
    assert (position.amax(dim=0) - position.amin(dim=0) > torch.tensor([0.45, 0.45, 0.18])).all()


def test_a_seed_s_candidates_are_the_same() -> None:
    torch.testing.assert_close(draw(Block()), draw(Block()), rtol=0, atol=0)
    assert not torch.equal(draw(Block()), draw(Block(), seed=1))
