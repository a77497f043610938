"""Measures the pump's curve, applies it on trial, checks it with steps of the flow."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config import schema
from membrane_ctrl.control.experiments import operating_point
from membrane_ctrl.control.experiments.spec import PumpStep
from membrane_ctrl.control.pump_curve import PumpCurve
from membrane_ctrl.model import errors, telemetry
from membrane_ctrl.sessions import folder, session_json
from tuning.gains_file import MS_MAX
from tuning.identification import (
    closed_loop,
    experiments,
    fit_quality,
    plant_fit,
    plant_model,
    pump_map,
    pump_run,
    pump_survey,
)
from tuning.identification.margins import compute_margins
from tuning.rigs.hold_rig import HoldRig

_MAP_S = 3600.0
# Between two rounds the mirror returns. A slow loop does not swing even where the actuator takes
# seconds to answer; behind a slow ramp an actuator several times as strong as configured does not
# carry the mirror past the setpoint.
_CAUTIOUS = {"kp_per_s": 0.12, "ti_s": 35.0, "td_s": 0.0, "setpoint_ramp_um_per_s": 0.5}
# K times how late the actuator is; SIMC with that as time constant has 0.5
_SLOW = 0.5
_SLOWER = 0.25
_BACK_S = 6.0
_BACK_WITHIN_UM = 2.5
_BACK_MOST = 30
# Leaks that a curve must reach: with 1.5, neither known well yet, gusts let the mirror sink by 21
# µm
_LIFTS = 2.0
_AT_ONCE_S = 1.5  # a round that begins at its limit is over
_BEFORE_S = 20.0  # whose mean flow about holds the mirror
_DARK_MOST = 3  # experiments in a row that a lost laser ended
_CHECK_BEFORE_S = 40.0
_CHECKS_S = (120.0, 240.0, 480.0)
_CHECK_AFTER_S = 15.0
# of k; the margins tolerate more. Standard errors
_CURVE_OFF = 0.2
_CERTAIN = 4.0


@dataclass(frozen=True, slots=True)
class MappedPump:
    """`pump_map.json`: what was measured and applied, and the pump's configuration before."""

    found: pump_map.PumpMap
    before: schema.PumpConfig
    gain: float  # of the mirror on the curve, from steps of the flow: 1
    gain_sigma: float


def has_pump_map(session: folder.SessionFolder) -> bool:
    """Whether the session is based on a curve that it has measured."""
    return session.file_path("pump_map.json").exists()


def load_pump_map(session: folder.SessionFolder) -> MappedPump:
    """Result of the pump map."""
    return session_json.read_session_file(session.file_path("pump_map.json"), MappedPump)


def map_pump(
    session: folder.SessionFolder, rig: HoldRig, limit_um: float = 10.0
) -> tuple[MappedPump, folder.SessionFolder]:
    """Measure the pump's curve, apply it on trial, check it with steps of the flow, and keep it.

    The session restarts on it. The gains stay if they suit the measured actuator; else they
    become slower ones that do.

    Parameters
    ----------
    session : SessionFolder
        The session.
    rig : HoldRig
        Holds the mirror.
    limit_um : float
        How far the mirror may move from the setpoint.

    Returns
    -------
    (MappedPump, SessionFolder)
        The curve, and the session as it continues with it.

    Raises
    ------
    RejectedError
        There is no curve, or steps of the flow contradict it; with what to do. The former curve
        and gains are then restored.
    """
    before = rig.pump
    try:
        # The curve from a survey of flows, then gains that suit it, both on trial.
        _calm_hold(rig, limit_um)
        found = _survey_pump(rig, limit_um)
        watched = before.model_dump(include={"probe_um", "change_max"})
        found = replace(found, pump=found.pump.model_copy(update=watched))
        loop = _make_safe_gains(_free_flow_limit(rig.good[0], before, found.pump), found)
        rig.set_gains(loop, "the measured curve of the pump", _MAP_S, pump=found.pump)
        # Steps of the flow must move the mirror as the curve predicts.
        gain, sigma = _measure_gain(rig, found.delay_s + found.lag_s)
    except (experiments.ExperimentError, ValueError) as error:
        rig.restore_good_gains()
        raise errors.RejectedError(f"pump map: {error}") from None
    rig.keep_gains()
    rig.good = loop, found.pump
    session = folder.restart_session(session, loop, found.pump)
    done = MappedPump(found, before, gain, sigma)
    session_json.write_session_file(session.file_path("pump_map.json"), done)
    return done, session


def _calm_hold(rig: HoldRig, limit_um: float) -> None:
    """Cautious gains from the mean flow, with which an experiment gives the mirror back.

    Without a bump they would begin at the flow of a moment: of a loop that swings on an actuator
    that takes seconds, up to twice the leak, and they are too slow to take that back before the
    mirror is 20 µm high.
    """
    around = rig.around(rig.hold(_BEFORE_S), limit_um)
    rig.set_gains(rig.loop.model_copy(update=_CAUTIOUS), "pump map", _MAP_S)
    mean = PumpStep(
        fraction=PumpCurve(rig.pump).fraction(around.holding_flow_um_per_s), duration_s=0.1
    )
    rig.perform_ticks(
        experiments.make_spec("pump_map", around, 600.0).model_copy(update={"steps": (mean,)})
    )


def _survey_pump(rig: HoldRig, limit_um: float) -> pump_map.PumpMap:
    # Round by round: give the commands that the survey wants, add what they have shown, and bring
    # the mirror back before the next round. Each round knows flow and delay better than the one
    # before, and the guard of the experiment works with what is known.
    _brought_back(rig)
    around = rig.around(rig.hold(_BEFORE_S), limit_um)
    holding = PumpCurve(rig.pump).fraction(around.holding_flow_um_per_s)
    survey = pump_survey.PumpSurvey(holding, around.limit_um, around.laser_um)
    held = True
    while held and (steps := survey.steps()):
        # none, on a curve far from the true
        if flow_um_per_s := PumpCurve(rig.pump).flow(survey.holding):
            around = replace(around, holding_flow_um_per_s=flow_um_per_s)
        around = replace(around, late_s=max(around.late_s, survey.fit.delay_s + survey.fit.lag_s))
        spec = experiments.make_spec("pump_map", around, 600.0).model_copy(update={"steps": steps})
        rows, finished = rig.perform_ticks(spec)
        run = make_pump_run(rows, rig.dt_s)
        survey.add_run(run, finished.completed)
        if survey.dark >= _DARK_MOST:
            raise ValueError(finished.reason)
        # As soon as there is a curve that reaches the leak, the mirror is brought back on it, with
        # gains that suit the delay found so far. The configured curve may be far off.
        with contextlib.suppress(ValueError):  # none yet
            found = survey.make_map()
            if _reaches_leak(found):
                loop = _free_flow_limit(*rig.good, found.pump).model_copy(update=_CAUTIOUS)
                rig.set_gains(
                    _slow_gains(loop, found, _SLOWER), "pump map", _MAP_S, pump=found.pump
                )
        # a hold that swings may do; one that stays away ends every round at once
        held = _brought_back(rig) or run.fraction.size * rig.dt_s > _AT_ONCE_S
    return survey.make_map(held)


def _reaches_leak(found: pump_map.PumpMap) -> bool:
    """Whether a curve that is not finished already reaches from below the leak to well above it."""
    curve = PumpCurve(found.pump)
    return curve.least_flow_um_per_s < found.leak_um_per_s < found.pump.flow_full_um_per_s / _LIFTS


def _free_flow_limit(
    loop: schema.LoopConfig, before: schema.PumpConfig, pump: schema.PumpConfig
) -> schema.LoopConfig:
    """The loop with the flow of the measured pump, unless its limit was below the configured full
    flow.
    """
    if loop.flow_max_um_per_s < before.flow_full_um_per_s:
        return loop  # a person has limited it
    # from none to full within two seconds, as `check` demands
    most_um_per_s = min(pump.flow_full_um_per_s, 2.0 * loop.flow_rate_limit_um_per_s2)
    return loop.model_copy(update={"flow_max_um_per_s": most_um_per_s})


def _make_safe_gains(loop: schema.LoopConfig, found: pump_map.PumpMap) -> schema.LoopConfig:
    """The gains, or slower ones (SIMC with the delay as time constant) if they lack margin on this
    actuator.
    """
    model = plant_model.PlantModel(1.0, found.delay_s, found.lag_s, found.leak_um_per_s)
    margins = compute_margins(closed_loop.Gains.from_config(loop), model, 1 / loop.rate_hz)
    if margins.stable and margins.ms <= MS_MAX:
        return loop
    return _slow_gains(loop, found, _SLOW)


def _slow_gains(
    loop: schema.LoopConfig, found: pump_map.PumpMap, share: float
) -> schema.LoopConfig:
    late_s = found.delay_s + found.lag_s + loop.measurement_filter_s + 0.5 / loop.rate_hz
    return loop.model_copy(
        update={"kp_per_s": share / late_s, "ti_s": 4 * late_s / share, "td_s": 0.0}
    )


def _measure_gain(rig: HoldRig, late_s: float) -> tuple[float, float]:
    """The gain of the mirror on the present curve, and its error, from steps of the flow.

    Steps that contradict the curve, or see little in their weather, are repeated for twice as long.
    Raises ValueError if the longest find a gain far from 1, or one that differs above and below the
    holding flow; a gain with a large error contradicts nothing.
    """
    # Each attempt lasts twice as long as the one before. It ends the check if the gain agrees with
    # the curve and is known well enough; otherwise the weather may have been the cause.
    for steps_s in _CHECKS_S:
        _wait_for_return(rig)
        rig.hold(_CHECK_AFTER_S)
        around = replace(rig.around(rig.hold(_CHECK_BEFORE_S)), late_s=late_s)
        operating_point.require_room(around)
        record, _ = rig.perform(experiments.make_spec("steps", around, steps_s))
        found = plant_fit.identify_plant(record.followed_by(rig.hold(_CHECK_AFTER_S)))
        gain, sigma = found.model.gain, found.sigma.gain
        contradicted = bool(fit_quality.find_bent_curve(record, found)) or abs(gain - 1) > max(
            _CURVE_OFF, _CERTAIN * sigma
        )
        if not contradicted and sigma < _CURVE_OFF:
            return gain, sigma
    if not contradicted:
        return gain, sigma
    raise ValueError(
        f"steps of the flow contradict the curve (k = {gain:.2f} +- {sigma:.2f}): the weather was "
        "too strong, or the pump has changed meanwhile; the former curve is back; run `tune pump` "
        "again in steadier weather"
    )


def _brought_back(rig: HoldRig) -> bool:
    """Wait for the mirror's return, as `_wait_for_return` does; if slow gains leave it above in
    strong weather, with those that held the mirror before.

    From above a faster loop only stops the pump; from below it would drive a stuck one.
    """
    if _wait_for_return(rig):
        return True
    rows = rig.ticks(_BACK_S)
    if np.mean(rig.record(rows).filled_displacement_um()) < rows[-1].target_um + rows[-1].trim_um:
        return False
    own = rig.good[0].model_dump(include=set(_CAUTIOUS))
    rig.set_gains(rig.loop.model_copy(update=own), "pump map", _MAP_S)
    return _wait_for_return(rig)


def _wait_for_return(rig: HoldRig) -> bool:
    """Hold until the mirror is back where it is to stand, at the end of its ramp; not if three
    minutes are over.
    """
    for _ in range(_BACK_MOST):
        rows = rig.ticks(_BACK_S)
        off_um = rig.record(rows).filled_displacement_um() - rows[-1].target_um - rows[-1].trim_um
        if max(part.mean() for part in np.array_split(np.abs(off_um), 6)[3:]) < _BACK_WITHIN_UM:
            return True
    return False


def make_pump_run(rows: Sequence[telemetry.TelemetryRow], dt_s: float) -> pump_run.PumpRun:
    """Make the record of an experiment with pump commands from the rows of a hold.

    Parameters
    ----------
    rows : sequence of TelemetryRow
        Ticks before, during and after the experiment; only those in state `tune` count.
    dt_s : float
        Period of a tick.
    """
    # the first still has the loop's command
    tune = [row for row in rows if row.state == telemetry.State.TUNE][1:]
    columns = (
        [getattr(row, name) for row in tune]
        for name in ("pump_fraction", "displacement_um", "ambient_pressure_pa")
    )
    return pump_run.PumpRun(dt_s, *(np.array(column, dtype=float) for column in columns))
