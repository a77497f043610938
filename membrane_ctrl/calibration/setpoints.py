"""The setpoints of a live calibration, and how long the moves between them take."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from membrane_ctrl.config import schema
from membrane_ctrl.control.setpoint_ramp import RAMP_SHARE
from membrane_ctrl.metrology.calibration.verdict import GOOD_SPREAD_UM, LEAST_SPREAD_UM
from membrane_ctrl.model import errors

# Of the limiting pressure: it gives the sag of a Hencky bowl to a per cent, and a sag gives the
# pressure to three; a pretensioned film needs less extra pressure than this for more depth
_PRESSURE_SHARE = 0.95
# at a setpoint: the gas is back at the air's temperature (12 s), and the ramp has no more effect
SETTLE_S = 15.0
# The current cycle ends first, then 18 frames, their reconstruction and writing
_SET_S = 15.0
_PIECES = 8  # to integrate a move's duration: the leak grows with the cube of the depth


@dataclass(frozen=True, slots=True)
class HeldMirror:
    """The held mirror before any move.

    Attributes
    ----------
    setpoint_um : float
        Setpoint without the trim.
    sag_mm : float
        As the camera sees it with the present geometry.
    pressure_pa : float
        Gauge reading.
    leak_um_per_s : float
        Speed at which the centre sinks without the pump.
    swing_adu : float
        Amplitude of the fringes.
    shape_on : bool
        Whether the shape loop is on.
    """

    setpoint_um: float
    sag_mm: float
    pressure_pa: float
    leak_um_per_s: float
    swing_adu: float
    shape_on: bool

    def sag_at_mm(self, setpoint_um: float) -> float:
        """Sag at another setpoint; the ring does not move."""
        return self.sag_mm + 1e-3 * (setpoint_um - self.setpoint_um)

    def leak_at_um_per_s(self, setpoint_um: float) -> float:
        """Leak at another setpoint: like the pressure,
        it grows with the cube of the sag (Hencky).
        """
        return self.leak_um_per_s * float(self.sag_at_mm(setpoint_um) / self.sag_mm) ** 3


@dataclass(frozen=True, slots=True)
class Reach:
    """Range of the setpoint, and what limits it."""

    low_um: float
    high_um: float
    low_why: str
    high_why: str


def setpoint_reach(held: HeldMirror, config: schema.Config) -> Reach:
    """The safety table's limits less a margin: a lagging mirror must
    not trip them during a move.
    """
    limits, margin_um = config.limits, config.limits.following_error_max_um
    high_um, why = limits.displacement_max_um - margin_um, "limits.displacement_max_um"
    if held.pressure_pa > 0:
        share = _PRESSURE_SHARE * limits.gauge_pressure_max_pa / held.pressure_pa
        by_pressure_um = held.setpoint_um + 1e3 * held.sag_mm * (share ** (1 / 3) - 1)
        if by_pressure_um < high_um:
            high_um, why = by_pressure_um, "limits.gauge_pressure_max_pa"
    low_um = limits.displacement_min_um + margin_um
    return Reach(math.ceil(low_um), math.floor(high_um), "limits.displacement_min_um", why)


def plan_setpoints_um(
    held: HeldMirror, reach: Reach, range_um: float | None, sets: int
) -> tuple[float, ...]:
    """Setpoints of the sets, evenly spaced about where the mirror is held, nearer end first.

    Raises errors.InputError if there is no room for what is asked, or for less than 1 mm.

    Parameters
    ----------
    reach : Reach
        The range is shifted to fit into it.
    range_um : float or None
        From the first to the last; None: 8 mm, or less if limited.
    sets : int
        Number of sets.
    """
    room_um = reach.high_um - reach.low_um
    allowed = f"{reach.low_why} and {reach.high_why} leave {max(room_um, 0.0):.0f} µm"
    if range_um is not None and range_um > room_um:
        raise errors.InputError(
            f"--range-um {range_um:g}: {allowed}; reduce it, or widen the limits if the film allows"
        )
    wide_um = min(GOOD_SPREAD_UM, room_um) if range_um is None else range_um
    if wide_um < LEAST_SPREAD_UM:
        what = allowed if range_um is None else f"--range-um {range_um:g}"
        raise errors.InputError(
            f"{what}: sets closer together than {LEAST_SPREAD_UM:.0f} µm add nothing to one set; "
            f"{GOOD_SPREAD_UM:.0f} µm is good"
        )
    low_um = min(max(held.setpoint_um - wide_um / 2, reach.low_um), reach.high_um - wide_um)
    ascending = [float(each) for each in np.round(np.linspace(low_um, low_um + wide_um, sets), 1)]
    return tuple(sorted(ascending, reverse=held.setpoint_um - low_um > wide_um / 2))


def ramp_s(held: HeldMirror, from_um: float, to_um: float, config: schema.Config) -> float:
    """Duration of the setpoint's ramp; inf if the mirror does not sink,
    or the pump has no reserve.
    """
    loop, most_um_per_s = config.loop, config.loop.flow_most_um_per_s(config.pump)
    total_s = 0.0
    for a_um, b_um in pairwise(np.linspace(from_um, to_um, _PIECES + 1).tolist()):
        leak_um_per_s = held.leak_at_um_per_s((a_um + b_um) / 2)
        free_um_per_s = most_um_per_s - leak_um_per_s if b_um > a_um else leak_um_per_s
        speed_um_per_s = min(loop.setpoint_ramp_um_per_s, RAMP_SHARE * free_um_per_s)
        total_s += abs(b_um - a_um) / speed_um_per_s if speed_um_per_s > 0 else float("inf")
    return total_s


def move_and_set_s(held: HeldMirror, from_um: float, to_um: float, config: schema.Config) -> float:
    """Duration of the move, of settling and of the set."""
    return ramp_s(held, from_um, to_um, config) + SETTLE_S + _SET_S
