import math
from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from nerfgrasp.geometry import Camera, box_intersection, pixel_rays
from nerfgrasp.models import Rendering, render_image
from nerfgrasp.models.rendering import composite, importance, render_rays, stratified
from nerfgrasp.scenes.scene import Workspace


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_composite_by_hand() -> None:
    # Half of the light stops at the first sample, half of the rest at the second, what is left at the last.
    density = torch.tensor([[[math.log(2) / 0.1, math.log(2) / 0.3, 0.0]]])
    distances = torch.tensor([[[1.0, 1.1, 1.4]]])
    colour = torch.eye(3)[None, None]
    rendering = composite(colour, density, distances)
    weights = torch.tensor([[[0.5, 0.25, 0.25]]])
    torch.testing.assert_close(rendering.weights, weights)
    torch.testing.assert_close(rendering.colour, weights)
    torch.testing.assert_close(rendering.depth, torch.tensor([[0.5 * 1.0 + 0.25 * 1.1 + 0.25 * 1.4]]))


def test_a_wall_hides_what_is_behind_it() -> None:
    rendering = composite(torch.rand(1, 1, 4, 3), torch.tensor([[[0.0, 1e9, 5.0, 5.0]]]), torch.arange(4.0)[None, None])
    torch.testing.assert_close(rendering.weights, torch.tensor([[[0.0, 1.0, 0.0, 0.0]]]))
    assert rendering.depth.item() == 1.0


def test_weights_add_up_and_gradients_are_finite() -> None:
    density = (100 * torch.rand(3, 5, 8)).requires_grad_()
    rendering = composite(torch.rand(3, 5, 8, 3), density, torch.rand(3, 5, 8).sort(dim=-1).values)
    torch.testing.assert_close(rendering.weights.sum(-1), torch.ones(3, 5))
    rendering.colour.sum().backward()
    assert density.grad is not None
    assert density.grad.isfinite().all()


def test_empty_space_shows_the_last_sample() -> None:
    rendering = composite(torch.rand(1, 1, 4, 3), torch.zeros(1, 1, 4), torch.arange(4.0)[None, None])
    assert rendering.depth.item() == 3.0


def test_stratified_without_a_generator_takes_the_middles() -> None:
    found = stratified(torch.tensor([1.0, 0.0]), torch.tensor([2.0, 8.0]), 4)
    assert found.tolist() == [[1.125, 1.375, 1.625, 1.875], [1.0, 3.0, 5.0, 7.0]]


def test_stratified_draws_one_in_each_interval() -> None:
    near, far = torch.rand(50), 1.0 + torch.rand(50)
    found = stratified(near, far, 7, generator())
    intervals = ((found - near[:, None]) / (far - near)[:, None] * 7).floor()
    assert torch.equal(intervals, torch.arange(7.0).expand(50, 7))
    assert torch.equal(found, stratified(near, far, 7, generator()))
    assert not torch.equal(found, stratified(near, far, 7, generator(1)))


def rendered(weights: list[float]) -> Rendering:
    """A coarse rendering of one ray with samples at 0, 1, 2, ..."""
    values = torch.tensor(weights)[None, None]
    return Rendering(torch.zeros(1, 1, 3), torch.zeros(1, 1), values, torch.arange(float(len(weights)))[None, None])


def test_importance_by_hand() -> None:
    # The inner weights 1 : 3 stand for the intervals between the middles 0.5, 1.5, 2.5.
    found = importance(rendered([9.0, 1000.0, 3000.0, 9.0]), 4)
    # Quantiles 1/8, 3/8, 5/8, 7/8 of a density 1/4 on the first and 3/4 on the second interval.
    expected = [1.0, 1.5 + 1 / 6, 1.5 + 3 / 6, 1.5 + 5 / 6]
    torch.testing.assert_close(found[0, 0], torch.tensor(expected), atol=1e-4, rtol=0)


def test_importance_looks_where_the_weights_are() -> None:
    found = importance(rendered([0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0]), 1000, generator())
    assert ((found > 4.5) & (found < 5.5)).float().mean() > 0.98
    assert found.min() >= 0.5
    assert found.max() <= 8.5


@pytest.mark.parametrize("draw", [None, 3])
def test_importance_of_no_weights_spreads_evenly_and_ascends(draw: int | None) -> None:
    found = importance(rendered([0.0] * 10), 40, None if draw is None else generator(draw))[0, 0]
    assert (found.diff() > 0).all()
    assert found[:10].max() < 2.6
    assert found[-10:].min() > 6.4


def test_importance_takes_no_gradient() -> None:
    coarse = rendered([0.1, 0.2, 0.3, 0.1])
    coarse.weights.requires_grad_()
    assert not importance(coarse, 5).requires_grad


def test_rays_meet_the_field_at_their_points() -> None:
    """A half space x > 0.6 of density so high that it is opaque, coloured by where it is met."""

    def field(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        assert directions.shape == (1, 1, 3)
        return points, 1e6 * (points[..., 0] > 0.6).float()

    rays = (torch.tensor([[[0.0, 0.1, 0.2]]]), torch.tensor([[[1.0, 0.0, 0.0]]]))
    found = render_rays(field, *rays, torch.linspace(0, 1, 101)[None, None])
    torch.testing.assert_close(found.colour[0, 0], torch.tensor([0.61, 0.1, 0.2]), atol=0.011, rtol=0)


class Directions:
    """Stands for a network whose colours are the rays' directions."""

    margin = 0.03

    def bounds(self, minimum: Tensor, maximum: Tensor) -> tuple[Tensor, Tensor]:
        return minimum - self.margin, maximum + self.margin

    def render(self, features: object, origins: Tensor, directions: Tensor, box: Workspace) -> SimpleNamespace:
        return SimpleNamespace(fine=SimpleNamespace(colour=directions, depth=directions.sum(-1)))


def test_an_image_is_rendered_pixel_by_pixel(cameras: Callable[..., Camera], workspace: Workspace) -> None:
    one = cameras(1)[0]
    camera = Camera(one.intrinsics, one.T_world_camera, 40, 24)
    rgb, depth, inside = render_image(Directions(), None, camera, workspace, chunk=7)
    assert rgb.shape == (24, 40, 3)
    assert depth.shape == inside.shape == (24, 40)
    assert 0.2 < inside.float().mean() < 1.0
    for y, x in ((3, 16), (20, 20), (12, 0)):
        origins, directions = pixel_rays(camera, torch.tensor([[x + 0.5, y + 0.5]]))
        near, far = box_intersection(origins, directions, workspace.minimum - 0.03, workspace.maximum + 0.03)
        assert inside[y, x] == (far > near)[0]
        torch.testing.assert_close(rgb[y, x], directions[0] * inside[y, x])
    assert (rgb[~inside] == 0).all()
    assert (depth[~inside] == 0).all()
