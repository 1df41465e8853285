import torch
from torch.nn.functional import normalize

from nerfgrasp.geometry import box_intersection

MINIMUM, MAXIMUM = torch.tensor([-1.0, -2.0, 0.0]), torch.tensor([1.0, 2.0, 3.0])


def intersect(origin: list[float], direction: list[float]) -> tuple[float, float]:
    near, far = box_intersection(torch.tensor(origin), torch.tensor(direction), MINIMUM, MAXIMUM)
    return near.item(), far.item()


def test_along_an_axis_by_hand() -> None:
    assert intersect([-3.0, 0.0, 1.0], [1.0, 0.0, 0.0]) == (2.0, 4.0)
    assert intersect([0.0, 5.0, 1.0], [0.0, -1.0, 0.0]) == (3.0, 7.0)


def test_from_inside_it_starts_at_the_origin() -> None:
    assert intersect([0.0, 0.0, 1.0], [0.0, 0.0, 1.0]) == (0.0, 2.0)


def test_misses() -> None:
    for origin, direction in (
        ([-3.0, 0.0, 1.0], [-1.0, 0.0, 0.0]),  # The box lies behind.
        ([-3.0, 5.0, 1.0], [1.0, 0.0, 0.0]),  # Parallel to a face, beside it.
        ([-3.0, 0.0, 1.0], [0.6, 0.8, 0.0]),  # Past a corner.
    ):
        near, far = intersect(origin, direction)
        assert far <= near


def test_within_a_face() -> None:
    near, far = intersect([-3.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    assert (near, far) == (2.0, 4.0)


def test_ends_lie_on_the_box() -> None:
    generator = torch.Generator().manual_seed(0)
    inside = MINIMUM + torch.rand(500, 3, generator=generator) * (MAXIMUM - MINIMUM)
    origins = 8 * normalize(torch.randn(500, 3, generator=generator), dim=-1)
    directions = normalize(inside - origins, dim=-1)
    near, far = box_intersection(origins, directions, MINIMUM, MAXIMUM)

    distance = (inside - origins).norm(dim=-1)
    assert ((near > 0) & (near <= distance + 1e-4) & (distance <= far + 1e-4)).all()
    for end in (near, far):
        points = origins + end[:, None] * directions
        to_faces = torch.minimum((points - MINIMUM).abs(), (points - MAXIMUM).abs()).amin(dim=-1)
        assert to_faces.max() < 1e-4
        assert ((points > MINIMUM - 1e-4) & (points < MAXIMUM + 1e-4)).all()


def test_hits_agree_with_marching() -> None:
    generator = torch.Generator().manual_seed(1)
    origins = torch.randn(300, 3, generator=generator) * 2
    directions = normalize(torch.randn(300, 3, generator=generator), dim=-1)
    near, far = box_intersection(origins, directions, MINIMUM, MAXIMUM)
    points = origins[:, None] + torch.linspace(0, 20, 2000)[:, None] * directions[:, None]
    marched = ((points > MINIMUM) & (points < MAXIMUM)).all(-1).any(-1)
    # Shorter than a step of the march, a passage through an edge may be missed.
    clear = (far - near).abs() > 0.02
    assert torch.equal((far > near)[clear], marched[clear])
    assert 20 < marched.sum() < 280
