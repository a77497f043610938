"""What the sensors' comparison reads of the held mirror in a tick."""

import math
from dataclasses import dataclass

from membrane_ctrl.control import (
    inner_loop,
)
from membrane_ctrl.control.climate import StrainParts
from membrane_ctrl.control.film_monitor import NO_STRAINS
from membrane_ctrl.controller.tick_context import TickContext
from membrane_ctrl.model.shape_estimate import ShapeEstimate


@dataclass(frozen=True, slots=True)
class HoldStatus:
    """State of the held mirror."""

    # NaN for old, bad or stuck readings and jumps: a mean over ten seconds must not include a bit
    # error
    laser_um: float
    gauge_pressure_pa: float
    setpoint_um: float  # as commanded
    trim_um: float  # by the shape loop
    # the rest of the setpoint's ramp. The camera lags by a cycle, and the gauge is linear only near
    # its reference: on a long ramp they would contradict a correct laser
    ramp_left_um: float
    leak_um_per_s: float  # as the inner loop estimates it; NaN without
    flow_um_per_s: float  # of the pump; NaN without
    bleed_fraction: float  # of the vent, held open on purpose
    # they see the centre, and its estimate is held: a laser that moved is known
    held_by_optics: bool = False
    sag_um: float = math.nan  # by the newest figure; NaN without a usable one
    optics_usable: bool = True  # the estimate, or the shape loop, uses the figures
    figure: ShapeEstimate | None = None  # that arrived in this tick and may be used
    strains: StrainParts = NO_STRAINS  # of film and ring, by the climate's sensors


def hold_status(
    context: TickContext,
    last: inner_loop.LoopOutput,
    optics_hold: bool,
    optics_usable: bool,
    strains: StrainParts,
) -> HoldStatus:
    """The mirror after the tick's reading was taken.

    Parameters
    ----------
    context : TickContext
        The controller's state in this tick.
    last : LoopOutput
        What the loop gave in the tick before.
    optics_hold : bool
        The mirror is held by its figure, not by the laser.
    optics_usable : bool
        It could be.
    strains : StrainParts
        Of film and ring.
    """
    return HoldStatus(
        laser_um=context.observer.moving_laser_um,
        gauge_pressure_pa=context.observer.gauge_pressure_pa,
        setpoint_um=context.setpoint_um,
        trim_um=context.trim_um,
        ramp_left_um=context.setpoint_um + context.setpoint_shift_um - last.setpoint_um,
        leak_um_per_s=last.leak_um_per_s,
        flow_um_per_s=last.flow_um_per_s,
        bleed_fraction=context.loop_config.bleed_fraction,
        held_by_optics=optics_hold,
        sag_um=context.observer.figures.sag_um,
        figure=context.observer.figures.accepted,
        optics_usable=optics_usable,
        strains=strains,
    )
