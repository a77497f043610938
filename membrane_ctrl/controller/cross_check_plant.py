"""Findings on pump, sensors, loops, optics and alarms. `cross_check` has those on guards and
limits.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

from firmware_iface.roles import BenchIdentity
from firmware_iface.settings import ModbusMapConfig, Optoncdt1420Config
from membrane_ctrl.config import sight
from membrane_ctrl.config.schema import Config, LoopConfig, OpticsConfig
from membrane_ctrl.control import film_monitor, leak_growth, loop_margins, pump_curve
from membrane_ctrl.control.filling_time import find_fall_s, find_leak_speed
from membrane_ctrl.controller import actuator_test, safety

Severity = Literal["error", "warning"]

_MS_MOST, _MS_WARN = 3.0, 1.8  # peak sensitivity: 3 leaves a phase margin of 19 deg
_BAROMETER_UM_PER_PA, _TEMPERATURE_UM_PER_K = -0.358, 123.0  # docs/explanation/physics.md
_FEEDFORWARD_MOST = 2.0  # times the physical gain: beyond, feed-forward is worse than none
_GAUGE_BLIND_S = 600.0  # a slow, filtered gauge on a calm mirror repeats itself for minutes
_STORM_PA = 5.0  # effect on the gauge of 250 Pa of weather at once
# Figures a second to inflate by without a laser: the loop then has 0.3 s of delay and keeps its
# margins
_TRACK_LEAST_HZ = 5.0
# Differences between a sound laser and gauge: the gauge's noise at 1 Hz and a mount that warms up;
# the creep of a fresh film within hours, and with a day of +-1 K and +-5 % of relative humidity
# (control/film_monitor.py)
_APART_UM, _CREEP_UM, _CLIMATE_UM = 7.0, 31.0, 220.0


@dataclass(frozen=True, slots=True)
class ConfigFinding:
    """One wrong setting: an `error` refuses it, a `warning` only reports it."""

    severity: Severity
    field: str
    value: str
    why: str
    remedy: str

    def line(self, source: str) -> str:
        """Format the finding for people, with the file's name."""
        mark = "warning: " if self.severity == "warning" else ""
        return f"{source}: {mark}{self.field} = {self.value}: {self.why}; {self.remedy}"


class ConfigFindings:
    """Collects findings; looks up values by field name, so that no name can be wrong."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self.found: list[ConfigFinding] = []

    def error(self, wrong: bool, field: str, why: str, remedy: str) -> None:
        """Add an error, which refuses the configuration, if there is one.

        Parameters
        ----------
        wrong : bool
            Whether there is: the callers read as a list of conditions.
        field : str
            Path of the key, such as `loop.kp_per_s` or `alarms.rules.0.raise_at`; its value is
            looked up.
        why : str
            What would happen, for a person.
        remedy : str
            What to set instead, or to measure.
        """
        if wrong:
            self.found.append(ConfigFinding("error", field, self._find_value(field), why, remedy))

    def warn(self, wrong: bool, field: str, why: str, remedy: str) -> None:
        """Add a warning, which only reports, if there is one.

        Parameters
        ----------
        wrong, field, why, remedy
            As for `error`.
        """
        if wrong:
            self.found.append(ConfigFinding("warning", field, self._find_value(field), why, remedy))

    def _find_value(self, field: str) -> str:
        value: Any = self._config
        for name in field.split("."):
            value = value[int(name)] if name.isdigit() else getattr(value, name)
        return f"{value:g}" if isinstance(value, float) else str(value)


def flow_um_per_s(config: Config) -> float:
    return config.loop.flow_most_um_per_s(config.pump)


def judge_pump(config: Config, findings: ConfigFindings) -> None:
    """Judge the pump's curve against the loop and the actuator test.

    Parameters
    ----------
    config : Config
        `[pump]`, `[loop]`, and the scales of the devices that take the commands.
    findings : ConfigFindings
        Gets the errors and warnings.
    """
    pump, loop = config.pump, config.loop
    least = 0.0 if pump.curve_fraction else pump.dead_fraction  # of the straight line only
    why = f"must lie between dead_fraction ({least:g}) and start_fraction ({pump.start_fraction:g})"
    ordered = least <= pump.stall_fraction <= pump.start_fraction
    findings.error(not ordered, "pump.stall_fraction", why, "measure all three")
    # The actuator test, and then the loop, must be able to start the pump
    test_fraction = max(part.pump_fraction for part in actuator_test.PARTS)
    if pump.start_fraction >= test_fraction:
        why = f"the actuator test commands {test_fraction:g}, which would not start the pump"
        findings.error(
            config.states.actuator_test,
            "pump.start_fraction",
            why,
            "measure it; no pump starts that late",
        )
        findings.warn(
            not config.states.actuator_test,
            "pump.start_fraction",
            "no pump starts that late",
            "measure it",
        )
    else:
        least_um_per_s = pump_curve.PumpCurve(pump).least_flow_um_per_s
        why = (
            f"a running pump gives at least {least_um_per_s:.2f} µm/s: it would only switch on "
            "and off"
        )
        remedy = "set several times as much, or measure pump.stall_fraction"
        findings.error(
            loop.flow_max_um_per_s <= 2.0 * least_um_per_s, "loop.flow_max_um_per_s", why, remedy
        )
    # The flow that the loop may want, and the commands that the devices accept
    more = loop.flow_max_um_per_s > pump.flow_full_um_per_s + 1e-9
    why = f"the pump gives {pump.flow_full_um_per_s:g} µm/s (pump.flow_full_um_per_s)"
    findings.warn(more, "loop.flow_max_um_per_s", why, "measure the pump, or lower it")
    if config.devices is None:
        return
    for role in ("pump", "vent"):
        section = getattr(config.devices, role)
        if isinstance(section, ModbusMapConfig):
            name = "limits" if section.limits is not None else "value"
            low, high = min(section.limits or section.value), max(section.limits or section.value)
            never = (
                "does not contain 0, so it can never be shut"
                if role == "pump"
                else "does not contain 0"
            )
            findings.error(low > 0.0, f"devices.{role}.{name}", never, "begin at 0")
            findings.error(
                high < 1.0, f"devices.{role}.{name}", "a command of 1 would be refused", "end at 1"
            )


def judge_vent(config: Config, findings: ConfigFindings) -> None:
    """Report what a bench without a vent cannot do, and how long its mirror takes to go down.

    Parameters
    ----------
    config : Config
        The time is estimated from `optics.mirror` and `twin.leak_time_constant_s`.
    findings : ConfigFindings
        Gets one warning.
    """
    if config.vent_fitted:
        return
    why = "no vent is fitted: the safe level vent, and `ctl vent`, only stop the pump"
    remedy = "fit a vent; for a better estimate set twin.leak_time_constant_s to your mirror's"
    findings.warn(
        True,
        "devices.vent",
        f"{why}, and the leak alone lowers the mirror{_leak_estimate(config)}",
        remedy,
    )


def _leak_estimate(config: Config) -> str:
    """How long the leak takes to lower the mirror, and on what basis; empty for a film that is
    slack already.
    """
    mirror, end_pa, time_constant_s = (
        config.optics.mirror,
        config.states.vented_pressure_pa,
        config.twin.leak_time_constant_s,
    )
    if not mirror.pressure_pa > end_pa > 0.0:
        return ""
    speed_um_per_s = find_leak_speed(mirror.sag_mm, time_constant_s)
    takes_s = find_fall_s(mirror.sag_mm, mirror.pressure_pa, end_pa, speed_um_per_s)
    return (
        f", from {mirror.pressure_pa:g} to {end_pa:g} Pa in about {takes_s / 3600.0:.2g} h "
        "(estimated with "
        f"twin.leak_time_constant_s = {time_constant_s:g} s, which is a leak of "
        f"{speed_um_per_s:.2g} µm/s)"
    )


def weak_gains(loop: LoopConfig) -> tuple[Severity, str] | None:
    """What is wrong with the gains of a loop on the nominal pump, if anything."""
    sensitivity = loop_margins.peak_sensitivity(loop)
    gains = (
        f"with Ti {loop.ti_s:g} s, Td {loop.td_s:g} s, a filter of {loop.measurement_filter_s:g} s"
    )
    if loop.kp_per_s == 0.0:
        return "error", "nothing would hold the mirror"
    if math.isinf(sensitivity):
        return "error", f"{gains} the loop is unstable on the nominal pump"
    close = (
        f"{gains} the loop is close to unstable (peak sensitivity {sensitivity:.1f}, the "
        "defaults have 1.3)"
    )
    if sensitivity > _MS_MOST:
        return "error", close
    return ("warning", close) if sensitivity > _MS_WARN else None


def judge_loop(config: Config, findings: ConfigFindings) -> None:
    """Judge gains, feed-forward, ramp, bleed and the rate of the flow.

    Parameters
    ----------
    config : Config
        `[loop]` on the nominal pump: peak sensitivity, signs and sizes against physics, and what
        the pump can follow.
    findings : ConfigFindings
        Gets the errors and warnings.
    """
    loop, full_um_per_s = config.loop, flow_um_per_s(config)
    severity, why = weak_gains(loop) or ("", "")
    measure = "run `tune`, or use the default gains"
    findings.error(severity == "error", "loop.kp_per_s", why, measure)
    findings.warn(severity == "warning", "loop.kp_per_s", why, measure)
    # Feed-forward: sign and size against physics
    for on, name, nominal in (
        (loop.feedforward_barometer, "barometer_gain_um_per_pa", _BAROMETER_UM_PER_PA),
        (loop.feedforward_temperature, "temperature_gain_um_per_k", _TEMPERATURE_UM_PER_K),
    ):
        share, remedy = (
            getattr(loop, name) / nominal,
            f"physics gives {nominal:g}, see docs/explanation/physics.md",
        )
        findings.error(
            on and share < 0.0,
            f"loop.{name}",
            "wrong sign: it would double the weather's effect",
            remedy,
        )
        why = "more than twice the physical value: worse than no feed-forward"
        findings.error(on and share > _FEEDFORWARD_MOST, f"loop.{name}", why, remedy)
    # What the pump can follow
    why = f"faster than the pump's {full_um_per_s:g} µm/s"
    findings.warn(
        loop.setpoint_ramp_um_per_s > full_um_per_s, "loop.setpoint_ramp_um_per_s", why, "lower it"
    )
    bleed_um_per_s = loop.bleed_fraction * pump_curve.VENT_FULL_UM_PER_S
    why = f"the vent would take about {bleed_um_per_s:.0f} µm/s, half of the pump's flow or more"
    remedy = f"set less than {0.5 * full_um_per_s / pump_curve.VENT_FULL_UM_PER_S:.3f}"
    findings.error(bleed_um_per_s > 0.5 * full_um_per_s, "loop.bleed_fraction", why, remedy)
    swing_s = full_um_per_s / loop.flow_rate_limit_um_per_s2
    why = f"the pump needs {swing_s:.0f} s from none to full: the loop would swing"
    remedy = f"set at least {0.5 * full_um_per_s:.1f} µm/s2"
    findings.error(swing_s > 2.0, "loop.flow_rate_limit_um_per_s2", why, remedy)


def judge_shape(config: Config, findings: ConfigFindings) -> None:
    """Judge the shape loop: ages and periods of the figures, and what the held scalar needs.

    Parameters
    ----------
    config : Config
        `[shape]`, and `loop.holds`.
    findings : ConfigFindings
        Gets the errors and warnings.
    """
    shape = config.shape
    holds = config.loop.holds
    why = "the figure is not measured: shape.enabled is false"
    needs_figures = holds != "vertex" and not shape.enabled
    findings.error(needs_figures, "loop.holds", why, 'set it to "vertex", or measure the figure')
    unused = bool(config.loop.reference_figure_um) and holds != "best_fit"
    why = "a reference figure is used by best_fit only"
    findings.warn(unused, "loop.holds", why, 'set it to "best_fit", or remove reference_figure_um')
    if not shape.enabled:
        return
    why = f"a shape comes every {shape.period_s:g} s: the last one is never fresh"
    findings.error(shape.fresh_s < shape.period_s, "shape.fresh_s", why, "set several periods")
    why = f"shorter than two periods of {shape.period_s:g} s: the trim would follow the noise"
    findings.error(
        shape.time_constant_s < 2.0 * shape.period_s, "shape.time_constant_s", why, "set 20 periods"
    )
    outruns = shape.trim_rate_max_um_per_s > 0.5 * config.loop.setpoint_ramp_um_per_s
    why = "the trim may outrun the setpoint's ramp (loop.setpoint_ramp_um_per_s)"
    findings.error(outruns, "shape.trim_rate_max_um_per_s", why, "set 0.1 µm/s")
    never = shape.disagreement_max_um >= config.limits.displacement_max_um - config.loop.setpoint_um
    why = "can never trip: limits.displacement_max_um trips first"
    findings.error(never, "shape.disagreement_max_um", why, "set 10 µm")
    why = f"a cycle of 8 frames does not fit into shape.period_s ({shape.period_s:g} s)"
    findings.warn(
        8.0 * shape.frame_interval_s > shape.period_s, "shape.frame_interval_s", why, "shorten it"
    )


def judge_optics(config: Config, findings: ConfigFindings) -> None:
    """Judge the geometry, and what a bench without a laser needs of its optics.

    Parameters
    ----------
    config : Config
        `[optics]`, the twin's own geometry, and `[shape]`.
    findings : ConfigFindings
        Gets an error where camera and screen cannot see each other in the mirror, a warning where
        that is doubtful.
    """
    if config.by_optics:
        shape, why = config.shape, "a bench held without a laser needs a figure from every frame"
        findings.error(not shape.enabled, "shape.enabled", why, "set it to true")
        findings.error(shape.mode == "cycle", "shape.mode", why, 'set it to "track"')
        slow, least = shape.track_rate_hz < _TRACK_LEAST_HZ, f"set at least {_TRACK_LEAST_HZ:g} Hz"
        findings.error(slow, "shape.track_rate_hz", "too few figures to hold the mirror by", least)
    camera = config.devices is not None and config.devices.camera is not None
    _check_geometry("optics.geometry", config.optics, config.shape.enabled or camera, findings)
    if config.twin.geometry is not None:
        true = config.optics.model_copy(update={"geometry": config.twin.geometry})
        _check_geometry("twin.geometry", true, config.shape.enabled, findings)


def _check_geometry(field: str, optics: OpticsConfig, used: bool, findings: ConfigFindings) -> None:
    """Judge lengths and poses: camera and screen must see each other in the mirror."""
    geometry = optics.geometry
    # Lengths measured too poorly to be of use.
    for name in ("a", "b"):
        length_mm, sigma_mm = getattr(geometry, f"{name}_mm"), getattr(geometry, f"{name}_sigma_mm")
        wide = length_mm is not None and sigma_mm is not None and sigma_mm > 0.1 * length_mm
        findings.warn(
            wide, f"{field}.{name}_sigma_mm", "a tenth of the length or more", "measure again"
        )
    # A camera that could not see the screen in the mirror.
    if geometry.camera is not None and geometry.camera.position_mm[2] <= 0.0:
        why = "the camera is behind the mirror"
        findings.error(True, f"{field}.camera.position_mm", why, "z points out of the mirror")
    elif used and (found := sight.find_doubt(optics)):
        key = f"{field.removesuffix('geometry')}{found.table}.{found.key}"
        findings.error(found.hopeless, key, found.why, found.remedy)
        findings.warn(not found.hopeless, key, found.why, found.remedy)


def judge_alarms(config: Config, findings: ConfigFindings) -> None:
    """Judge the alarms: those that can never be raised, and a silence shorter than a tick.

    Parameters
    ----------
    config : Config
        `[alarms]`; the largest values follow from limits, pump and safety table.
    findings : ConfigFindings
        Gets the errors and warnings.
    """
    alarms, tick_s = config.alarms, 1.0 / config.loop.rate_hz
    findings.error(
        alarms.silent_s < 2.0 * tick_s,
        "alarms.silent_s",
        "a tick takes that long",
        f"set {4.0 * tick_s:g} s",
    )
    most = {
        "fault": max(rule.code for rule in safety.TABLE),
        "pump_fraction": 1.0,
        "vent_fraction": 1.0,
        "flow_um_per_s": flow_um_per_s(config),
        "gauge_pressure_pa": config.limits.gauge_pressure_max_pa,
        "displacement_um": config.limits.displacement_max_um,
    }
    for index, rule in enumerate(alarms.rules):
        if rule.raise_at > rule.clear_at and rule.field in most:
            why = f"{rule.name} can never be raised: {rule.field} is at most {most[rule.field]:g}"
            findings.error(
                rule.raise_at >= most[rule.field], f"alarms.rules.{index}.raise_at", why, "lower it"
            )


def judge_gauge(config: Config, findings: ConfigFindings) -> None:
    """Judge the gauge as a guard and as a check of the laser.

    Parameters
    ----------
    config : Config
        The limits of pressure, of a gauge that repeats itself, and of laser against gauge: each
        must be able to trip, and must not trip by weather or noise alone.
    findings : ConfigFindings
        Gets the errors and warnings.
    """
    limits, pressure_pa, tick_s = (
        config.limits,
        config.optics.mirror.pressure_pa,
        1.0 / config.loop.rate_hz,
    )
    above_um = limits.displacement_max_um - config.loop.setpoint_um
    # The limit of pressure, and of a jump below it
    margin_pa = limits.gauge_pressure_max_pa - pressure_pa
    why = f"the mirror has {pressure_pa:g} Pa at displacement 0 (optics.mirror.pressure_pa)"
    findings.error(
        margin_pa <= 0.0, "limits.gauge_pressure_max_pa", why, "measure that, or raise the limit"
    )
    step, why = "limits.gauge_step_max_pa", "can never trip: the pressure limit trips first"
    findings.error(
        0.0 < margin_pa <= limits.gauge_step_max_pa, step, why, f"set less than {margin_pa:g} Pa"
    )
    least = f"set at least {_STORM_PA:g} Pa"
    findings.error(
        limits.gauge_step_max_pa < _STORM_PA, step, "a storm alone moves the gauge this far", least
    )
    # A gauge that repeats its value: neither too long nor by chance
    stuck, most = "limits.gauge_stuck_s", f"set at most {_GAUGE_BLIND_S:g} s"
    findings.error(
        limits.gauge_stuck_s > _GAUGE_BLIND_S,
        stuck,
        "a stopped gauge would guard nothing this long",
        most,
    )
    least = f"set at least {3.0 * tick_s:g} s"
    findings.error(
        limits.gauge_stuck_s < 3.0 * tick_s,
        stuck,
        "two readings equal by chance would be a fault",
        least,
    )
    # Laser against gauge: within minutes and an hour, then within a day
    for name, least_um, by in (
        ("laser_gauge_apart_max_um", _APART_UM, "the gauge's noise and a mount that warms up"),
        ("laser_gauge_drift_max_um", _CREEP_UM, "the creep of a fresh film"),
    ):
        why = f"can never trip: limits.displacement_max_um is {above_um:g} µm above the setpoint"
        findings.error(getattr(limits, name) >= above_um, f"limits.{name}", why, "lower it")
        why = f"{by} alone reach it"
        findings.error(
            getattr(limits, name) < least_um, f"limits.{name}", why, f"set at least {least_um:g} µm"
        )
    why, least = (
        "a day's temperature and humidity alone reach it",
        f"set at least {_CLIMATE_UM:g} µm",
    )
    findings.error(
        limits.laser_gauge_day_max_um < _CLIMATE_UM, "limits.laser_gauge_day_max_um", why, least
    )


def judge_film(config: Config, findings: ConfigFindings) -> None:
    """Judge the film's data, which serve to judge gas, laser and gauge.

    Parameters
    ----------
    config : Config
        `optics.mirror`, and the limits of leak and range.
    findings : ConfigFindings
        Gets the errors and warnings.
    """
    limits, mirror = config.limits, config.optics.mirror
    # The growth of the leak that is a fault: within what the pump gives, and beyond what weather
    # shows.
    most = 1.0 + flow_um_per_s(config) / leak_growth.LEAK_LEAST_UM_PER_S
    growth, why = (
        "limits.leak_growth_max",
        f"can never trip: the pump gives {flow_um_per_s(config):g} µm/s",
    )
    findings.error(limits.leak_growth_max >= most, growth, why, f"set less than {most:.1f}")
    least = f"set at least {leak_growth.CONTRADICTED_MOST:g}"
    findings.error(
        limits.leak_growth_max < leak_growth.CONTRADICTED_MOST,
        growth,
        "the weather's effect on a leak trips it",
        least,
    )
    # Depth and range.
    why = f"no film of {mirror.radius_mm:g} mm radius is this deep"
    findings.error(
        mirror.sag_mm >= 0.5 * mirror.radius_mm,
        "optics.mirror.sag_mm",
        why,
        "set the bowl's depth in mm",
    )
    why = f"can never trip: the bowl is only {mirror.sag_mm:g} mm deep (optics.mirror.sag_mm)"
    findings.error(
        limits.displacement_min_um <= -1e3 * mirror.sag_mm,
        "limits.displacement_min_um",
        why,
        "raise it",
    )
    # The pressure at displacement 0, by which laser and gauge are compared.
    pressure, why = (
        "optics.mirror.pressure_pa",
        f"laser and gauge are not compared below {film_monitor.TAUT_PA:g} Pa",
    )
    findings.warn(
        0.0 < mirror.pressure_pa <= film_monitor.TAUT_PA,
        pressure,
        why,
        "measure it with the film taut",
    )
    why = "unknown: a gauge in the wrong unit would go unnoticed"
    findings.warn(
        mirror.pressure_pa == 0.0, pressure, why, "set the gauge's reading at displacement 0"
    )


def judge_ranges(config: Config, board: BenchIdentity, findings: ConfigFindings) -> None:
    """Judge limits against sensor ranges: a limit outside its sensor's range never trips.

    Parameters
    ----------
    config : Config
        The limits, and the ranges that the devices' tables state.
    board : BenchIdentity
        The ranges that the devices themselves state, in µm and Pa; infinite before they are read.
        The narrower of both counts.
    findings : ConfigFindings
        Gets the errors and warnings.
    """
    limits, devices = config.limits, config.devices
    laser = devices.displacement if devices is not None else None
    gauge = devices.roles().get("gauge_pressure") if devices is not None else None
    stated_um = stated_pa = (-math.inf, math.inf)
    # Ranges as the configuration states them
    if isinstance(laser, ModbusMapConfig):
        stated_um = laser.limits or laser.value
    elif isinstance(laser, Optoncdt1420Config) and laser.range_mm is not None:
        zero_mm = laser.range_mm / 2 if laser.zero_mm is None else laser.zero_mm
        stated_um = (
            -1e3 * laser.direction * zero_mm,
            1e3 * laser.direction * (laser.range_mm - zero_mm),
        )
    if isinstance(gauge, ModbusMapConfig):
        stated_pa = gauge.limits or gauge.value
    # The narrower one of these and of the sensor's own
    low_um = max(min(stated_um), board.displacement_range_um[0])
    high_um = min(max(stated_um), board.displacement_range_um[1])
    full_pa = min(max(stated_pa), board.gauge_range_pa[1])
    # A limit beyond the range never trips
    why, remedy = (
        f"can never trip: the laser's range is {low_um:g} .. {high_um:g} µm",
        "change it, or move the laser",
    )
    findings.error(limits.displacement_max_um > high_um, "limits.displacement_max_um", why, remedy)
    findings.error(limits.displacement_min_um < low_um, "limits.displacement_min_um", why, remedy)
    pressure, why = (
        "limits.gauge_pressure_max_pa",
        f"can never trip: the gauge shows at most {full_pa:g} Pa",
    )
    findings.error(
        limits.gauge_pressure_max_pa >= full_pa, pressure, why, "lower it, or use another gauge"
    )
