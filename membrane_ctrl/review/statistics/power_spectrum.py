"""Power spectral density of a series with gaps, and its RMS in decades of frequency."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import signal

from membrane_ctrl.model.arrays import AnyArray, Column

# Enough segments for an estimate good to a third, and segments only long enough for one more
# decade.
_SEGMENTS = 8
_LONGEST = 1 << 15
# Segments transformed at once, to bound the memory.
_BATCH = 32
# Decades of frequency with an RMS; the last ends at half the tick rate. The first is that of days.
BANDS_HZ = (1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0)
# A Hann window leaks two lines to each side: from the fourth line on, a band contains no slower
# motion.
_RESOLVED_LINES = 4
# Above this, one-second means attenuate the signal (0.1 Hz: by 2 %).
_SLOW_MOST_HZ = 0.1


@dataclass(frozen=True, slots=True)
class Spectrum:
    """One-sided density."""

    frequency_hz: Column  # (k,)
    density: Column  # (k,): unit squared per Hz
    segments: int  # number averaged; 0: nothing was long enough

    def band_rms(self, low_hz: float, high_hz: float) -> float:
        """Return the RMS between two frequencies.

        Parameters
        ----------
        low_hz : float
            Excluded.
        high_hz : float
            Included.

        Returns
        -------
        float
            NaN if no frequency lies there.
        """
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
    rate_hz : float
        Values a second.
    length : int, optional
        Length of a segment; by default an eighth of the series, at most 32768.
    """
    if length is None:
        # The power of two that leaves about `_SEGMENTS` half overlapping segments
        most = max(values.size, 8) * 2 / (_SEGMENTS + 1)
        power_of_two = max(3, int(np.log2(most)))
        length = min(_LONGEST, 2**power_of_two)
    frequency_hz = np.asarray(np.fft.rfftfreq(length, 1 / rate_hz), dtype=np.float64)
    if values.size < length:
        return Spectrum(frequency_hz, np.full(frequency_hz.size, np.nan), 0)
    # Half overlapping segments, without a copy; those with a gap are left out, and each loses its
    # mean.
    pieces = np.lib.stride_tricks.sliding_window_view(values, length)[:: length // 2]
    window = signal.get_window("hann", length)
    power = np.zeros(frequency_hz.size)
    count = 0
    for first in range(0, len(pieces), _BATCH):
        batch = np.asarray(pieces[first : first + _BATCH], dtype=np.float64)
        whole = np.isfinite(batch).all(axis=1)
        batch = batch[whole]
        batch = batch - batch.mean(axis=1, keepdims=True)
        power += (np.abs(np.fft.rfft(batch * window)) ** 2).sum(axis=0)
        count += len(batch)
    if not count:
        return Spectrum(frequency_hz, np.full(frequency_hz.size, np.nan), 0)
    # Periodograms become a density by the rate and the window's power.
    scale = 1.0 / (rate_hz * (window**2).sum())
    density = power * scale / count
    # Add the negative frequencies; 0 and, for an even length, half the rate have none
    has_negative = np.ones(frequency_hz.size, dtype=bool)
    has_negative[0] = False
    if length % 2 == 0:
        has_negative[-1] = False
    density[has_negative] *= 2
    return Spectrum(frequency_hz, density, count)


@dataclass(frozen=True, slots=True)
class Band:
    """RMS between two frequencies."""

    low_hz: float
    high_hz: float
    # Lowest frequency resolved: above `low_hz` if the series is too short for the whole band; NaN
    # if it is too short for any of it
    from_hz: float
    rms_um: float  # NaN if nothing is resolved


def band_rms(fast: Spectrum, slow: Spectrum) -> list[Band]:
    """Return the RMS in each of `BANDS_HZ`.

    Parameters
    ----------
    fast : Spectrum
        Spectrum of the ticks, used where it resolves a band.
    slow : Spectrum
        Spectrum of the 1 s means, for the others.
    """
    edges_hz = [*BANDS_HZ, float(fast.frequency_hz[-1])]
    bands = []
    for low_hz, high_hz in pairwise(edges_hz):
        spectrum = slow if _is_slow(fast, slow, low_hz, high_hz) else fast
        bands.append(_integrate_band(spectrum, low_hz, high_hz))
    return bands


def unseen_s(found: list[Band]) -> float:
    """The period (s) beyond which no band includes the motion; NaN if all bands are empty."""
    return max(
        (1 / band.from_hz for band in found if math.isfinite(band.from_hz)), default=math.nan
    )


def combine_densities(fast: Spectrum, slow: Spectrum) -> tuple[Column, Column]:
    """Join two spectra: the 1 s means below the resolution of the ticks' spectrum, the ticks above.

    Parameters
    ----------
    fast : Spectrum
        Spectrum of the ticks.
    slow : Spectrum
        Spectrum of the 1 s means.

    Returns
    -------
    frequency_hz, density : (n,) array
        Without frequency 0.
    """
    # Where the ticks' spectrum begins to count: everywhere if there is no slower one
    from_hz = 0.0
    if slow.segments:
        from_hz = min(_RESOLVED_LINES * float(fast.frequency_hz[1]), _SLOW_MOST_HZ)
    below = slow.frequency_hz < from_hz
    above = fast.frequency_hz >= from_hz
    frequency_hz = np.concatenate([slow.frequency_hz[below], fast.frequency_hz[above]])
    density = np.concatenate([slow.density[below], fast.density[above]])
    positive = frequency_hz > 0
    return frequency_hz[positive], density[positive]


def _is_slow(fast: Spectrum, slow: Spectrum, low_hz: float, high_hz: float) -> bool:
    if not slow.segments or high_hz > _SLOW_MOST_HZ:
        return False
    return not fast.segments or low_hz < _RESOLVED_LINES * float(fast.frequency_hz[1])


def _integrate_band(spectrum: Spectrum, low_hz: float, high_hz: float) -> Band:
    first_hz = max(low_hz, float(spectrum.frequency_hz[1]))
    rms_um = spectrum.band_rms(low_hz, high_hz)
    if math.isnan(rms_um):
        first_hz = math.nan
    return Band(low_hz, high_hz, first_hz, rms_um)
