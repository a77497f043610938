"""Checks the configuration against itself and against the board's limits, for `check` and `hold`.
Pure.

The range of a field (`config`) catches a wrong unit. This module judges combinations: settings that
let the pump run when it must not, guards that never or always trip, and contradictory numbers.
"""

import difflib
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Any

from pydantic import BaseModel

from firmware_iface.register_map import load_default_map
from firmware_iface.roles import BenchIdentity
from firmware_iface.settings import ModbusInputConfig, VaisalaPtb330Config
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.control import pump_curve
from membrane_ctrl.controller import (
    actuator_test,
    cross_check_bridges,
    cross_check_interlocks,
    cross_check_plant,
    safety,
)
from membrane_ctrl.model.errors import FindingsError

# a day: the cause of a fault that recurs more than once an hour is not temporary
_RESUMES_MOST = 24
# How long the pump may run without control, and how long at an uncorrected flow. At 5 µm/s and at
# the 1.2 µm/s of a doubled leak that is 10 µm and 70 µm, well within the default limits.
_UNATTENDED_S, _BLIND_S = 2.0, 60.0
_PAUSE_S = 3600.0  # the laser still guards the limits, but no loop holds the mirror
_PUMP_STANDS_S = 0.5  # lag and transport
_GAUGE_NOISE_PA = 1.0
_PRESSURE_MISSING = next(rule for rule in safety.TABLE if rule.name == "pressure_missing")
_GUARDED_SINCE = load_default_map().fault_since("gauge_lost")
_UNKNOWN = BenchIdentity("", 0, "", math.nan)
_TWIN_BOARD = DevicesConfig(board="tcp://twin")  # the device of `--twin` if none are named


def cross_check(
    config: Config, board: BenchIdentity | None = None
) -> tuple[cross_check_plant.ConfigFinding, ...]:
    """Return the findings on a configuration, errors first.

    Parameters
    ----------
    config : Config
        Valid in each of its fields.
    board : BenchIdentity, optional
        The devices' limits and ranges, if they are known.
    """
    findings = cross_check_plant.ConfigFindings(config)
    _check_finite(config, findings)
    if not findings.found:  # the others compute with the values
        for judge in (
            _check_resume,
            _check_watchdog,
            _check_stale,
            _check_states,
            _check_limits,
            cross_check_plant.judge_gauge,
            cross_check_plant.judge_film,
            cross_check_plant.judge_alarms,
            cross_check_plant.judge_pump,
            cross_check_plant.judge_vent,
            cross_check_interlocks.judge_interlocks,
            cross_check_plant.judge_loop,
            cross_check_plant.judge_shape,
            cross_check_plant.judge_optics,
            cross_check_bridges.judge_bridges,
        ):
            judge(config, findings)
        for judge_board in (
            cross_check_plant.judge_ranges,
            cross_check_interlocks.judge_interlock_board,
            _check_board,
            _board_guards,
        ):
            judge_board(config, board or _UNKNOWN, findings)
    return tuple(sorted(findings.found, key=lambda finding: finding.severity))


def require_sound(
    config: Config, source: str, board: BenchIdentity | None = None
) -> tuple[cross_check_plant.ConfigFinding, ...]:
    """Refuse a configuration with errors.

    Parameters
    ----------
    config : Config
        Valid in each of its fields.
    source : str
        Name of the file, for the messages.
    board : BenchIdentity, optional
        As of `cross_check`.

    Returns
    -------
    tuple of ConfigFinding
        The warnings.

    Raises
    ------
    FindingsError
        One line for each error.
    """
    findings = cross_check(config, board)
    if any(finding.severity == "error" for finding in findings):
        raise FindingsError([finding.line(source) for finding in findings])
    return findings


def _check_finite(config: Config, findings: cross_check_plant.ConfigFindings) -> None:
    """Refuse NaN, which the file's reader refuses too, but which a program may have set."""
    for field, value in _list_numbers(config, ""):
        findings.error(not math.isfinite(value), field, "is not a number", "set a finite value")


def _list_numbers(value: Any, field: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, BaseModel):
        inner: Iterable[tuple[Any, Any]] = (
            (name, getattr(value, name)) for name in type(value).model_fields
        )
    elif isinstance(value, tuple | list):
        inner = enumerate(value)
    else:
        if isinstance(value, float):
            yield field, value
        return
    for name, part in inner:
        yield from _list_numbers(part, f"{field}.{name}".lstrip("."))


def _check_resume(config: Config, findings: cross_check_plant.ConfigFindings) -> None:
    """Judge which faults may end without a person, how often, and how soon."""
    resume = config.resume
    known = [rule.name for rule in safety.TABLE]
    may = sorted(rule.name for rule in safety.TABLE if rule.may_resume)
    # Each name must be that of a fault that may end without a person.
    for index, name in enumerate(resume.faults):
        field = f"resume.faults.{index}"
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else f"may resume: {', '.join(may)}"
        findings.error(name not in known, field, "no fault has this name", hint)
        why, remedy = (
            "only a person may clear this fault",
            f"remove it; may resume: {', '.join(may)}",
        )
        findings.error(name in known and name not in may, field, why, remedy)
    # How often, and how soon, the hold may resume.
    why = "a fault that recurs this often has a lasting cause"
    findings.error(
        resume.most_per_day > _RESUMES_MOST,
        "resume.most_per_day",
        why,
        f"set at most {_RESUMES_MOST}",
    )
    if resume.faults:
        never, remedy = "nothing would ever resume", "set at least 1, or empty resume.faults"
        findings.warn(resume.most_per_day == 0, "resume.most_per_day", never, remedy)
        waits = resume.wait_s >= config.states.pump_off_max_s
        findings.warn(
            waits,
            "resume.wait_s",
            f"the mirror is vented earlier: {never}",
            "keep it below states.pump_off_max_s",
        )


def _check_watchdog(config: Config, findings: cross_check_plant.ConfigFindings) -> None:
    """Judge the board's watchdog against ticks, lost answers and the limit of lateness."""
    devices, limits = config.devices or _TWIN_BOARD, config.limits
    tick_s, watchdog_s = 1.0 / config.loop.rate_hz, devices.watchdog_s
    # A real bench: how long the pump runs unattended, and whether one lost answer trips the
    # watchdog
    if config.devices is not None:
        why, most = (
            "the pump would run this long without a control process",
            f"set at most {_UNATTENDED_S:g} s",
        )
        findings.error(watchdog_s > _UNATTENDED_S, "devices.watchdog_s", why, most)
        for field, timeout_s in _slowest_answers(devices):
            lost_s = timeout_s + tick_s
            waits = f"one lost answer ({timeout_s:g} s on its line) and a tick of {tick_s:g} s"
            why = f"{waits} take longer than the watchdog ({watchdog_s:g} s)"
            findings.error(
                lost_s >= watchdog_s, field, why, "shorten it, or lengthen devices.watchdog_s"
            )
            ends = lost_s >= limits.stale_s and len(devices.roles()) == 0
            findings.warn(
                ends,
                "limits.stale_s",
                "one lost answer ends the run",
                f"set more than {lost_s:g} s",
            )
    why = (
        f"the watchdog ({watchdog_s:g} s) trips between two ticks of {tick_s:g} s, or at the "
        "first late one"
    )
    remedy = f"set at least {2.0 / watchdog_s:g} Hz, or lengthen devices.watchdog_s"
    findings.error(2.0 * tick_s > watchdog_s, "loop.rate_hz", why, remedy)
    # The limit of lateness must trip before the watchdog, and not on a healthy machine
    late, why = (
        "limits.lateness_max_ms",
        f"can never trip: the watchdog ({watchdog_s:g} s) trips first",
    )
    findings.error(
        1e-3 * limits.lateness_max_ms >= watchdog_s, late, why, "keep it below devices.watchdog_s"
    )
    findings.warn(
        limits.lateness_max_ms < 5.0, late, "a healthy machine can be that late", "set 100 ms"
    )


def _check_stale(config: Config, findings: cross_check_plant.ConfigFindings) -> None:
    """Judge for how long the loop may be without a new reading, or with one that repeats."""
    # Each window: longer than what a sound sensor shows by chance, shorter than what a mirror may
    # be left to without a reading
    limits, tick_s = config.limits, 1.0 / config.loop.rate_hz
    why, least = (
        f"shorter than 1.5 ticks of {tick_s:g} s: every late tick would be a fault",
        f"set at least {1.5 * tick_s:g} s",
    )
    findings.error(limits.stale_s * config.loop.rate_hz < 1.5 - 1e-9, "limits.stale_s", why, least)
    why, most = "the pump would run this long without a reading", f"set at most {_UNATTENDED_S:g} s"
    findings.error(limits.stale_s > _UNATTENDED_S, "limits.stale_s", why, most)
    why, least = "two readings equal by chance would be a fault", f"set at least {3.0 * tick_s:g} s"
    findings.error(limits.stuck_s < 3.0 * tick_s, "limits.stuck_s", why, least)
    why, most = "the loop would follow a stopped laser this long", f"set at most {_BLIND_S:g} s"
    findings.error(limits.stuck_s > _BLIND_S, "limits.stuck_s", why, most)


def _slowest_answers(devices: DevicesConfig) -> Iterator[tuple[str, float]]:
    """Longest wait of a tick for answers: devices on one line take turns,
    lines work in parallel.
    """
    if devices.board is not None:
        yield "devices.timeout_s", devices.timeout_s
        return
    lines: dict[str, list[tuple[str, float]]] = defaultdict(list)
    for role, section in devices.roles().items():
        if not isinstance(section, VaisalaPtb330Config):  # read in the background
            line = str(getattr(section, "link", None) or getattr(section, "port", ""))
            lines[line].append((f"devices.{role}.timeout_s", section.timeout_s))
    # read in the background, but a serial line has one turn
    for index, interlock in enumerate(devices.interlocks):
        if (
            isinstance(interlock, ModbusInputConfig)
            and interlock.link.startswith("rtu:")
            and interlock.link in lines
        ):
            lines[interlock.link].append(
                (f"devices.interlocks.{index}.timeout_s", interlock.timeout_s)
            )
    slowest = max(lines.values(), key=lambda line: sum(timeout_s for _, timeout_s in line))
    yield slowest[0][0], sum(timeout_s for _, timeout_s in slowest)


def _check_states(config: Config, findings: cross_check_plant.ConfigFindings) -> None:
    """Judge the times of the states: long enough to pass, short enough to protect."""
    states, limits = config.states, config.limits
    # How long the flow may be uncontrolled
    for name, most_s in (
        ("hold_flow_max_s", _BLIND_S),
        ("ramp_down_s", _BLIND_S),
        ("pause_max_s", _PAUSE_S),
    ):
        too_long = getattr(states, name) > most_s
        findings.error(
            too_long,
            f"states.{name}",
            "the flow would be uncontrolled this long",
            f"set at most {most_s:g} s",
        )
    # Each state needs at least the time that a sound mirror takes
    needed_s = states.check_s
    if states.actuator_test:
        needed_s = actuator_test.ActuatorTest(config.pump, True, config.loop.rate_hz).longest_s
    why, least = (
        f"too short: the check may take {needed_s:.1f} s",
        f"set at least {1.3 * needed_s:.0f} s",
    )
    findings.error(states.check_timeout_s <= needed_s, "states.check_timeout_s", why, least)
    why = f"too short: states.settle_s is {states.settle_s:g} s"
    findings.error(
        states.settle_timeout_s <= states.settle_s,
        "states.settle_timeout_s",
        why,
        "set some minutes",
    )
    # On the way down: the read-back needs time to show that the pump stands
    seen_s = _PUMP_STANDS_S + 2.0 / config.loop.rate_hz
    why = (
        f"too short: a pump stops {_PUMP_STANDS_S:g} s after its command, and its read-back "
        "shows it a tick later"
    )
    findings.error(states.lower_timeout_s < seen_s, "states.lower_timeout_s", why, "set 3 s")
    # Inflation: the whole way, and two bands of it
    speed_um_per_s = min(
        config.loop.setpoint_ramp_um_per_s, cross_check_plant.flow_um_per_s(config)
    )
    way_s = (config.loop.setpoint_um - limits.displacement_min_um) / speed_um_per_s
    why = f"too short: inflating from limits.displacement_min_um takes at least {way_s:.0f} s"
    findings.warn(states.inflate_timeout_s < way_s, "states.inflate_timeout_s", why, "lengthen it")
    rise_s = 2.0 * limits.band_um / speed_um_per_s
    why, least = (
        f"too short: a sound mirror takes {rise_s:.0f} s to rise by two bands",
        f"set at least {rise_s:.0f} s",
    )
    findings.error(states.inflate_stall_s < rise_s, "states.inflate_stall_s", why, least)
    vented, pressure_pa = "states.vented_pressure_pa", states.vented_pressure_pa
    less = "set less than half of limits.gauge_pressure_max_pa"
    too_high = pressure_pa > 0.5 * limits.gauge_pressure_max_pa
    findings.error(too_high, vented, "a mirror at this pressure is not vented", less)
    why = "within a gauge's noise at zero: venting would never end"
    findings.error(
        pressure_pa < _GAUGE_NOISE_PA, vented, why, f"set at least {_GAUGE_NOISE_PA:g} Pa"
    )


def _check_limits(config: Config, findings: cross_check_plant.ConfigFindings) -> None:
    """Judge the limits of the displacement: each can trip, and none trips in a sound hold."""
    limits, setpoint_um = config.limits, config.loop.setpoint_um
    trim_um = config.shape.trim_max_um if config.shape.enabled else 0.0
    if config.loop.holds != "vertex":
        trim_um += config.loop.held_offset_max_um
    above_um, below_um = (
        limits.displacement_max_um - setpoint_um,
        setpoint_um - limits.displacement_min_um,
    )
    # The setpoint moves by the trim, the mirror by the band: both must stay within the limits
    field = "shape.trim_max_um" if trim_um >= limits.band_um else "limits.band_um"
    for margin_um, side in ((above_um, "above"), (below_um, "below")):
        why = (
            f"trim and band reach the limit, {margin_um:g} µm {side} the setpoint ({setpoint_um:g} "
            "µm)"
        )
        remedy = "lower it, or move the setpoint or the limits"
        findings.error(trim_um + limits.band_um >= margin_um, field, why, remedy)
    following_um, margin_um = limits.following_error_max_um, min(above_um, below_um)
    why, less = (
        "can never trip: a displacement limit trips first",
        f"set less than {margin_um:g} µm",
    )
    findings.warn(following_um >= margin_um, "limits.following_error_max_um", why, less)
    why = f"a mirror inside the band would be a following error ({following_um:g} µm)"
    findings.error(
        limits.band_um >= following_um,
        "limits.band_um",
        why,
        "keep it below limits.following_error_max_um",
    )
    # A jump must be more than a moving film and the laser's noise make in one tick
    step_um = cross_check_plant.flow_um_per_s(config) / config.loop.rate_hz
    why = f"a moving film ({step_um:.2f} µm a tick) and the laser's noise (1 µm) reach it"
    findings.error(
        limits.step_max_um < 4.0 + step_um,
        "limits.step_max_um",
        why,
        f"set at least {4.0 + step_um:.0f} µm",
    )
    why = f"can never trip: the limit is {above_um:g} µm above the setpoint"
    findings.error(limits.step_max_um >= above_um, "limits.step_max_um", why, "lower it")


def _check_board(
    config: Config, board: BenchIdentity, findings: cross_check_plant.ConfigFindings
) -> None:
    """Check the limits that the board enforces itself."""
    # A limit here beyond the board's own would never trip: the board acts first, and latches
    own_pa = board.gauge_pressure_limit_pa
    above = config.limits.gauge_pressure_max_pa > own_pa
    findings.error(
        above,
        "limits.gauge_pressure_max_pa",
        f"the board itself vents at {own_pa:g} Pa",
        "lower it to that",
    )
    limit = board.pump_limit_fraction
    needed = pump_curve.PumpCurve(config.pump).fraction(cross_check_plant.flow_um_per_s(config))
    most = f"and the board limits the pump to {limit:g}"
    remedy = "lower it, or raise the board's limit"
    findings.error(
        needed > limit + 1e-9,
        "loop.flow_max_um_per_s",
        f"takes a command of {needed:.2f}, {most}",
        remedy,
    )
    test = max(part.pump_fraction for part in actuator_test.PARTS)
    refused = config.states.actuator_test and test > limit + 1e-9
    remedy = "raise the board's limit, or omit the test"
    findings.error(refused, "states.actuator_test", f"commands {test:g}, {most}", remedy)


def _board_guards(
    config: Config, board: BenchIdentity, findings: cross_check_plant.ConfigFindings
) -> None:
    """Check whether the board itself protects the mirror when its gauge fails."""
    if config.devices is None or config.devices.board is None or board.map_version == 0:
        return
    guarded = board.map_version >= _GUARDED_SINCE
    why = "this board's firmware does not stop the pump when its gauge fails"
    findings.warn(not guarded, "devices.board", why, f"update to map version {_GUARDED_SINCE}")
    why = (
        "no gauge is fitted according to the board's settings, so it has no over-pressure "
        "protection of its own"
    )
    findings.warn(
        guarded and not board.gauge_fitted,
        "devices.board",
        why,
        "store gauge_fitted = true in the board",
    )
    # The ramp down of the rule on the gauge must be over before the board stops the pump by itself:
    # a board that has latched needs a person
    noticed_s = _PRESSURE_MISSING.window / config.loop.rate_hz
    ramp_s = noticed_s + config.states.ramp_down_s
    cut = guarded and board.gauge_fitted and ramp_s >= board.gauge_timeout_s
    why = (
        f"the board itself stops the pump and latches {board.gauge_timeout_s:g} s after its "
        "gauge fails"
    )
    findings.warn(
        cut, "states.ramp_down_s", why, "shorten it, or lengthen gauge_timeout_s in the board"
    )
