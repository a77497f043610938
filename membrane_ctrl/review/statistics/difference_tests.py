"""Tests whether two series differ in their spread or their mean.

They compare blocks of time, which count as independent: after five minutes the effects of weather
(30 s) and air (300 s) have decayed enough. A short run is cut into eight blocks, which makes its
test a rough one.
"""

import math

import numpy as np
from scipy import special, stats

from membrane_ctrl.model.arrays import Column
from membrane_ctrl.review.statistics.drift import correlation_time, correlation_times
from membrane_ctrl.review.statistics.second_sums import group_starts

_BLOCK_S = 300.0  # length of a block that counts as independent
_LEAST_BLOCKS = 8  # a short run is cut into this many
_LEAST_VALUES = 5  # of a block, for a variance
_LEAST_TESTED = 3  # blocks; fewer have no usable variance


def block_s(a_s: Column, b_s: Column, window_s: float) -> float:
    """Common block length of two series, s: unequal blocks would include different motion.

    Parameters
    ----------
    a_s, b_s : (n,), (m,) arrays
        Times of the two series.
    window_s : float
        Length of the window that a value is the mean of; a block has at least five.
    """
    shorter_s = 0.0
    if a_s.size and b_s.size:
        shorter_s = min(float(np.ptp(a_s)), float(np.ptp(b_s)))
    return max(min(_BLOCK_S, shorter_s / _LEAST_BLOCKS), _LEAST_VALUES * window_s)


def block_statistics(time_s: Column, values: Column, length_s: float) -> tuple[Column, Column]:
    """Mean and log variance of each block.

    Parameters
    ----------
    time_s : (n,) array
        Times, increasing.
    values : (n,) array
        Values then; those that are not finite are left out.
    length_s : float
        Length of a block.

    Returns
    -------
    means : (k,) array
        Of the blocks that are at least half as full as usual.
    log_variances : (m,) array
        Of those that vary; corrected for the bias that the logarithm has with few values.
    """
    finite = np.isfinite(values)
    time_s = time_s[finite]
    values = values[finite]
    if values.size < _LEAST_TESTED or length_s <= 0:
        return np.empty(0), np.empty(0)
    # The block of each value; the last block takes the remainder
    block = np.floor((time_s - time_s[0]) / length_s).astype(np.int64)
    last_block = max(0, int(np.ptp(time_s) / length_s) - 1)
    block = np.minimum(block, last_block)
    count = np.bincount(block)
    mean = np.bincount(block, values) / np.maximum(count, 1)
    freedom = np.maximum(count - 1, 1)
    variance = np.bincount(block, (values - mean[block]) ** 2) / freedom
    # Blocks that are half empty count for nothing
    kept = count >= 0.5 * np.median(count[count > 0])
    varies = kept & (variance > 0)
    # Mean of the logarithm of a chi-square variable over its degrees of freedom
    bias = special.digamma(freedom / 2) - np.log(freedom / 2)
    log_variance = np.log(variance[varies]) - bias[varies]
    return np.asarray(mean[kept], dtype=np.float64), log_variance


def window_means(time_s: Column, values: Column, window_s: float) -> tuple[Column, Column]:
    """Means of longer windows.

    Parameters
    ----------
    time_s, values : (n,) arrays
        One value a second.
    window_s : float
        Length of a window; one with fewer than nine tenths of its seconds is left out.

    Returns
    -------
    middles_s, means : (k,) arrays
    """
    if not time_s.size:
        return time_s, values
    number = np.floor(time_s / window_s).astype(np.int64)
    starts = group_starts(number)
    count = np.diff(np.append(starts, number.size))
    whole = count >= 0.9 * window_s
    middles_s = np.asarray((number[starts][whole] + 0.5) * window_s, dtype=np.float64)
    return middles_s, np.add.reduceat(values, starts)[whole] / count[whole]


def spread_p(a: Column, b: Column, window_s: float = 1.0) -> float:
    """Chance of spreads as different between equal processes.

    Two tests, each of half the level. Within blocks: Welch's test of log variances, which detects
    any difference of the usual motion. Of the whole: the ratio of the variances against F with
    their effective degrees of freedom, the smaller of n / (1 + 2 sum r_k^2) and the number that
    follows from the scatter of the squares; it detects motion slower or rarer than a block.

    Parameters
    ----------
    a, b : (2, n), (2, m) arrays
        Times in s and values of each process.
    window_s : float
        Length of the window that a value is the mean of.

    Returns
    -------
    float
        NaN if both series are too short for either test.
    """
    length_s = block_s(a[0], b[0], window_s)
    _, log_variances_a = block_statistics(a[0], a[1], length_s)
    _, log_variances_b = block_statistics(b[0], b[1], length_s)
    within_blocks = welch_p(log_variances_a, log_variances_b)
    of_the_whole = _variances_p(a[1], b[1])
    found = [p for p in (within_blocks, of_the_whole) if math.isfinite(p)]
    if not found:
        return math.nan
    # Bonferroni: the smaller of two chances, times the number of tests
    return min(1.0, len(found) * min(found))


def _variances_p(a: Column, b: Column) -> float:
    """The test of the whole of `spread_p`."""
    variances = []
    freedoms = []
    for values in (a[np.isfinite(a)], b[np.isfinite(b)]):
        if values.size < _LEAST_BLOCKS:
            return math.nan
        residual = values - values.mean()
        square = float((residual**2).mean())
        if square <= 0:
            return math.nan
        # Independent values a sample: of a Gaussian series (Bartlett 1946), and by the measured
        # scatter of the squares, which rare excursions increase
        _, of_square = correlation_times(residual)
        gaussian = 1 / of_square
        excess = residual**2 - square
        excess_variance = max(float(excess.var()), 1e-300)
        measured = 2 * square**2 / (excess_variance * correlation_time(excess))
        freedoms.append(max(values.size * min(gaussian, measured) - 1, 1.0))
        variances.append(square)
    ratio = variances[0] / variances[1]
    below = stats.f.cdf(ratio, *freedoms)
    above = stats.f.sf(ratio, *freedoms)
    return 2 * float(min(below, above))


def mean_p(a: Column, b: Column, window_s: float = 1.0, offset: float = 0.0) -> float:
    """Probability of means this different between equal series; NaN: too short.

    Parameters
    ----------
    a, b : (2, n), (2, m) arrays
        Times in s and values of both series.
    window_s : float
        Length of a value's window.
    offset : float
        Standard deviation of the difference common to all blocks of a run, in addition to that
        between blocks.
    """
    length_s = block_s(a[0], b[0], window_s)
    return welch_p(
        block_statistics(a[0], a[1], length_s)[0],
        block_statistics(b[0], b[1], length_s)[0],
        offset,
        correlated=True,
    )


def welch_p(a: Column, b: Column, offset: float = 0.0, correlated: bool = False) -> float:
    """Return the probability of means this different between equal sets of blocks: Welch's t test.

    Parameters
    ----------
    a, b : (n,), (m,) arrays
        Values of the blocks.
    offset : float
        Standard deviation of the difference that is common to all blocks of a run.
    correlated : bool
        Blocks that follow each other are correlated, and count for fewer.

    Returns
    -------
    float
        NaN for fewer than three blocks.
    """
    if min(a.size, b.size) < _LEAST_TESTED:
        return math.nan
    # The variance of the difference: of both means and of the offset
    variance = offset**2
    weights = 0.0
    for part in (a, b):
        size = float(part.size)
        if correlated:
            size /= correlation_time(part - part.mean())
        of_mean = float(part.var(ddof=1)) / size
        variance += of_mean
        weights += of_mean**2 / max(size - 1, 1.0)
    if variance <= 0:  # two constant series are equal, or differ for certain
        return float(a.mean() == b.mean())
    # Welch-Satterthwaite
    freedom = variance**2 / weights if weights > 0 else math.inf
    return float(2 * stats.t.sf(abs(a.mean() - b.mean()) / math.sqrt(variance), freedom))
