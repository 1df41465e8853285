"""Statistics of success rates: intervals, a test of paired outcomes, and bootstraps over clusters.

Attempts in one scene, or on one object, resemble each other: counted as independent they promise too much. The
bootstraps here resample whole clusters (scenes or objects) with all their attempts.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest, bootstrap

CONFIDENCE = 0.95
RESAMPLES = 10_000
_DRAWS_AT_A_TIME = 1_000_000
"""Of clusters: what a bootstrap holds in memory at once."""


def wilson_interval(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Returns Wilson's score interval of a success rate, 95 % by default.

    Source: Wilson 1927, "Probable inference, the law of succession, and statistical inference".

    Raises:
        ValueError: there are no trials, or not 0 <= successes <= trials.

    Example:
        >>> low, high = wilson_interval(8, 10)
        >>> round(low, 3), round(high, 3)
        (0.49, 0.943)
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes in {trials} trials")
    interval = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def newcombe_interval(
    first: tuple[int, int], second: tuple[int, int], confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Returns Newcombe's interval of the difference of two independent success rates, from Wilson's of each.

    Source: Newcombe 1998, "Interval estimation for the difference between independent proportions", method 10. Over
    the same scenes, where what is hard for one is mostly hard for the other, it is on the wide side.

    Args:
        first: successes and trials of the first.
        second: of the second, whose rate is subtracted.
        confidence: of the interval.

    Raises:
        ValueError: there are no trials, or impossible counts.

    Example:
        >>> low, high = newcombe_interval((56, 70), (48, 80))
        >>> round(low, 4), round(high, 4)
        (0.0524, 0.3339)
    """
    (low_first, high_first), (low_second, high_second) = (
        wilson_interval(*each, confidence) for each in (first, second)
    )
    rate_first, rate_second = first[0] / first[1], second[0] / second[1]
    difference = rate_first - rate_second
    low = difference - math.hypot(rate_first - low_first, high_second - rate_second)
    return low, difference + math.hypot(high_first - rate_first, rate_second - low_second)


def mcnemar(only_first: int, only_second: int) -> float:
    """Returns the two-sided p of the exact McNemar test: could two methods be equally good?

    Both were tried on the same scenes; where they agree, a scene says nothing. The others fall either way with
    probability 1/2 if the methods are equally good.

    Source: McNemar 1947, "Note on the sampling error of the difference between correlated proportions or
    percentages"; in its exact, conditional form.

    Args:
        only_first: scenes in which the first method alone succeeded.
        only_second: scenes in which the second alone did.

    Raises:
        ValueError: a number is negative.

    Example:
        >>> mcnemar(1, 9)
        0.021484375
        >>> mcnemar(0, 0)
        1.0
    """
    if min(only_first, only_second) < 0:
        raise ValueError(f"{only_first} and {only_second} scenes")
    total = only_first + only_second
    return float(binomtest(only_first, total).pvalue) if total else 1.0


def bootstrap_rate(
    successes: ArrayLike,
    trials: ArrayLike,
    rng: Generator,
    *,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> tuple[float, float]:
    """Returns the percentile interval of a rate, sum of `successes` over sum of `trials`, over resampled clusters.

    Source: Efron & Tibshirani 1993, "An introduction to the bootstrap", chapter 13; clusters are what is drawn,
    as in Davison & Hinkley 1997, "Bootstrap methods and their application", section 3.8.

    Args:
        successes: `[N]`, of each cluster. Not necessarily fewer than its trials: any sum of counts will do.
        trials: `[N]`, of each cluster, at least one.
        rng: what draws; the same state gives the same interval.
        resamples: how many times `N` clusters are drawn.
        confidence: of the interval.

    Raises:
        ValueError: there are fewer than two clusters, or one without trials.

    Example:
        >>> low, high = bootstrap_rate([10, 0, 9, 1], [10, 10, 10, 10], np.random.default_rng(0))
        >>> low, high  # forty attempts, but no more than four scenes
        (0.05, 0.95)
    """
    return _percentile_interval(_rate, (successes, trials), rng, resamples, confidence)


def bootstrap_difference(
    first: tuple[ArrayLike, ArrayLike],
    second: tuple[ArrayLike, ArrayLike],
    rng: Generator,
    *,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> tuple[float, float]:
    """Returns the percentile interval of the difference of two rates, first less second, over the same clusters.

    It is paired: every resample takes a cluster's attempts by both methods or by neither, so what makes a scene
    hard for both cancels.

    Args:
        first: successes `[N]` and trials `[N]` of each cluster by the first method.
        second: likewise by the second, in the same order.
        rng: what draws; the same state gives the same interval.
        resamples: how many times `N` clusters are drawn.
        confidence: of the interval.

    Raises:
        ValueError: there are fewer than two clusters, or one without trials, or not as many by both.

    Example:
        >>> easy, hard = ([9, 1, 8, 2], [10, 10, 10, 10]), ([8, 0, 7, 1], [10, 10, 10, 10])
        >>> low, high = bootstrap_difference(easy, hard, np.random.default_rng(0))
        >>> round(low, 6), round(high, 6)  # one more of ten in every scene, however much the scenes differ
        (0.1, 0.1)
    """
    return _percentile_interval(_difference, (*first, *second), rng, resamples, confidence)


def _percentile_interval(
    statistic: Callable[..., NDArray[np.float64]],
    counts: Sequence[ArrayLike],
    rng: Generator,
    resamples: int,
    confidence: float,
) -> tuple[float, float]:
    """Bootstraps a statistic of `counts`, successes and trials in turn, each `[N]`, over the same drawn clusters."""
    table = np.array(counts, dtype=np.float64)
    clusters = table.shape[-1]
    if clusters < 2:
        raise ValueError(f"{clusters} clusters: how much they vary is unknown")
    if (table[1::2] < 1).any():
        raise ValueError("a cluster without trials")
    interval = bootstrap(
        tuple(table),
        statistic,
        paired=True,
        vectorized=True,
        method="percentile",
        n_resamples=resamples,
        batch=max(1, _DRAWS_AT_A_TIME // clusters),
        confidence_level=confidence,
        rng=rng,
    ).confidence_interval
    return float(interval.low), float(interval.high)


def _rate(successes: NDArray[np.float64], trials: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
    return np.asarray(successes.sum(axis) / trials.sum(axis))


def _difference(*counts: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
    won_first, trials_first, won_second, trials_second = counts
    return _rate(won_first, trials_first, axis) - _rate(won_second, trials_second, axis)
