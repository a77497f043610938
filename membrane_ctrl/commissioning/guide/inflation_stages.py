"""Step 4: the first inflation, the leak, the pump's curve, and laser against gauge.

The controller of a hold moves the gas, with every safety rule on. Between two depths it holds the
mirror and a person confirms the next one.
"""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from membrane_ctrl.commissioning.guide import thresholds
from membrane_ctrl.commissioning.guide.good_readings import average_good, select_good
from membrane_ctrl.commissioning.guide.mirror_design import derive_design
from membrane_ctrl.commissioning.guide.stage import (
    StageContext,
    StageFailedError,
)
from membrane_ctrl.commissioning.guide.stage_words import format_duration
from membrane_ctrl.control.pump_curve import PumpCurve
from membrane_ctrl.controller.command import Command
from membrane_ctrl.model import events
from membrane_ctrl.model.telemetry import State, TelemetryRow
from membrane_ctrl.sessions.live_hold import HoldError, HoldLink, News

_WHO = "commission"
_HELD_LEAST_SHARE = 0.99  # of the sag: limits.displacement_min_um while the mirror is filled
_FULL_SHARE = 0.01  # of the sag: the mirror is at its depth
_PRESENT_S = 1.0  # a laser may lose some of its readings
_REPORT_S = 600.0  # between two lines of progress
_DEPTHS_LEAST = 4  # three unknowns
_LAW_PA = 2.0  # least squares: a gauge's error is a share of its reading, but not below this


@dataclass(frozen=True, slots=True)
class DepthPoint:
    """Laser and gauge at a held depth."""

    sag_mm: float
    pressure_pa: float


@contextlib.contextmanager
def without_camera(context: StageContext) -> Iterator[None]:
    """Let holds run without the camera: it is not commissioned yet, or used by the session itself.

    The controller would also compare laser and camera over steps of many millimetres, for which
    the camera's model of the bowl is not meant.
    """
    with context.lend_keys("shape", enabled=False):
        yield


def inflate_in_steps(context: StageContext) -> None:
    """Fill the mirror in steps, and compare laser and gauge."""
    facts = context.facts
    dialogue = context.dialogue
    sag_um = 1e3 * facts.sag_mm
    points: list[DepthPoint] = []
    try:
        with (
            # The depths on the way are below the limit of the finished mirror.
            context.lend_keys("limits", displacement_min_um=-_HELD_LEAST_SHARE * sag_um),
            without_camera(context),
            context.access.start_hold(context.folder, context.config, "inflation") as link,
        ):
            present_um = _find_present_um(link)
            for share in context.plan.inflation_shares:
                setpoint_um = (share - 1.0) * sag_um
                if setpoint_um < present_um - 0.01 * sag_um:
                    continue  # a resumed session: the mirror is deeper already
                request = f"Fill to {share * facts.sag_mm:.1f} mm, {share:.0%} of the depth?"
                if not dialogue.confirm(f"fill_{share:g}", request):
                    raise StageFailedError("not confirmed: the pump is off")
                points.append(hold_depth(context, link, setpoint_um))
    except HoldError as error:
        raise StageFailedError(f"the controller ended the inflation: {error}") from None
    judge_law(context, points)


def _find_present_um(link: HoldLink) -> float:
    """The laser's newest reading. Raises StageFailedError if it has none for some seconds."""
    for row in reversed(collect_rows(link, _PRESENT_S)):
        if np.isfinite(row.displacement_um):
            return row.displacement_um
    raise StageFailedError("the laser shows nothing: it must see the film from flat to full depth")


def hold_depth(context: StageContext, link: HoldLink, setpoint_um: float) -> DepthPoint:
    """Move the held mirror to a depth, hold it there for a while, and measure it.

    Parameters
    ----------
    context : StageContext
        Of the stage.
    link : HoldLink
        Of the hold.
    setpoint_um : float
        The depth, as displacement.
    """
    # The hold may have ended by a fault while a question was open: that is the cause to name, not
    # the refused command.
    read_sound_news(link)
    # Move there.
    link.send_command(Command("setpoint", _WHO, value=setpoint_um))
    if wait_for_row(link).state == State.STANDBY:
        acknowledge_fault(context, link)
        link.send_command(Command("hold", _WHO))
    band_um = context.config.limits.band_um

    def is_there(row: TelemetryRow) -> bool:
        return row.state == State.HOLD and abs(row.displacement_um - setpoint_um) < 3 * band_um

    timeout_s = context.config.states.inflate_timeout_s
    watch_rows(context, link, is_there, timeout_s)
    # Measure it once it is held.
    rows = collect_rows(link, context.plan.settled_s)
    displacement_um = average_good([row.displacement_um for row in rows], "laser")
    sag_mm = context.facts.sag_mm + 1e-3 * displacement_um
    pressure_pa = average_good([row.gauge_pressure_pa for row in rows], "gauge")
    context.dialogue.show(f"  holding {sag_mm:.2f} mm at {pressure_pa:.1f} Pa")
    return DepthPoint(sag_mm, pressure_pa)


def acknowledge_fault(context: StageContext, link: HoldLink) -> None:
    """Let a person clear the fault of an earlier hold, which keeps every later one in standby.

    Parameters
    ----------
    context : StageContext
        Of the stage; its dialogue asks.
    link : HoldLink
        Of the hold in standby, which gets the command `ack`.

    Raises
    ------
    StageFailedError
        The person does not confirm that the cause is removed.
    """
    latched = context.access.find_latched_fault(context.folder)
    if not latched:
        return
    context.dialogue.show(f"  an earlier hold ended by a fault: {latched}")
    if not context.dialogue.confirm("acknowledge", "Is its cause removed, and the film whole?"):
        raise StageFailedError("the fault is not acknowledged: the pump is off")
    link.send_command(Command("ack", _WHO))


def read_sound_news(link: HoldLink) -> News:
    """Read ticks and events of the hold. Raises StageFailedError, with cause and remedy, if there
    is a fault among them.
    """
    news = link.read_news()
    for event in news.events:
        if isinstance(event, events.Fault):
            # The stage's hold ends before a person reads this.
            raise StageFailedError(f"the controller ended it: {event.sentence}; the pump is off")
    return news


def wait_for_row(link: HoldLink) -> TelemetryRow:
    """The newest row. Raises StageFailedError on a fault."""
    while True:
        rows = read_sound_news(link).rows
        if rows:
            return rows[-1]


def watch_rows(
    context: StageContext,
    link: HoldLink,
    is_done: Callable[[TelemetryRow], bool],
    timeout_s: float,
) -> TelemetryRow:
    """Follow the hold until a row is as wanted.

    Parameters
    ----------
    context : StageContext
        Of the stage; shows the progress.
    link : HoldLink
        Of the hold.
    is_done : callable
        Whether a row is as wanted.
    timeout_s : float
        Longest time.

    Returns
    -------
    TelemetryRow
        That row.

    Raises
    ------
    StageFailedError
        A fault, or the time is over.
    """
    began_s = shown_s = None
    while True:
        for row in read_sound_news(link).rows:
            if began_s is None or shown_s is None:
                began_s = shown_s = row.mono_s
            if is_done(row):
                return row
            if row.mono_s - shown_s >= _REPORT_S:
                shown_s = row.mono_s
                context.dialogue.show(
                    f"  {format_duration(row.mono_s - began_s)}: {row.displacement_um:.0f} µm, "
                    f"{row.gauge_pressure_pa:.0f} Pa, pump {row.pump_fraction:.2f}"
                )
            if row.mono_s - began_s > timeout_s:
                raise StageFailedError(f"not reached within {format_duration(timeout_s)}")


def collect_rows(link: HoldLink, duration_s: float) -> list[TelemetryRow]:
    """Collect the rows of the ticks from now on.

    Parameters
    ----------
    link : HoldLink
        Of the hold.
    duration_s : float
        Between the first row and the last one, in the hold's time.

    Raises
    ------
    StageFailedError
        A fault.
    HoldError
        The hold ends.
    """
    rows: list[TelemetryRow] = []
    while not rows or rows[-1].mono_s - rows[0].mono_s < duration_s:
        rows += read_sound_news(link).rows
    return rows


def judge_law(context: StageContext, points: list[DepthPoint]) -> None:
    """Compare laser and gauge by the film's law, p = p0 + a w + c w^3.

    The linear term is the tension that the film has been clamped with; it cannot be negative.

    Parameters
    ----------
    context : StageContext
        Of the stage; records the check.
    points : list of DepthPoint
        Depths with their pressures; four at least.
    """
    if len(points) < _DEPTHS_LEAST:
        context.leave_out(
            "laser against gauge", "the mirror was filled already: fewer than four depths"
        )
        return
    depths_mm = np.array([point.sag_mm for point in points])
    pressures_pa = np.array([point.pressure_pa for point in points])
    # Weighted least squares, linear in p0, a and c. The error of a gauge is a share of its reading,
    # so without weights the largest pressure alone would decide the fit.
    weights = 1.0 / np.maximum(_LAW_PA, 0.02 * pressures_pa)
    matrix = np.stack([np.ones_like(depths_mm), depths_mm, depths_mm**3], axis=1)
    limits = [-np.inf, 0.0, -np.inf], np.inf
    fitted = lsq_linear(matrix * weights[:, None], pressures_pa * weights, bounds=limits).x
    zero_pa, tension, stretch = (float(value) for value in fitted)
    expected_pa = matrix @ fitted
    scatter = np.abs(pressures_pa - expected_pa) / np.maximum(expected_pa, 0.1 * expected_pa[-1])
    context.judge(
        "pressure against depth, difference from the film's law",
        100.0 * float(np.max(scatter)),
        thresholds.FIT_SCATTER,
        "laser or gauge is not linear, or the laser's zero is not where the bowl has its depth",
    )
    # The stiffness that the factor shows, against the stated one.
    design = derive_design(context.facts)
    sag_mm = context.facts.sag_mm
    by_tension_pa = tension * sag_mm
    ratio = (by_tension_pa + stretch * sag_mm**3) / design.pressure_pa
    context.judge(
        "measured over stated stiffness of the film, or the reverse",
        max(ratio, 1.0 / ratio) if ratio > 0 else float("inf"),
        thresholds.STIFFNESS_RATIO,
        "check thickness, modulus, diameter, and the units of laser and gauge",
    )
    context.note("gauge zero by the fit", f"{zero_pa:+.1f} Pa")
    context.note("pressure by the tension of clamping", f"{by_tension_pa:.1f} Pa")
    context.note("pressure at the last depth", f"{pressures_pa[-1]:.1f} Pa")
    # The pressure at the full depth is measured now.
    if abs(points[-1].sag_mm - context.facts.sag_mm) < _FULL_SHARE * context.facts.sag_mm:
        context.set_keys("optics.mirror", pressure_pa=round(float(pressures_pa[-1]), 1))


def measure_leak(context: StageContext) -> None:
    """Hold the mirror, switch the pump off for a minute, and see how fast it sinks."""
    try:
        with (
            without_camera(context),
            context.access.start_hold(context.folder, context.config, "leak") as link,
        ):
            hold_depth(context, link, context.config.loop.setpoint_um)
            held = collect_rows(link, context.plan.settled_s)
            link.send_command(Command("lower", _WHO))
            # Ticks with the pump off.
            rows = [
                row
                for row in collect_rows(link, context.plan.leak_s)
                if row.state in (State.LOWER, State.STANDBY) and row.pump_fraction == 0.0
            ]
    except HoldError as error:
        raise StageFailedError(f"the controller ended it: {error}") from None
    if len(rows) < 10:
        raise StageFailedError("the pump did not stay off")
    # In a minute the depth changes by so little that the leak is constant: the speed is the slope
    # of a straight line.
    select_good([row.displacement_um for row in rows], "laser")
    seen = [row for row in rows if np.isfinite(row.displacement_um)]
    times_s = np.array([row.mono_s for row in seen])
    leak_um_per_s = -float(np.polyfit(times_s, [row.displacement_um for row in seen], 1)[0])
    context.judge(
        "leak at the held depth",
        leak_um_per_s,
        thresholds.LEAK_LEAST,
        "open a bleed (`loop.bleed_fraction`)",
    )
    context.judge(
        "leak over the pump's full flow",
        leak_um_per_s / context.config.pump.flow_full_um_per_s,
        thresholds.LEAK_SHARE,
        "find the leak, or fit a larger pump",
    )
    context.judge(
        "least flow of the running pump over the leak",
        PumpCurve(context.config.pump).least_flow_um_per_s / max(leak_um_per_s, 1e-6),
        thresholds.PUMP_LEAST,
        "fit a smaller pump or a flow controller, or open a bleed (`loop.bleed_fraction`)",
    )
    estimated = float(np.nanmean([row.leak_um_per_s for row in held]))
    context.note("leak as the controller estimates it", f"{estimated:.2f} µm/s")
    # The pressure falls with exp(-t / T), and the depth w goes with its cube root: at the depth w0
    # the centre sinks at w0 / (3 T). With this T the twin leaks as this mirror does.
    time_constant_s = 1e3 * context.facts.sag_mm / (3.0 * max(leak_um_per_s, 1e-6))
    context.set_keys("twin", leak_time_constant_s=float(f"{time_constant_s:.4g}"))
    context.note("time constant of the leak", format_duration(time_constant_s))


def run_tuning_in_hold(context: StageContext, run_name: str, command: str) -> int:
    """Run a command of `tune` on a hold of the bench at its depth.

    Parameters
    ----------
    context : StageContext
        Of the stage.
    run_name : str
        Last part of the run folder's name.
    command : str
        `run` or `pump`.

    Returns
    -------
    int
        The exit code of `tune`, 0 if it is done.

    Raises
    ------
    StageFailedError
        The controller ends the hold.
    """
    try:
        with context.access.start_hold(context.folder, context.config, run_name) as link:
            hold_depth(context, link, context.config.loop.setpoint_um)
            # Release the command: `tune` is a program of its own, and needs it.
            link.close()
            show = context.dialogue.show
            return context.access.run_tuning(context.folder, context.config, command, show)
    except HoldError as error:
        raise StageFailedError(f"the controller ended it: {error}") from None


def map_pump(context: StageContext) -> None:
    """Measure the pump's curve with `tune pump`."""
    context.dialogue.show("  `membrane-ctrl tune pump` measures it; 15 to 35 min at a real bench")
    with without_camera(context):
        code = run_tuning_in_hold(context, "pump", "pump")
    context.require(
        "pump's curve", code == 0, f"exit code {code}", "read the messages above; then try again"
    )
