import pytest

from nerfgrasp.evaluation.statistics import wilson_interval


def test_wilson_interval_of_half() -> None:
    # With z = 2, n = 16 and p = 1/2: (1/2 + 1/8 ± 2 sqrt(1/64 + 1/256)) / (1 + 1/4) = (0.625 ± 0.27951) / 1.25.
    low, high = wilson_interval(8, 16, z=2.0)
    assert low == pytest.approx(0.276393, abs=1e-6)
    assert high == pytest.approx(0.723607, abs=1e-6)


@pytest.mark.parametrize("successes", [0, 7])
def test_wilson_interval_stays_within_a_rate(successes: int) -> None:
    low, high = wilson_interval(successes, 7)
    assert 0.0 <= low < high <= 1.0
    assert (low if successes == 0 else 1.0 - high) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 2), (-1, 2)])
def test_wilson_interval_refuses_impossible_counts(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match="trials"):
        wilson_interval(successes, trials)
