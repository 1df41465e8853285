import numpy as np
import pytest
from scipy.stats import norm

from nerfgrasp.evaluation.statistics import (
    bootstrap_difference,
    bootstrap_rate,
    difference_interval,
    mcnemar,
    newcombe_interval,
    permutation_test,
    rate_interval,
    wilson_interval,
)


def test_wilson_interval_of_half() -> None:
    # With z = 2, n = 16 and p = 1/2: (1/2 + 1/8 ± 2 sqrt(1/64 + 1/256)) / (1 + 1/4) = (0.625 ± 0.27951) / 1.25.
    low, high = wilson_interval(8, 16, confidence=2 * norm.cdf(2.0) - 1)
    assert low == pytest.approx(0.276393, abs=1e-6)
    assert high == pytest.approx(0.723607, abs=1e-6)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # Newcombe 1998, "Two-sided confidence intervals for the single proportion", table I, method 3.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_interval_of_published_examples(successes: int, trials: int, low: float, high: float) -> None:
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=5.1e-5)


@pytest.mark.parametrize("successes", [0, 7])
def test_wilson_interval_stays_within_a_rate(successes: int) -> None:
    low, high = wilson_interval(successes, 7)
    assert 0.0 <= low < high <= 1.0
    assert (low if successes == 0 else 1.0 - high) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 2), (-1, 2)])
def test_wilson_interval_refuses_impossible_counts(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match="trials"):
        wilson_interval(successes, trials)


@pytest.mark.parametrize(
    ("first", "second", "low", "high"),
    # Newcombe 1998, "Interval estimation for the difference between independent proportions", table II, method 10.
    [((56, 70), (48, 80), 0.0524, 0.3339), ((9, 10), (3, 10), 0.1705, 0.8090), ((10, 10), (0, 10), 0.6075, 1.0)],
)
def test_newcombe_interval_of_published_examples(
    first: tuple[int, int], second: tuple[int, int], low: float, high: float
) -> None:
    assert newcombe_interval(first, second) == pytest.approx((low, high), abs=5.1e-5)
    assert newcombe_interval(second, first) == pytest.approx((-high, -low), abs=5.1e-5)


@pytest.mark.parametrize(
    ("only_first", "only_second", "p"),
    [
        (1, 7, 2 * (1 + 8) / 2**8),  # 0.0703: Fagerland, Lydersen & Laake 2013, "The McNemar test", their example
        (0, 5, 2 / 2**5),
        (3, 3, 1.0),
        (0, 0, 1.0),
    ],
)
def test_mcnemar(only_first: int, only_second: int, p: float) -> None:
    assert mcnemar(only_first, only_second) == pytest.approx(p)
    assert mcnemar(only_second, only_first) == pytest.approx(p)


def test_mcnemar_refuses_negative_counts() -> None:
    with pytest.raises(ValueError, match="-1 and 2"):
        mcnemar(-1, 2)


def test_bootstrap_of_two_clusters_by_hand() -> None:
    # Drawn are two of {0/4, 4/4}: rates 0, 1/2 and 1 with probabilities 1/4, 1/2 and 1/4.
    assert bootstrap_rate([0, 4], [4, 4], np.random.default_rng(0)) == (0.0, 1.0)
    assert bootstrap_rate([0, 4], [4, 4], np.random.default_rng(0), confidence=0.4) == (0.5, 0.5)


def test_bootstrap_weighs_clusters_by_their_trials() -> None:
    # Of two draws from {1/1, 0/3}: 2/2, 1/4 (not the mean of the rates, 1/2) or 0/6.
    assert bootstrap_rate([1, 0], [1, 3], np.random.default_rng(0), confidence=0.4) == (0.25, 0.25)


def test_bootstrap_of_single_attempts_agrees_with_the_normal_approximation() -> None:
    low, high = bootstrap_rate([1] * 120 + [0] * 280, [1] * 400, np.random.default_rng(0))
    reach = 1.96 * np.sqrt(0.3 * 0.7 / 400)
    assert (low, high) == pytest.approx((0.3 - reach, 0.3 + reach), abs=0.004)


def test_bootstraps_are_repeatable() -> None:
    counts = ([3, 1, 5, 2], [5, 6, 5, 7])
    other = ([1, 1, 2, 2], [6, 6, 6, 6])
    assert bootstrap_rate(*counts, np.random.default_rng(3)) == bootstrap_rate(*counts, np.random.default_rng(3))
    first, second = (bootstrap_difference(counts, other, np.random.default_rng(3)) for _ in range(2))
    assert first == second


def test_differences_are_paired() -> None:
    rng = np.random.default_rng(1)
    hardness = rng.integers(0, 10, 40)
    one, other = (hardness, np.full(40, 10)), (np.maximum(hardness - 1, 0), np.full(40, 10))
    low, high = bootstrap_difference(one, other, np.random.default_rng(0))
    # Each rate alone varies by 0.2 from resample to resample; nearly always one more of ten succeeds.
    assert 0.06 < low < high <= 0.1
    swapped = bootstrap_difference(other, one, np.random.default_rng(0))
    assert swapped == pytest.approx((-high, -low))


def test_bootstrap_covers_where_attempts_of_a_scene_resemble_each_other() -> None:
    rng, scenes, attempts, runs = np.random.default_rng(0), 50, 10, 200
    bootstrap, wilson = 0, 0
    for _ in range(runs):
        # Scenes differ widely: their rates are spread as Beta(0.6, 0.4), whose mean is 0.6.
        won = rng.binomial(attempts, rng.beta(0.6, 0.4, scenes))
        low, high = bootstrap_rate(won, np.full(scenes, attempts), rng, resamples=400)
        bootstrap += low <= 0.6 <= high
        low, high = wilson_interval(int(won.sum()), scenes * attempts)
        wilson += low <= 0.6 <= high
    assert 0.91 <= bootstrap / runs <= 0.98
    assert wilson / runs < 0.75  # what counting attempts as independent would have promised


@pytest.mark.parametrize("counts", [([1], [2]), ([], []), ([1, 0], [2, 0])])
def test_bootstrap_refuses_too_little(counts: tuple[list[int], list[int]]) -> None:
    with pytest.raises(ValueError, match="cluster"):
        bootstrap_rate(*counts, np.random.default_rng(0))


def test_differences_need_the_same_clusters() -> None:
    with pytest.raises(ValueError, match="shape"):
        bootstrap_difference(([1, 0], [1, 1]), ([1, 0, 1], [1, 1, 1]), np.random.default_rng(0))


def test_what_does_not_vary_is_not_certain() -> None:
    rng, twenty = np.random.default_rng(0), [1] * 20
    won = [1] * 17 + [0] * 3
    assert bootstrap_difference((won, twenty), (won, twenty), rng) == (0.0, 0.0), "what is not to be believed"
    interval = difference_interval((won, twenty), (won, twenty), rng)
    assert interval == pytest.approx(newcombe_interval((17, 20), (17, 20)))
    # Scenes that all differ, by one of ten each: rates of 4.5 and 3.5 of 10 scenes.
    tens, easy = [10] * 10, np.arange(10)
    assert difference_interval((easy, tens), (easy - 1 + (easy == 0), tens), rng) is not None
    assert difference_interval((easy + 1, tens), (easy, tens), rng) == pytest.approx(
        newcombe_interval((5.5, 10), (4.5, 10))
    )
    assert rate_interval([5] * 8, [10] * 8, rng) == pytest.approx(wilson_interval(4, 8))
    assert rate_interval([1, 2], [2, 3], rng) == bootstrap_rate([1, 2], [2, 3], np.random.default_rng(0))
    assert rate_interval([1], [2], rng) is None
    assert difference_interval(([1], [2]), ([0], [2]), rng) is None
    assert difference_interval(([2], [2]), ([0], [2]), rng) is not None


def test_permutation_test_by_hand() -> None:
    rng, tens = np.random.default_rng(0), [10, 10, 10]
    # Differences 3, 2 and 1: of their eight signs, +++ and --- alone reach 6.
    assert permutation_test(([8, 7, 5], tens), ([5, 5, 4], tens), rng) == 2 / 8
    # 3, 2 and -1: 4 is reached by +++, ++-, and their opposites.
    assert permutation_test(([8, 7, 3], tens), ([5, 5, 4], tens), rng) == 4 / 8
    # Where the two agree, a cluster says nothing of which is better.
    assert permutation_test(([8, 7, 5, 6], [10] * 4), ([5, 5, 4, 6], [10] * 4), rng) == 2 / 8
    assert permutation_test((tens, tens), (tens, tens), rng) == 1.0
    # Unequal trials: (2 + 1) / (2 + 4) less (0 + 1) / (4 + 2) is 1/3. Exchanged in the first: 1/8 - 3/4, as far; in the
    # second: 3/4 - 1/8, as far; in both: -1/3, as far.
    assert permutation_test(([2, 1], [2, 4]), ([0, 1], [4, 2]), rng) == 1.0


def test_permutation_test_of_single_attempts_is_mcnemars() -> None:
    one, other = [1] * 9 + [0] * 4, [1] * 1 + [0] * 11 + [1]
    p = permutation_test((one, [1] * 13), (other, [1] * 13), np.random.default_rng(0))
    assert p == pytest.approx(mcnemar(8, 1))


def test_a_drawn_permutation_test_agrees_with_the_exact_one() -> None:
    rng = np.random.default_rng(2)
    one, other, tens = rng.integers(2, 10, 12), rng.integers(0, 9, 12), np.full(12, 10)
    exact = permutation_test((one, tens), (other, tens), np.random.default_rng(0))
    drawn = permutation_test((one, tens), (other, tens), np.random.default_rng(0), resamples=1000)
    assert drawn != exact
    assert drawn == pytest.approx(exact, abs=4 * np.sqrt(exact / 1000))
    best = permutation_test((np.full(40, 10), np.full(40, 10)), (np.zeros(40), np.full(40, 10)), rng, resamples=99)
    assert best == 1 / 100, "never zero"


@pytest.mark.parametrize("second", [([1], [1]), ([1, 1], [1, 0])])
def test_permutation_test_refuses_what_does_not_pair(second: tuple[list[int], list[int]]) -> None:
    with pytest.raises(ValueError, match="cluster"):
        permutation_test(([1, 1], [1, 1]), second, np.random.default_rng(0))
