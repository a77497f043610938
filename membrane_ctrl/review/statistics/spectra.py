"""Statistics of a series with gaps: means over windows, power spectral density, RMS in its bands,
Allan deviation.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from scipy import signal

from membrane_ctrl.model.arrays import AnyArray, BoolArray, Column, IntArray, Singles
from membrane_ctrl.run_files.run_statistics import least_ticks

# A month has millions: single precision, which counts ticks exactly.
Seconds = AnyArray
Counts = Singles
SecondsOf = tuple[Seconds, Counts, Column]


@dataclass(frozen=True, slots=True)
class WindowStatistics:
    """Statistics of means over windows of one length; NaN without windows; a single window has no
    `std_um`.
    """

    window_s: float  # 0: single ticks
    count: int
    mean_um: float
    std_um: float
    max_um: float
    p99_7_um: float
    in_band: float  # share within the band


def group_starts(number: AnyArray) -> IntArray:
    """Starts of the runs of equal numbers."""
    return np.flatnonzero(np.concatenate(([True], number[1:] != number[:-1])))


class SecondSums:
    """Sums over whole seconds of the run, of several series at once,
    from blocks in order of time.
    """

    def __init__(self, series: int) -> None:
        self._parts: list[SecondsOf] = []
        self._series = series

    def add(self, time_s: Column, values: Column) -> None:
        """Take in (n,) times and (series, n) values, all finite or NaN together."""
        if not time_s.size:
            return
        second = np.floor(time_s + 1e-9).astype(np.int32)
        starts = group_starts(second)
        counts = np.diff(np.append(starts, time_s.size)).astype(np.float32)
        self._parts.append((second[starts], counts, np.add.reduceat(values, starts, axis=1)))

    def result(self) -> SecondsOf:
        """(k,) seconds with ticks, (k,) numbers of ticks, (series, k) sums."""
        if not self._parts:
            return (
                np.empty(0, dtype=np.int32),
                np.empty(0, dtype=np.float32),
                np.empty((self._series, 0)),
            )
        second, counts, sums = (
            np.concatenate(parts, axis=-1) for parts in zip(*self._parts, strict=True)
        )
        starts = group_starts(second)  # two blocks may share a second
        return (
            second[starts],
            np.add.reduceat(counts, starts),
            np.add.reduceat(sums, starts, axis=1),
        )


def window_means(
    second: Seconds, counts: Counts, sums: Column, window_s: int, rate_hz: float
) -> tuple[Column, Column]:
    """Middles (k,) in s and means of the windows with at least `least_ticks`, from (n,) sums of
    `SecondSums`.
    """
    if not second.size:
        return np.empty(0), np.empty(0)
    number = second // window_s
    starts = group_starts(number)
    ticks, total = np.add.reduceat(counts, starts), np.add.reduceat(sums, starts)
    whole = (ticks >= least_ticks(window_s, rate_hz)) & np.isfinite(total)
    return np.asarray((number[starts][whole] + 0.5) * window_s, dtype=np.float64), total[
        whole
    ] / ticks[whole]


def describe(means_um: Column, window_s: float, band_um: float) -> WindowStatistics:
    """Statistics of the means of windows."""
    if not means_um.size:
        return WindowStatistics(window_s, 0, math.nan, math.nan, math.nan, math.nan, math.nan)
    size_um = np.abs(means_um)
    return WindowStatistics(
        window_s,
        int(means_um.size),
        float(means_um.mean()),
        float(means_um.std()) if means_um.size > 1 else math.nan,
        float(size_um.max()),
        float(np.quantile(size_um, 0.997)),
        float((size_um <= band_um).mean()),
    )


_LONGEST_S = 2.0  # between two ticks; a longer gap is a loss


class HeldTime:
    """Sum of the tick intervals that start in a hold, over consecutive blocks."""

    def __init__(self) -> None:
        self._last = (math.nan, False)
        self.held_s = 0.0

    def add(self, time_s: Column, held: BoolArray) -> None:
        """Take in (n,) times and whether the mirror was held."""
        if not time_s.size:
            return
        lasted_s = np.diff(np.concatenate(([self._last[0]], time_s)))
        first = np.concatenate(([self._last[1]], held[:-1]))
        self.held_s += float(lasted_s[first & (lasted_s <= _LONGEST_S)].clip(0.0).sum())
        self._last = float(time_s[-1]), bool(held[-1])

    def result_s(self, period_s: float) -> float:
        """Seconds held; the last tick lasts for one more period."""
        return self.held_s + (period_s if self._last[1] else 0.0)


class WithoutFeedforward:
    """Adds to the error what the feed-forward's flow prevented, from consecutive blocks.

    The mirror's centre nearly integrates the flow. A speed v without feed-forward reaches the error
    through the closed loop of a PI controller,

        e / v = s / (s^2 + Kp s + Kp / Ti),

    here by the bilinear transform. Dead time and pump lag (0.26 s together) are ignored: they
    hardly change the effect of a disturbance of tens of seconds, and make the benefit appear
    slightly too small.
    """

    def __init__(self, kp_per_s: float, ti_s: float, period_s: float) -> None:
        loop = [1.0, kp_per_s, kp_per_s / ti_s]
        self._numerator, self._denominator = signal.bilinear([1.0, 0.0], loop, 1 / period_s)
        self._state = np.zeros(2)

    def kept_away_um(self, feedforward_um_per_s: Column) -> Column:
        """(n,) µm by which the error would have been larger; gaps count as zero flow."""
        flow = np.nan_to_num(np.asarray(feedforward_um_per_s, dtype=np.float64))
        kept, self._state = signal.lfilter(self._numerator, self._denominator, flow, zi=self._state)
        return np.asarray(kept, dtype=np.float64)


# Enough segments for an estimate good to a third, and segments only long enough for one more
# decade.
_SEGMENTS = 8
_LONGEST = 1 << 15
# Segments transformed at once, to bound the memory.
_BATCH = 32


@dataclass(frozen=True, slots=True)
class Spectrum:
    """One-sided density."""

    frequency_hz: Column  # (k,)
    density: Column  # (k,): unit squared per Hz
    segments: int  # number averaged; 0: nothing was long enough

    def band_rms(self, low_hz: float, high_hz: float) -> float:
        """RMS between two frequencies, low one excluded; NaN if no frequency lies there."""
        inside = (self.frequency_hz > low_hz) & (self.frequency_hz <= high_hz)
        if not inside.any():
            return float("nan")
        step_hz = self.frequency_hz[1] - self.frequency_hz[0]
        return float(np.sqrt(self.density[inside].sum() * step_hz))


def power_spectrum(values: AnyArray, rate_hz: float, length: int | None = None) -> Spectrum:
    """Welch's estimate: Hann window, half overlapping segments, each without its mean; as
    `scipy.signal.welch`.

    Parameters
    ----------
    values : (n,) array
        NaN in gaps: segments with gaps are omitted.
    length : int, optional
        Length of a segment; by default an eighth of the series, at most 32768.
    """
    if length is None:
        length = min(_LONGEST, 1 << max(3, int(np.log2(max(values.size, 8) * 2 / (_SEGMENTS + 1)))))
    frequency_hz = np.asarray(np.fft.rfftfreq(length, 1 / rate_hz), dtype=np.float64)
    if values.size < length:
        return Spectrum(frequency_hz, np.full(frequency_hz.size, np.nan), 0)
    pieces = np.lib.stride_tricks.sliding_window_view(values, length)[:: length // 2]
    window = signal.get_window("hann", length)
    power = np.zeros(frequency_hz.size)
    count = 0
    for first in range(0, len(pieces), _BATCH):
        batch = np.asarray(pieces[first : first + _BATCH], dtype=np.float64)
        batch = batch[np.isfinite(batch).all(axis=1)]
        batch = batch - batch.mean(axis=1, keepdims=True)
        power += (np.abs(np.fft.rfft(batch * window)) ** 2).sum(axis=0)
        count += len(batch)
    scale = 1.0 / (rate_hz * (window**2).sum())
    density = power * scale / count if count else np.full(frequency_hz.size, np.nan)
    # add the negative frequencies; 0 and, for an even length, half the rate have none
    density[1 : -1 if length % 2 == 0 else None] *= 2
    return Spectrum(frequency_hz, density, count)


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
    there = np.isfinite(values)
    count = int(there.sum())
    if lengths is None:
        lengths = 2 ** np.arange(max(0, int(np.log2(max(values.size, 4) / 4)) + 1))
    if count < 3:
        return Allan(np.empty(0), np.empty(0), np.empty(0, dtype=np.int64))
    mean = float(values[there].mean(dtype=np.float64))
    total = np.zeros(values.size + 1)
    np.cumsum(np.where(there, values - mean, 0.0), out=total[1:])
    gaps = np.zeros(values.size + 1, dtype=np.int32)
    np.cumsum(~there, out=gaps[1:])
    found = [_second_differences(total, gaps, int(m)) for m in lengths if 2 * m <= values.size]
    tau = np.array([m * period_s for m in lengths if 2 * m <= values.size])
    windows = np.array([pairs for _, pairs in found], dtype=np.int64)
    samples = np.array([m for m in lengths if 2 * m <= values.size], dtype=np.float64)
    squares = np.array([square for square, _ in found])
    kept = windows > 0
    deviation = np.sqrt(squares[kept] / windows[kept] / 2) / samples[kept]
    return Allan(tau[kept], deviation, windows[kept])


@njit(cache=True)
def _second_differences(total: Column, gaps: AnyArray, m: int) -> tuple[float, int]:
    square = 0.0
    count = 0
    for i in range(total.size - 2 * m):
        if gaps[i + 2 * m] == gaps[i]:
            difference = total[i + 2 * m] - 2.0 * total[i + m] + total[i]
            square += difference * difference
            count += 1
    return square, count


# Decades of frequency with an RMS; the last ends at half the tick rate. The first is that of days.
BANDS_HZ = (1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0)
# A Hann window leaks two lines to each side: from the fourth line on, a band contains no slower
# motion.
_RESOLVED_LINES = 4
# Above this, one-second means attenuate the signal (0.1 Hz: by 2 %).
_SLOW_MOST_HZ = 0.1


@dataclass(frozen=True, slots=True)
class Band:
    """RMS between two frequencies."""

    low_hz: float
    high_hz: float
    # Lowest frequency resolved: above `low_hz` if the series is too short for the whole band; NaN
    # if it is too short for any of it
    from_hz: float
    rms_um: float  # NaN if nothing is resolved


def bands(fast: Spectrum, slow: Spectrum) -> list[Band]:
    """RMS in each of `BANDS_HZ`: from the ticks' spectrum where it resolves a band, else from the 1
    s means.
    """
    edges = [*BANDS_HZ, float(fast.frequency_hz[-1])]
    return [
        _band(slow if _is_slow(fast, slow, low, high) else fast, low, high)
        for low, high in pairwise(edges)
    ]


def unseen_s(found: list[Band]) -> float:
    """The period (s) beyond which no band includes the motion; NaN if all bands are empty."""
    return max(
        (1 / band.from_hz for band in found if math.isfinite(band.from_hz)), default=math.nan
    )


def density(fast: Spectrum, slow: Spectrum) -> tuple[Column, Column]:
    """Frequencies (Hz) and one density, which uses the 1 s means below the resolution of the ticks'
    spectrum.
    """
    resolved_hz = min(_RESOLVED_LINES * float(fast.frequency_hz[1]), _SLOW_MOST_HZ)
    below = (
        slow.frequency_hz < resolved_hz
        if slow.segments
        else np.zeros(slow.frequency_hz.size, dtype=bool)
    )
    above = fast.frequency_hz >= (resolved_hz if slow.segments else 0.0)
    joined = [
        (x[below], y[above])
        for x, y in ((slow.frequency_hz, fast.frequency_hz), (slow.density, fast.density))
    ]
    frequency_hz, together = (np.concatenate(parts) for parts in joined)
    return frequency_hz[frequency_hz > 0], together[frequency_hz > 0]


def _is_slow(fast: Spectrum, slow: Spectrum, low_hz: float, high_hz: float) -> bool:
    if not slow.segments or high_hz > _SLOW_MOST_HZ:
        return False
    return not fast.segments or low_hz < _RESOLVED_LINES * float(fast.frequency_hz[1])


def _band(spectrum: Spectrum, low_hz: float, high_hz: float) -> Band:
    first_hz = max(low_hz, float(spectrum.frequency_hz[1]))
    rms_um = spectrum.band_rms(low_hz, high_hz)
    return Band(low_hz, high_hz, first_hz if rms_um == rms_um else math.nan, rms_um)
