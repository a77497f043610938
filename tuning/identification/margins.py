"""Stability margins of a loop, from its exact frequency response."""

from __future__ import annotations

import math
from dataclasses import dataclass

import control
import numpy as np

from membrane_ctrl.model.arrays import ComplexArray
from tuning.identification.closed_loop import Gains, compute_loop_response, make_frequencies
from tuning.identification.plant_model import PlantModel

_POINTS = 3000  # 0.3 % apart: margins to better than 1 %
_FINE_DT_S = 1e-3  # shortest delay that the range of frequencies follows
_SLOWEST_RAD_PER_S = 1e-4


@dataclass(frozen=True, slots=True)
class Margins:
    """Margins of a loop.

    Attributes
    ----------
    ms : float
        Largest sensitivity, max |1 / (1 + L)|.
    gain_margin : float
        Factor on the gain at which the loop oscillates.
    phase_margin_deg : float
        Additional phase at which the loop oscillates.
    delay_margin_s : float
        Additional dead time at which the loop oscillates.
    disk_margin : float
        Balanced disk margin, 2 / max |S - T|: gain and phase may change together within that disk.
    stable : bool
        By Nyquist's criterion; if false, the other figures mean nothing.
    """

    ms: float
    gain_margin: float
    phase_margin_deg: float
    delay_margin_s: float
    disk_margin: float
    stable: bool


def compute_margins(gains: Gains, model: PlantModel, dt_s: float) -> Margins:
    """Return the margins of a sampled loop.

    L has two poles at the origin (mirror and integrator) and none to the right, so that the loop is
    stable if and only if the phase at every gain crossing is above -180 deg. Stability is read from
    the number of turns of 1 + L about 0, which also covers loops with several crossings.

    Parameters
    ----------
    gains : Gains
        Of the PID and its filter.
    model : PlantModel
        The plant.
    dt_s : float
        Period of a tick.
    """
    # Up to Nyquist's frequency, or to 20 over the delay.
    fastest_rad_per_s = max(np.pi / dt_s, 20 / max(model.delay_s, _FINE_DT_S))
    w = np.geomspace(_SLOWEST_RAD_PER_S, fastest_rad_per_s, _POINTS)
    response = compute_loop_response(gains, model, w, dt_s)
    sensitivity = 1 / (1 + response)
    frd = control.FrequencyResponseData(response, w, smooth=True)
    gain_margin, phase_margin_deg, _, _, crossing, _ = control.stability_margins(frd)

    # A delay turns the crossing frequency by w delay.
    delay_margin_s = math.inf
    if crossing > 0:
        delay_margin_s = math.radians(float(phase_margin_deg)) / float(crossing)
    return Margins(
        ms=float(np.max(np.abs(sensitivity))),
        gain_margin=float(gain_margin),
        phase_margin_deg=float(phase_margin_deg),
        delay_margin_s=delay_margin_s,
        disk_margin=float(1 / np.max(np.abs(sensitivity - 0.5))),
        stable=is_stable(response),
    )


def is_stable(response: ComplexArray) -> bool:
    """Judge a loop by Nyquist's criterion.

    From the double pole at the origin 1 + L starts at -180 deg (just above it if stable) and must
    end at 0.

    Parameters
    ----------
    response : (n,) complex array
        L at rising frequencies, close enough that 1 + L turns by less than 180 deg between two.
    """
    # Sum the turns from one frequency to the next: the angle itself would jump at +-180 degrees.
    one_plus_l = 1 + response
    turns_rad = np.angle(one_plus_l[1:] / one_plus_l[:-1])
    start_rad = float(np.angle(one_plus_l[0])) % (-2 * math.pi)
    end_rad = start_rad + float(np.sum(turns_rad))
    return abs(end_rad) < math.pi / 2


def find_sensitivity_peak(gains: Gains, model: PlantModel, dt_s: float) -> float:
    """Return the peak Ms of the sensitivity on a coarse grid (to 1 %), for searches.

    Parameters
    ----------
    gains : Gains
        Of the PID and its filter.
    model : PlantModel
        The plant.
    dt_s : float
        Period of a tick.

    Returns
    -------
    float
        Infinite for an unstable loop.
    """
    response = compute_loop_response(gains, model, make_frequencies(dt_s), dt_s)
    if not is_stable(response):
        return math.inf
    return float(np.max(1 / np.abs(1 + response)))
