import pytest

from nerfgrasp.training.schedule import LearningRate


def test_the_paper_s() -> None:
    rate = LearningRate()
    assert rate(0) == pytest.approx(1e-4)
    assert rate(4_999) == pytest.approx(0.5)
    assert rate(9_999) == rate(10_000) == rate(449_999) == 1.0
    assert rate(450_000) == rate(499_999) == pytest.approx(0.1)


def test_cosine() -> None:
    rate = LearningRate(warmup_steps=100, decay="cosine", decay_steps=300)
    assert rate(99) == pytest.approx(1.0)
    assert rate(200) == pytest.approx(0.5)
    assert rate(300) == rate(1000) == pytest.approx(0.0)
    assert all(rate(step) > rate(step + 1) for step in range(100, 300))


def test_constant_and_no_warm_up() -> None:
    rate = LearningRate(warmup_steps=0, decay="constant")
    assert [rate(step) for step in (0, 1, 10**6)] == [1.0, 1.0, 1.0]
