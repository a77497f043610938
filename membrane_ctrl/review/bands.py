"""RMS by decades of frequency, from the spectrum that resolves each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.review.psd import Spectrum

Column = NDArray[np.float64]

# Decades of frequency whose RMS is given; the last ends at half the tick rate. The first is that of days.
BANDS_HZ = (1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0)
# A Hann window smears over two lines to each side: from the fourth on a band has nothing of what is slower.
_RESOLVED_LINES = 4
# Above this the mean of a second takes away what is looked for (0.1 Hz: 2 % of its amplitude).
_SLOW_MOST_HZ = 0.1


@dataclass(frozen=True, slots=True)
class Band:
    """RMS between two frequencies.

    Attributes
    ----------
    low_hz, high_hz : float
    from_hz : float
        Lowest frequency that was seen: above `low_hz` when the series is too short for the whole band; NaN when it
        is too short for any of it.
    rms_um : float
        NaN if nothing was seen.
    """

    low_hz: float
    high_hz: float
    from_hz: float
    rms_um: float


def bands(fast: Spectrum, slow: Spectrum) -> list[Band]:
    """RMS in each of `BANDS_HZ`: of the ticks' spectrum where it resolves a band, below of that of the 1 s means."""
    edges = [*BANDS_HZ, float(fast.frequency_hz[-1])]
    return [_band(slow if _is_slow(fast, slow, low, high) else fast, low, high) for low, high in pairwise(edges)]


def unseen_s(found: list[Band]) -> float:
    """The period (s) from which on motion is in none of the bands; NaN when none has anything."""
    return max((1 / band.from_hz for band in found if math.isfinite(band.from_hz)), default=math.nan)


def density(fast: Spectrum, slow: Spectrum) -> tuple[Column, Column]:
    """Frequencies (Hz) and one density: of the 1 s means below what the ticks' spectrum resolves."""
    resolved_hz = min(_RESOLVED_LINES * float(fast.frequency_hz[1]), _SLOW_MOST_HZ)
    below = slow.frequency_hz < resolved_hz if slow.segments else np.zeros(slow.frequency_hz.size, dtype=bool)
    above = fast.frequency_hz >= (resolved_hz if slow.segments else 0.0)
    joined = [(x[below], y[above]) for x, y in ((slow.frequency_hz, fast.frequency_hz), (slow.density, fast.density))]
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
