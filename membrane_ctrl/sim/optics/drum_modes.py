"""Vibrations of the simulated film: drum modes."""

import math
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.film_terms import FilmTerms

_SERIES = 12  # powers of (r / radius)^2: J_0 and J_2 to 1e-6 beyond their second zeros


@dataclass(frozen=True, slots=True)
class DrumMode:
    """A vibration: J_m(z r / radius) cos(m theta), z the n-th zero of J_m.

    Attributes
    ----------
    frequency_hz : float
    lobes : int
        m.
    circles : int
        n.
    amplitude_nm : float
        Amplitude, RMS over the mirror.
    """

    frequency_hz: float
    lobes: int
    circles: int
    amplitude_nm: float = 1.0

    def swing_um(self, time_s: FloatArray) -> FloatArray:
        """RMS over the mirror at a time, or at each of an array."""
        return np.asarray(
            1e-3 * self.amplitude_nm * np.sin(2 * math.pi * self.frequency_hz * time_s + self.lobes)
        )

    def displace_film(self, film: FilmShape) -> FilmTerms:
        """The film displaced by 1 µm RMS, its ring at rest."""
        from scipy import special

        m, terms, zero = (
            self.lobes,
            film.terms_at(0.0),
            special.jn_zeros(self.lobes, self.circles)[-1],
        )
        rms = abs(special.jv(m + 1, zero)) * (math.sqrt(0.5) if m else 1.0)
        poly_mm = np.zeros((2 * _SERIES + m + 1,) * 2)
        poly_mm[: terms.poly_mm.shape[0], : terms.poly_mm.shape[1]] = terms.poly_mm
        for k in range(_SERIES + 1):
            part_mm = (
                1e-3
                / rms
                * (-1) ** k
                * (zero / 2) ** (2 * k + m)
                / (math.factorial(k) * math.factorial(k + m))
            )
            for p, q in np.ndindex(k + 1, m // 2 + 1):  # (x^2 + y^2)^k Re (x + i y)^m
                poly_mm[2 * (k - p + m // 2 - q) + m % 2, 2 * (p + q)] += (
                    part_mm * math.comb(k, p) * math.comb(m, 2 * q) * (-1) ** q
                )
        return terms._replace(poly_mm=poly_mm)


DRUM_MODES = (
    DrumMode(27.0, 0, 1),
    DrumMode(48.0, 1, 1),
    DrumMode(57.0, 2, 1),
    DrumMode(61.0, 0, 2),
)


def drum_modes(amplitude_nm: float) -> tuple[DrumMode, ...]:
    """The film's vibrations of this amplitude; none of 0."""
    return tuple(replace(mode, amplitude_nm=amplitude_nm) for mode in DRUM_MODES if amplitude_nm)
