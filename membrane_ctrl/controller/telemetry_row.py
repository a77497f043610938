"""The telemetry row of a tick, from what the controller and its inputs hold."""

import math
from collections.abc import Mapping

from firmware_iface.roles import NO_READING
from membrane_ctrl.control import inner_loop, shape_loop
from membrane_ctrl.controller import (
    interlocks,
    tick,
    tick_codec,
)
from membrane_ctrl.controller.observation import Observation
from membrane_ctrl.controller.tick_context import TickContext
from membrane_ctrl.model import telemetry


def make_telemetry_row(
    context: TickContext,
    state: telemetry.State,
    fault: int,
    number: int,
    inputs: tick.TickInputs,
    observation: Observation,
    shape: shape_loop.ShapeOutput,
    held: Mapping[str, float],
    climate: Mapping[str, float],
) -> telemetry.TelemetryRow:
    """Return the row of a tick.

    Parameters
    ----------
    context : TickContext
        After the tick.
    state : State
        Of the controller after the tick.
    fault : int
        Code of the standing fault, 0 for none.
    number : int
        Of the tick.
    inputs : TickInputs
        Time, lateness, reading and truth of the tick.
    observation : Observation
        As the safety table has judged it.
    shape : ShapeOutput
        Of the shape loop.
    held : mapping of str to float
        Columns of the held scalar.
    climate : mapping of str to float
        Columns of the predicted change of the figure.
    """
    reading = inputs.reading or NO_READING
    out = context.output or inner_loop.LoopOutput()
    seen = context.estimate.telemetry() if context.estimate else {}
    return telemetry.TelemetryRow(
        mono_s=inputs.now_s,
        tick=number,
        dt_s=context.dt_s,
        lateness_ms=inputs.lateness_ms,
        missed_ticks=inputs.missed_ticks,
        state=state,
        shape_state=shape.state,
        safe_level=context.levels.safe_level,
        fault=fault,
        target_um=context.setpoint_um,
        setpoint_um=out.setpoint_um,
        displacement_um=observation.displacement_um,
        filtered_um=out.filtered_um,
        error_um=out.error_um,
        p_um_per_s=out.p_um_per_s,
        i_um_per_s=out.i_um_per_s,
        d_um_per_s=out.d_um_per_s,
        feedforward_um_per_s=out.feedforward_um_per_s,
        flow_wanted_um_per_s=out.flow_wanted_um_per_s,
        flow_um_per_s=out.flow_um_per_s,
        pump_fraction=context.pump_fraction,
        vent_fraction=context.vent_fraction,
        pump_readback_fraction=reading.pump_fraction,
        vent_readback_fraction=reading.vent_fraction,
        gauge_pressure_pa=observation.gauge_pressure_pa,
        gas_temperature_c=reading.gas_temperature_c,
        # of the laser's readings: rows without one must not pass for such
        displacement_quality=math.nan
        if context.config.by_optics or not inputs.reading
        else reading.displacement_quality,
        sample_counter=reading.sample_counter if inputs.reading else math.nan,
        device_time_s=reading.device_time_s,
        leak_um_per_s=out.leak_um_per_s,
        trim_um=shape.trim_um,
        truth_displacement_um=inputs.truth_displacement_um,
        truth_laser_bias_um=inputs.truth_laser_bias_um,
        interlocks_open=_interlocks_open(context.interlocks),
        **seen,
        **held,
        **climate,
        **{name: getattr(reading, name) for name in tick_codec.AS_READ},
    )


def _interlocks_open(found: interlocks.Interlocks) -> float:
    """The mask for the record; NaN without interlocks, and in a tick without a reading."""
    return float(found.open_mask) if found.any_configured and found.seen else math.nan
