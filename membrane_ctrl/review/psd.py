"""Power spectral density of a series with gaps, and the RMS in its bands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

Column = NDArray[np.float64]

# Enough segments for an estimate that is good to a third, and no segment longer than shows one more decade.
_SEGMENTS = 8
_LONGEST = 1 << 15
# Segments transformed at once: what bounds the memory.
_BATCH = 32


@dataclass(frozen=True, slots=True)
class Spectrum:
    """One-sided density.

    Attributes
    ----------
    frequency_hz : (k,) array
    density : (k,) array
        Unit squared per Hz.
    segments : int
        Averaged; 0: nothing was long enough.
    """

    frequency_hz: Column
    density: Column
    segments: int

    def band_rms(self, low_hz: float, high_hz: float) -> float:
        """RMS between two frequencies, low one excluded; NaN if no frequency lies there."""
        inside = (self.frequency_hz > low_hz) & (self.frequency_hz <= high_hz)
        if not inside.any():
            return float("nan")
        step_hz = self.frequency_hz[1] - self.frequency_hz[0]
        return float(np.sqrt(self.density[inside].sum() * step_hz))


def power_spectrum(values: NDArray[np.floating], rate_hz: float, length: int | None = None) -> Spectrum:
    """Welch's estimate: Hann window, half overlapping segments, each without its mean; as `scipy.signal.welch`.

    Parameters
    ----------
    values : (n,) array
        NaN where there is a gap: a segment with one is left out.
    rate_hz : float
    length : int, optional
        Of a segment; by default an eighth of the series, at most 32768.
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
    # the other half of the plane; 0 and, for an even length, half the rate have none
    density[1 : -1 if length % 2 == 0 else None] *= 2
    return Spectrum(frequency_hz, density, count)
