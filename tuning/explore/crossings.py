"""Where a loop's response crosses gain 1 and phase -180 degrees: the places of its margins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import ComplexArray, FloatArray


@dataclass(frozen=True, slots=True)
class Crossing:
    """A place of the response.

    Attributes
    ----------
    hertz : float
        Frequency.
    gain : float
        |L| there.
    phase_deg : float
        Of L there, without jumps.
    """

    hertz: float
    gain: float
    phase_deg: float


def unwrap_phase_deg(open_loop: ComplexArray) -> FloatArray:
    """Phase of a response that begins at -180 degrees, with two integrators, without jumps."""
    phase_deg = np.degrees(np.unwrap(np.angle(open_loop)))
    return np.asarray(phase_deg - 360.0 * (phase_deg[0] > 0))


def find_crossings(
    w_rad_per_s: FloatArray, open_loop: ComplexArray
) -> tuple[Crossing | None, Crossing | None]:
    """Return where |L| = 1 and where the phase is -180 degrees; of several crossings, those with
    the smallest margins. None without a crossing.

    Parameters
    ----------
    w_rad_per_s : (m,)
        Ascending.
    open_loop : (m,)
        L.
    """
    log_hertz = np.log(w_rad_per_s / (2 * np.pi))
    log_gain, phase_deg = np.log(np.abs(open_loop)), unwrap_phase_deg(open_loop)
    at_gain = _interpolate_zeros(log_gain, log_hertz, log_gain, phase_deg)
    # the double integrator lets the phase begin at -180 degrees itself, which is no crossing
    falling = np.diff(phase_deg) < 0
    at_phase = _interpolate_zeros(phase_deg + 180.0, log_hertz, log_gain, phase_deg, falling)
    return (
        min(at_gain, key=lambda each: abs(each.phase_deg + 180.0), default=None),
        min(at_phase, key=lambda each: abs(np.log(each.gain)), default=None),
    )


def _interpolate_zeros(
    values: FloatArray,
    log_hertz: FloatArray,
    log_gain: FloatArray,
    phase_deg: FloatArray,
    where: np.ndarray[tuple[int], np.dtype[np.bool_]] | None = None,
) -> list[Crossing]:
    """The places at which values change their sign, linearly between two frequencies."""
    changes = np.sign(values[:-1]) != np.sign(values[1:])
    if where is not None:
        changes &= where
    found = []
    for place in np.flatnonzero(changes):
        share = values[place] / (values[place] - values[place + 1])
        at = [
            float(each[place] + share * (each[place + 1] - each[place]))
            for each in (log_hertz, log_gain, phase_deg)
        ]
        found.append(Crossing(float(np.exp(at[0])), float(np.exp(at[1])), at[2]))
    return found
