"""One line that answers "why is the pump where it is" and "why is it not holding"."""

import math
from collections.abc import Sequence

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.columns import MISSING
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.telemetry import SafeLevel, State, TelemetryRow

_LEVELS = {
    SafeLevel.HOLD_FLOW: "pump keeps its last mean flow",
    SafeLevel.RAMP_DOWN: "pump is ramped down",
    SafeLevel.PUMP_OFF: "pump is off",
    SafeLevel.VENT: "pump is off and the vent is open",
}
_NO_VENT = "pump is off; no vent is fitted, the leak lowers the mirror"
_VENT_SHUT = 0.5  # share of its command below which a vent's read-back contradicts it
_STATES = {
    State.STANDBY: "pump is off: no hold was requested",
    State.CHECK: "pump is off until every sensor has been good for a while",
    State.MANUAL: "pump is set by hand",
    State.TUNE: "pump is driven by a tuning session",
    State.LOWER: "pump is being stopped: the run is ending",
    State.FAULT: "pump is off: a person must clear the latched fault",
}
# the command that ends a state in which somebody is waited for, and its key
_NEXT_COMMANDS = {
    State.STANDBY: ("hold", " or key h"),
    State.MANUAL: ("hold", " or key h"),
    State.FAULT: ("ack", ""),
}
_WORTH_NAMING = 0.03  # of the flow: smaller contributions are not named


def list_used_sensors(row: TelemetryRow) -> str:
    """The sensors that the estimate of the centre follows: laser and optics with their shares of
    its corrections.
    """
    seeing = {
        f"laser {format_percent(1.0 - row.optics_share)}": row.laser_innovation,
        f"optics {format_percent(row.optics_share)}": row.optics_innovation,
        "barometer": row.barometer_innovation,
        "thermometer": row.thermometer_innovation,
    }
    words = (name for name, innovation in seeing.items() if math.isfinite(innovation))
    return ", ".join(words) or "nothing"


def explain_state(
    row: TelemetryRow, reported: str, fault: str, config: Config, paused: bool = False
) -> str:
    """Return the line.

    Parameters
    ----------
    row : TelemetryRow
        The newest tick.
    reported : str
        The controller's last reason.
    fault : str
        Describes the standing fault, or is empty.
    config : Config
        Of the run, for limits and band.
    paused : bool
        Whether a person has paused the hold.
    """
    state = State(int(row.state))
    safe_level = SafeLevel(int(row.safe_level))
    # The safety table first, then states that give their reason, then the loop.
    if safe_level != SafeLevel.NONE:
        return f"{_level_words(safe_level, row, config)}: {fault or reported or 'unknown fault'}"
    if state in _STATES:
        return reported or _STATES[state]
    sees = math.isfinite(row.displacement_um) or math.isfinite(row.estimate_sigma_um)
    if not (sees and math.isfinite(row.filtered_um)):
        return f"{_LEVELS[SafeLevel.HOLD_FLOW]}: {reported or fault or 'no valid laser reading'}"
    if paused:
        return reported
    # How far the mirror is from where it is to be.
    if state == State.INFLATE:
        to_go_um = row.target_um - row.filtered_um
        phase = "filling" if to_go_um > 0 else "waiting for the leak"
        return f"{_describe_pump_flow(row)}: {phase}, {abs(to_go_um):.1f} µm to go"
    if abs(row.error_um) > config.limits.band_um:
        return f"outside the band: {_describe_deviation(row)}"
    if state == State.HOLD:
        return _describe_flow_terms(row)
    return f"settling: {_describe_flow_terms(row)}"


def _level_words(safe_level: SafeLevel, row: TelemetryRow, config: Config) -> str:
    """What a safe level does on this bench."""
    if safe_level != SafeLevel.VENT:
        return _LEVELS[safe_level]
    if not config.vent_fitted:
        return _NO_VENT
    if row.vent_readback_fraction < _VENT_SHUT * row.vent_fraction:
        return (
            "pump is off; the vent is commanded open, but its read-back is "
            f"{format_percent(row.vent_readback_fraction)}"
        )
    return _LEVELS[safe_level]


def explain_next_step(
    row: TelemetryRow,
    paused: bool,
    ctl: str,
    keys: bool,
    locks: Sequence[Lock] = (),
    latched: str = "",
) -> str:
    """Return how to continue from a state that waits for a person; empty in others.

    Parameters
    ----------
    row : TelemetryRow
        The newest tick.
    paused : bool
        Whether a person has paused the hold.
    ctl : str
        Begin of a command to this run.
    keys : bool
        The console reads keys: their names are added.
    locks : sequence of Lock
        The first one is to be removed first.
    latched : str
        A fault that is still latched in standby; empty without one.
    """
    state = State(int(row.state))
    if locks:
        return f"next: ask {locks[0].author}, then `{ctl} unlock {locks[0].word}`"
    if state == State.STANDBY and latched:
        state = State.FAULT
    if paused:
        command, key = "resume", " or key p"
    else:
        command, key = _NEXT_COMMANDS.get(state, ("", ""))
    if not command:
        return ""
    return f"next: `{ctl} {command}`{key if keys else ''}"


def _describe_deviation(row: TelemetryRow) -> str:
    """Direction of the deviation, and the pump's response to it (error = setpoint - reading)."""
    pump = _describe_pump_flow(row)
    if row.error_um > 0:
        if row.flow_wanted_um_per_s > row.flow_um_per_s + 1e-6:
            pump += ", its limit"
        return f"bowl {row.error_um:.1f} µm too shallow, {pump}"
    if row.flow_um_per_s <= 0:
        pump += ", only the leak can lower it"
    return f"bowl {-row.error_um:.1f} µm too deep, {pump}"


def _describe_flow_terms(row: TelemetryRow) -> str:
    """Contributions to the flow, largest first."""
    parts = {
        "integral": row.i_um_per_s,  # on average it balances the leak
        "proportional": row.p_um_per_s,
        "derivative": row.d_um_per_s,
        "feed-forward": row.feedforward_um_per_s,
    }
    least = _WORTH_NAMING * max(abs(row.flow_um_per_s), abs(row.i_um_per_s))
    largest_first = sorted(parts.items(), key=lambda part: -abs(part[1]))
    named = [f"{value:+.2f} {name}" for name, value in largest_first if abs(value) > least]
    return f"{_describe_pump_flow(row)}: {', '.join(named)}"


def _describe_pump_flow(row: TelemetryRow) -> str:
    if row.flow_um_per_s <= 0:
        return "pump is at 0"
    return f"pump gives {row.flow_um_per_s:.2f} µm/s"


def format_number(value: float, digits: int, unit: str = "", sign: bool = False) -> str:
    """Format a value with its unit.

    Parameters
    ----------
    value : float
        NaN or infinite: the sign for a missing value.
    digits : int
        After the decimal point.
    unit : str
        Follows after a blank; empty: none.
    sign : bool
        A plus before positive values, for changes and errors.
    """
    if not math.isfinite(value):
        return MISSING
    sign_option = "+" if sign else ""
    figure = f"{value:{sign_option}.{digits}f}"
    return f"{figure} {unit}" if unit else figure


def format_percent(fraction: float, digits: int = 0) -> str:
    """Format a fraction as a percentage.

    Parameters
    ----------
    fraction : float
        1 is 100 %; NaN is the sign for a missing value.
    digits : int
        After the decimal point.
    """
    return format_number(100.0 * fraction, digits, "%")


def format_duration(seconds_s: float) -> str:
    """Format a time span: 7 s, 2:05, 3:02:05, 4 d 03:02:05."""
    if not math.isfinite(seconds_s):
        return MISSING
    minutes, seconds = divmod(int(seconds_s), 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    if days:
        return f"{days} d {hours:02}:{minutes:02}:{seconds:02}"
    if hours:
        return f"{hours}:{minutes:02}:{seconds:02}"
    if minutes:
        return f"{minutes}:{seconds:02}"
    return f"{seconds} s"
