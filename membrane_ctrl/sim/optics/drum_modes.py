"""Vibrations of the simulated film: drum modes."""

import math
from dataclasses import dataclass

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
        """Displacement, RMS over the mirror, at a time, or at each of an array of any shape."""
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

        # RMS of J_m(z r) cos(m theta) over the unit disc.
        zero = special.jn_zeros(m, self.circles)[-1]
        rms = abs(special.jv(m + 1, zero))
        if m:
            rms *= math.sqrt(0.5)

        # The film's own polynomial, with room for the mode's powers.
        size = 2 * _SERIES + m + 1
        poly_mm = np.zeros((size, size))
        poly_mm[: terms.poly_mm.shape[0], : terms.poly_mm.shape[1]] = terms.poly_mm
        for k in range(_SERIES + 1):
            factorials = math.factorial(k) * math.factorial(k + m)
            part_mm = 1e-3 / rms * (-1) ** k * (zero / 2) ** (2 * k + m) / factorials
            # Binomial theorem for (x^2 + y^2)^k and Re (x + i y)^m.
            for p, q in np.ndindex(k + 1, m // 2 + 1):
                power_x = 2 * (k - p + m // 2 - q) + m % 2
                power_y = 2 * (p + q)
                binomials = math.comb(k, p) * math.comb(m, 2 * q) * (-1) ** q
                poly_mm[power_x, power_y] += part_mm * binomials
        return terms._replace(poly_mm=poly_mm)


def drum_modes(amplitude_nm: float) -> tuple[DrumMode, ...]:
    """The vibrations of the simulated film, each with this amplitude; none if it is 0."""
    if not amplitude_nm:
        return ()
    return (
        DrumMode(27.0, 0, 1, amplitude_nm),
        DrumMode(48.0, 1, 1, amplitude_nm),
        DrumMode(57.0, 2, 1, amplitude_nm),
        DrumMode(61.0, 0, 2, amplitude_nm),
    )
