"""Overlapping Allan deviation of a series with gaps."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import AnyArray, Column, IntArray
from membrane_ctrl.model.kernel_cache import compile_loop


@dataclass(frozen=True, slots=True)
class Allan:
    """Overlapping Allan deviation."""

    tau_s: Column  # (k,): averaging times
    deviation: Column  # (k,): same unit as the series
    windows: IntArray  # (k,): number of differences of neighbouring means


def allan_deviation(values: AnyArray, period_s: float, lengths: IntArray | None = None) -> Allan:
    """Overlapping Allan deviation of equally spaced values.

    With x the running sum of y and m the samples in tau,

        sigma^2(tau) = < (x[i + 2m] - 2 x[i + m] + x[i])^2 > / (2 m^2)

    (IEEE 1139; Riley, NIST SP 1065, eq. 10 with y for frequency). Triples with gaps are omitted.

    Parameters
    ----------
    values : (n,) array
        NaN in gaps.
    period_s : float
        Time between values.
    lengths : (k,) array of int, optional
        Samples in each tau; by default powers of two up to a quarter of the series, which leaves
        about four independent means.
    """
    finite = np.isfinite(values)
    if int(finite.sum()) < 3:
        return Allan(np.empty(0), np.empty(0), np.empty(0, dtype=np.int64))
    if lengths is None:
        octaves = int(np.log2(max(values.size, 4) / 4))
        lengths = 2 ** np.arange(max(0, octaves + 1))
    samples = np.array([m for m in lengths if 2 * m <= values.size], dtype=np.int64)
    # Running sums of the values without their mean, and of the gaps: a triple of running sums spans
    # no gap if the count of gaps is the same at both ends
    mean = float(values[finite].mean(dtype=np.float64))
    total = np.zeros(values.size + 1)
    np.cumsum(np.where(finite, values - mean, 0.0), out=total[1:])
    gaps = np.zeros(values.size + 1, dtype=np.int32)
    np.cumsum(~finite, out=gaps[1:])
    # The equation above, for each averaging time
    squares = np.zeros(samples.size)
    triples = np.zeros(samples.size, dtype=np.int64)
    for k, m in enumerate(samples):
        squares[k], triples[k] = _second_differences(total, gaps, int(m))
    kept = triples > 0
    deviation = np.sqrt(squares[kept] / triples[kept] / 2) / samples[kept]
    return Allan(np.asarray(samples[kept] * period_s), deviation, triples[kept])


@compile_loop()
def _second_differences(total: Column, gaps: AnyArray, m: int) -> tuple[float, int]:
    """Sum of the squared second differences of running sums m apart, and how many span no gap."""
    square = 0.0
    count = 0
    for i in range(total.size - 2 * m):
        if gaps[i + 2 * m] == gaps[i]:
            difference = total[i + 2 * m] - 2.0 * total[i + m] + total[i]
            square += difference * difference
            count += 1
    return square, count
