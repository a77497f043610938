"""The setpoints of a live calibration, and how long the moves between them take."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from membrane_ctrl.config import schema
from membrane_ctrl.control.setpoint_ramp import RAMP_SHARE
from membrane_ctrl.metrology.calibration.verdict import GOOD_SPREAD_UM, LEAST_SPREAD_UM
from membrane_ctrl.model import errors

# Share of the limiting pressure that is used: a pressure gives the sag of a Hencky bowl to 1 %, and
# a sag the pressure to 3 %. A pretensioned film needs less extra pressure than this for more depth.
_PRESSURE_SHARE = 0.95
# Stay at a setpoint: the gas is back at the air's temperature (12 s), and the ramp has no more
# effect.
SETTLE_S = 15.0
# The current cycle ends first, then come 18 frames, their reconstruction and writing.
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
    """Where the mirror may be moved: the safety table's limits less a margin.

    The margin is the largest following error, so that a mirror that lags behind its setpoint trips
    no limit during a move. The pressure of a Hencky bowl grows with the cube of its sag.

    Parameters
    ----------
    held : HeldMirror
        The mirror as it is held now.
    config : Config
        With the limits of the safety table.
    """
    limits = config.limits
    margin_um = limits.following_error_max_um
    low_um = limits.displacement_min_um + margin_um
    high_um = limits.displacement_max_um - margin_um
    high_why = "limits.displacement_max_um"
    if held.pressure_pa > 0:
        pressure_factor = _PRESSURE_SHARE * limits.gauge_pressure_max_pa / held.pressure_pa
        sag_factor = pressure_factor ** (1 / 3)
        pressure_high_um = held.setpoint_um + 1e3 * held.sag_mm * (sag_factor - 1)
        if pressure_high_um < high_um:
            high_um = pressure_high_um
            high_why = "limits.gauge_pressure_max_pa"
    return Reach(math.ceil(low_um), math.floor(high_um), "limits.displacement_min_um", high_why)


def plan_setpoints_um(
    held: HeldMirror, reach: Reach, range_um: float | None, sets: int
) -> tuple[float, ...]:
    """Setpoints of the sets, evenly spaced about where the mirror is held, nearer end first.

    Parameters
    ----------
    held : HeldMirror
        The mirror before any move.
    reach : Reach
        The range is shifted to fit into it.
    range_um : float or None
        From the first to the last; None: 8 mm, or less if limited.
    sets : int
        Number of sets.

    Raises
    ------
    InputError
        If there is no room for the given range, or for 1 mm.
    """
    room_um = reach.high_um - reach.low_um
    allowed = f"{reach.low_why} and {reach.high_why} leave {max(room_um, 0.0):.0f} µm"
    if range_um is not None and range_um > room_um:
        raise errors.InputError(
            f"--range-um {range_um:g}: {allowed}; reduce it, or widen the limits if the film allows"
        )
    if range_um is None:
        wide_um = min(GOOD_SPREAD_UM, room_um)
        cause = allowed
    else:
        wide_um = range_um
        cause = f"--range-um {range_um:g}"
    if wide_um < LEAST_SPREAD_UM:
        raise errors.InputError(
            f"{cause}: sets closer together than {LEAST_SPREAD_UM:.0f} µm add nothing to one set; "
            f"{GOOD_SPREAD_UM:.0f} µm is good"
        )
    # The range is centred on the mirror, then shifted into the reach.
    low_um = min(max(held.setpoint_um - wide_um / 2, reach.low_um), reach.high_um - wide_um)
    ascending = [float(each) for each in np.round(np.linspace(low_um, low_um + wide_um, sets), 1)]
    is_upper_end_nearer = held.setpoint_um - low_um > wide_um / 2
    return tuple(sorted(ascending, reverse=is_upper_end_nearer))


def ramp_s(held: HeldMirror, from_um: float, to_um: float, config: schema.Config) -> float:
    """Duration of the setpoint's ramp, in s.

    Parameters
    ----------
    held : HeldMirror
        The mirror, with its leak.
    from_um, to_um : float
        Setpoints.
    config : Config
        Its pump, and how fast the setpoint may move.

    Returns
    -------
    float
        inf if the mirror does not sink because it has no leak, or does not rise because the pump is
        too weak.
    """
    loop = config.loop
    pump_um_per_s = loop.flow_most_um_per_s(config.pump)
    total_s = 0.0
    for a_um, b_um in pairwise(np.linspace(from_um, to_um, _PIECES + 1).tolist()):
        leak_um_per_s = held.leak_at_um_per_s((a_um + b_um) / 2)
        free_um_per_s = leak_um_per_s  # the mirror sinks by its leak
        if b_um > a_um:
            free_um_per_s = pump_um_per_s - leak_um_per_s
        speed_um_per_s = min(loop.setpoint_ramp_um_per_s, RAMP_SHARE * free_um_per_s)
        if not speed_um_per_s > 0:  # also nan
            return math.inf
        total_s += abs(b_um - a_um) / speed_um_per_s
    return total_s


def move_and_set_s(held: HeldMirror, from_um: float, to_um: float, config: schema.Config) -> float:
    """Return the duration of a move, of settling and of the set, in s.

    Parameters
    ----------
    held : HeldMirror
        The mirror as it is held now.
    from_um, to_um : float
        Setpoints.
    config : Config
        With the ramp of the setpoint.
    """
    return ramp_s(held, from_um, to_um, config) + SETTLE_S + _SET_S
