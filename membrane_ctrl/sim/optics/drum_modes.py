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
        """Displacement, RMS over the mirror, at a time, or at each of an array."""
        phase_rad = 2 * math.pi * self.frequency_hz * time_s + self.lobes
        return np.asarray(1e-3 * self.amplitude_nm * np.sin(phase_rad))

    def displace_film(self, film: FilmShape) -> FilmTerms:
        """The film displaced by 1 µm RMS, its ring at rest.

        J_m is the series of (-1)^k (z / 2)^(2k + m) / (k! (k + m)!) r^(2k + m), k = 0, 1, ... With
        cos(m theta), r^(2k + m) is the polynomial (x^2 + y^2)^k Re (x + i y)^m.
        """
        from scipy import special

        m = self.lobes
        terms = film.terms_at(0.0)
        zero = special.jn_zeros(m, self.circles)[-1]
        # RMS of J_m(z r) cos(m theta) over the unit disc
        rms = abs(special.jv(m + 1, zero)) * (math.sqrt(0.5) if m else 1.0)
        poly_mm = np.zeros((2 * _SERIES + m + 1,) * 2)
        poly_mm[: terms.poly_mm.shape[0], : terms.poly_mm.shape[1]] = terms.poly_mm
        for k in range(_SERIES + 1):
            factorials = math.factorial(k) * math.factorial(k + m)
            part_mm = 1e-3 / rms * (-1) ** k * (zero / 2) ** (2 * k + m) / factorials
            for p, q in np.ndindex(k + 1, m // 2 + 1):  # binomials of both factors
                power_x = 2 * (k - p + m // 2 - q) + m % 2
                power_y = 2 * (p + q)
                binomials = math.comb(k, p) * math.comb(m, 2 * q) * (-1) ** q
                poly_mm[power_x, power_y] += part_mm * binomials
        return terms._replace(poly_mm=poly_mm)


# The modes of the twin's film, with amplitudes of 1 nm.
DRUM_MODES = (
    DrumMode(27.0, 0, 1),
    DrumMode(48.0, 1, 1),
    DrumMode(57.0, 2, 1),
    DrumMode(61.0, 0, 2),
)


def drum_modes(amplitude_nm: float) -> tuple[DrumMode, ...]:
    """The film's vibrations of this amplitude; none of 0."""
    return tuple(replace(mode, amplitude_nm=amplitude_nm) for mode in DRUM_MODES if amplitude_nm)
