"""A mirror that vibrates, simulated at 2 kHz, and a camera whose rate changes every ten seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from membrane_ctrl.metrology.vibrations.mode_search import VibrationMode
from membrane_ctrl.model.zernike_terms import NOLL_INDICES, ZERNIKE_DEGREE, ZERNIKE_TERMS

FloatArray = NDArray[np.float64]
THREE_RATES = (20.0, 18.4, 17.1)
# Noll terms without lobes, on the rim and at the vertex
_ROUND_ORDERS = {n * (n + 1) // 2 + 1: n for n in range(0, ZERNIKE_DEGREE + 1, 2)}
RIM = {j: math.sqrt(n + 1) for j, n in _ROUND_ORDERS.items()}
VERTEX = {j: (-1) ** (n // 2) * math.sqrt(n + 1) for j, n in _ROUND_ORDERS.items()}
# A drum's first vibrations, up to radial order 6
DRUM = {
    27.0: {4: -0.552, 11: 0.059},
    48.0: {2: 0.738, 8: -0.663, 16: 0.126},
    57.0: {6: 0.693, 12: -0.694, 24: 0.204},
    61.0: {4: -0.491, 11: 0.739, 22: -0.276},
}


@dataclass(frozen=True)
class Planted:
    """A mode: frequency and shape of unit RMS."""

    frequency_hz: float
    shape: FloatArray

    def seen_by(self, found: tuple[VibrationMode, ...]) -> list[VibrationMode]:
        return [mode for mode in found if abs(mode.frequency_hz - self.frequency_hz) < 0.1]


def frame_times_s(rates_hz: tuple[float, ...], seconds: float) -> FloatArray:
    """Mid-exposures; the rate changes every ten seconds."""
    out: list[FloatArray] = []
    now = 100.0
    while now < 100.0 + seconds:
        rate_hz = rates_hz[len(out) % len(rates_hz)]
        out.append(now + np.arange(round(10 * rate_hz)) / rate_hz)
        now = out[-1][-1] + 1 / rate_hz
    return np.concatenate(out)


def at_rest(terms: FloatArray) -> FloatArray:
    """A vibration's terms (terms,), unit RMS with the ring at rest."""
    out = terms.copy()
    out[0] = -sum(height * terms[j - 1] for j, height in RIM.items() if j > 1)
    return out / np.linalg.norm(out)


def drum(frequency_hz: float) -> FloatArray:
    """A drum's vibration (terms,)."""
    out = np.zeros(ZERNIKE_TERMS)
    for j, part in DRUM[frequency_hz].items():
        if j in NOLL_INDICES:
            out[j - 1] = part
    return at_rest(out)


def watched(
    seed: int,
    lines_hz: tuple[float, ...] = (27.0, 48.0, 57.0, 61.0),
    rates_hz: tuple[float, ...] = THREE_RATES,
    seconds: float = 60.0,
    noise_nm: float = 12.0,
    quality: float = math.inf,
    amplitude_nm: float = 5.0,
    drums: bool = False,
    drift_nm: float = 1.0,
    jitter_s: float = 0.0,
) -> tuple[FloatArray, FloatArray, list[Planted]]:
    """Times, terms in µm and what was planted, in noise that terms share, on terms that drift; the
    vertex is at 0.

    Frequencies and shapes are drawn, unless they are a drum's. `jitter_s` is that of the times of
    the frames.
    """
    rng = np.random.default_rng(seed)
    t = frame_times_s(rates_hz, seconds)
    t = t + jitter_s * np.random.default_rng((seed, 1)).normal(size=t.size)
    mixed = np.linalg.qr(rng.normal(size=(ZERNIKE_TERMS, ZERNIKE_TERMS)))[0]
    terms_nm = rng.normal(size=(t.size, ZERNIKE_TERMS)) * noise_nm / 6 @ mixed
    terms_nm += drift_nm * np.cumsum(rng.normal(size=(t.size, ZERNIKE_TERMS)), axis=0)
    planted = []
    for line_hz in lines_hz:
        frequency_hz, shape = (
            line_hz + rng.uniform(-0.3, 0.3),
            at_rest(rng.normal(size=ZERNIKE_TERMS)),
        )
        if drums:
            frequency_hz, shape = line_hz, drum(line_hz)
        planted.append(Planted(frequency_hz, shape))
        if math.isinf(quality):
            wave = np.cos(2 * math.pi * frequency_hz * t + rng.uniform(0, 6))
        else:
            step_s = 1 / 2000
            pole = np.exp((2j - 1 / quality) * math.pi * frequency_hz * step_s)
            pushed = rng.normal(size=(round((t[-1] - t[0]) / step_s) + 2, 2)) @ [1, 1j]
            ringing = lfilter([1], [1, -pole], pushed).real
            wave = np.interp(
                t - t[0], np.arange(ringing.size) * step_s, ringing / ringing.std() * math.sqrt(0.5)
            )
        terms_nm += amplitude_nm * np.outer(wave, shape)
    terms_nm[:, 0] = -sum(height * terms_nm[:, j - 1] for j, height in VERTEX.items() if j > 1)
    return t, terms_nm * 1e-3, planted
