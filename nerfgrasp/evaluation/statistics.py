"""Statistics of success rates: intervals, tests of paired outcomes, and bootstraps over clusters.

Attempts in one scene, or on one object, resemble each other: counted as independent they promise too much. The
bootstraps here resample whole clusters (scenes or objects) with all their attempts; the permutation test exchanges
them.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest, bootstrap, norm

CONFIDENCE = 0.95
RESAMPLES = 10_000
_DRAWS_AT_A_TIME = 1_000_000
"""Of clusters: what a bootstrap holds in memory at once."""
_SAME = 1e-9
"""Rates that are nearer to each other are the same but for rounding."""


def wilson_interval(successes: float, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Returns Wilson's score interval of a success rate, 95 % by default.

    Source: Wilson 1927, "Probable inference, the law of succession, and statistical inference". Successes need not be
    whole: a rate of clusters that are all alike counts as so many successes of as many trials as there are clusters.

    Raises:
        ValueError: there are no trials, or not 0 <= successes <= trials.

    Example:
        >>> low, high = wilson_interval(8, 10)
        >>> round(low, 3), round(high, 3)
        (0.49, 0.943)
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes in {trials} trials")
    z2 = float(norm.ppf((1 + confidence) / 2)) ** 2
    middle, reach = successes + z2 / 2, math.sqrt(z2 * (successes * (1 - successes / trials) + z2 / 4))
    return max(0.0, (middle - reach) / (trials + z2)), min(1.0, (middle + reach) / (trials + z2))


def newcombe_interval(
    first: tuple[float, int], second: tuple[float, int], confidence: float = CONFIDENCE
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


def permutation_test(
    first: tuple[ArrayLike, ArrayLike],
    second: tuple[ArrayLike, ArrayLike],
    rng: Generator,
    *,
    resamples: int = RESAMPLES,
) -> float:
    """Returns the two-sided p of a paired permutation test over clusters: could two methods be equally good?

    If they are, then in every cluster it was chance which result is whose. So the two are exchanged in every choice of
    the clusters; p is how often their rates then differ by at least as much as they do. Where there are no more choices
    than `resamples`, all are made and p is exact; else so many are drawn, and the one at hand counts as one more. With
    as many trials by both, exchanging is the same as flipping the sign of a cluster's difference.

    Source: Fisher 1935, "The design of experiments", section 21; for drawn ones Phipson & Smyth 2010, "Permutation
    P-values should never be zero".

    Args:
        first: successes `[N]` and trials `[N]` of each cluster by the first method.
        second: likewise by the second, in the same order.
        rng: what draws; the same state gives the same p.
        resamples: see above.

    Raises:
        ValueError: there is no cluster, or one without trials, or not as many by both.

    Example:
        >>> tens = [10, 10, 10]
        >>> rng = np.random.default_rng(0)
        >>> permutation_test(([8, 7, 3], tens), ([5, 5, 4], tens), rng)  # half of ±3 ±2 ±1 reach 4 or -4
        0.5
    """
    one, other = (np.array(each, dtype=np.float64) for each in (first, second))
    if one.shape != other.shape or one.shape[1] == 0 or min(one[1].min(), other[1].min()) < 1:
        raise ValueError("a cluster without trials, or not the same clusters")
    # Where both did the same, exchanging them changes nothing.
    change = (other - one)[:, (one != other).any(axis=0)]
    clusters = change.shape[1]
    exact = 2.0**clusters <= resamples
    if exact:
        exchanged = np.arange(2**clusters)[:, None] >> np.arange(clusters) & 1
    else:
        exchanged = rng.integers(0, 2, (resamples, clusters))
    moved = (exchanged @ change.T).T
    (won_one, trials_one), (won_other, trials_other) = one.sum(1)[:, None] + moved, other.sum(1)[:, None] - moved
    observed = one[0].sum() / one[1].sum() - other[0].sum() / other[1].sum()
    as_far = np.abs(won_one / trials_one - won_other / trials_other) >= abs(observed) - _SAME
    return float(as_far.mean() if exact else (1 + as_far.sum()) / (1 + resamples))


def rate_interval(
    successes: ArrayLike, trials: ArrayLike, rng: Generator, *, confidence: float = CONFIDENCE
) -> tuple[float, float] | None:
    """Returns the interval of a rate over clusters: the bootstrap's, where there is something to resample.

    Where the clusters' rates are all the same, it would claim certainty: Wilson's then, of as many trials as clusters.
    None for one cluster of a rate other than 0 or 1; arguments and errors as for `bootstrap_rate`.
    """
    won, total = (np.array(each, dtype=np.float64) for each in (successes, trials))
    rate, clusters = float(won.sum() / total.sum()), len(total)
    if _varies(won / total):
        return bootstrap_rate(won, total, rng, confidence=confidence)
    if clusters < 2 and rate not in (0, 1):
        return None
    return wilson_interval(rate * clusters, clusters, confidence)


def difference_interval(
    first: tuple[ArrayLike, ArrayLike],
    second: tuple[ArrayLike, ArrayLike],
    rng: Generator,
    *,
    confidence: float = CONFIDENCE,
) -> tuple[float, float] | None:
    """Returns the interval of the difference of two rates over the same clusters: the paired bootstrap's, if it can be.

    Where the clusters' differences are all the same, it would claim certainty: Newcombe's then, of as many trials as
    clusters. None for one cluster with a rate other than 0 or 1; arguments and errors as for `bootstrap_difference`.
    """
    tables = [np.array(each, dtype=np.float64) for each in (first, second)]
    rates, clusters = [float(won.sum() / trials.sum()) for won, trials in tables], tables[0].shape[1]
    if _varies(tables[0][0] / tables[0][1] - tables[1][0] / tables[1][1]):
        return bootstrap_difference(first, second, rng, confidence=confidence)
    if clusters < 2 and not all(rate in (0, 1) for rate in rates):
        return None
    return newcombe_interval((rates[0] * clusters, clusters), (rates[1] * clusters, clusters), confidence)


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


def _varies(values: NDArray[np.float64]) -> bool:
    return bool(np.ptp(values) > _SAME)


def _rate(successes: NDArray[np.float64], trials: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
    return np.asarray(successes.sum(axis) / trials.sum(axis))


def _difference(*counts: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
    won_first, trials_first, won_second, trials_second = counts
    return _rate(won_first, trials_first, axis) - _rate(won_second, trials_second, axis)
