"""What a command does to the mirror, and what it costs to return from it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control.filling_time import find_fall_s, find_filling_s
from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.review.formatting import format_span
from membrane_ctrl.service.action_button import ActionButton

_MOVES_GAS = frozenset(
    {"hold", "pause", "resume", "setpoint", "manual", "shape_on", "shape_off", "ack", "unlock"}
)
_COSTS_HOURS = frozenset({"lower", "vent", "latch", "stop"})


class Consequence(Enum):
    """What a command does to the mirror; the value is the heading of its buttons."""

    NOTHING = "leaves the mirror as it is"
    MOVES_GAS = "moves gas"
    COSTS_HOURS = "costs hours: the mirror goes down"


def find_consequence(action: ActionButton) -> Consequence:
    """The consequence of a command."""
    if action.do in _COSTS_HOURS:
        return Consequence.COSTS_HOURS
    return Consequence.MOVES_GAS if action.do in _MOVES_GAS else Consequence.NOTHING


@dataclass(frozen=True, slots=True)
class AllowedRange:
    """What a viewer may enter.

    Attributes
    ----------
    low, high : float
    now : float
        The present value; NaN if it is not known.
    unit : str
    """

    low: float
    high: float
    now: float
    unit: str

    @property
    def words(self) -> str:
        """The present value and the range."""
        now = f"now {self.now:g} {self.unit}; " if math.isfinite(self.now) else ""
        return f"{now}allowed: {self.low:g} to {self.high:g} {self.unit}"

    def explain_refusal(self, value: float) -> str:
        """Why a value is not allowed; empty if it is."""
        if self.low <= value <= self.high:
            return ""
        return f"{value:g} {self.unit} is outside of {self.low:g} to {self.high:g} {self.unit}"


def find_range(
    action: ActionButton, row: Mapping[str, Any], config: Config | None
) -> AllowedRange | None:
    """The present value and the allowed range of a command with a number.

    Parameters
    ----------
    action : ActionButton
        `setpoint` has the displacement limits; every other number is a flow.
    row : mapping
        The newest telemetry row: values by column, None where missing.
    config : Config or None
        The hold's configuration, whose limits are the range.

    Returns
    -------
    AllowedRange or None
        None for a command without a number, and if the hold's configuration is not known here.
    """
    if config is None or action.asks != "number":
        return None
    if action.do == "setpoint":
        limits = config.limits
        low, high = limits.displacement_min_um, limits.displacement_max_um
        return AllowedRange(low, high, _read_number(row, "target_um"), "µm")
    most = config.loop.flow_most_um_per_s(config.pump)
    column = COLUMNS["flow_um_per_s"]
    now = _read_number(row, column.name)
    shown = round(now, column.decimals) if math.isfinite(now) else now
    return AllowedRange(0.0, most, shown, column.unit)


def describe_price(action: ActionButton, row: Mapping[str, Any], config: Config | None) -> str:
    """What it costs to return from a command, in a sentence; empty if it costs nothing.

    The leak is the present estimate of the hold; without one, that of the configuration's mirror is
    not assumed.

    Parameters
    ----------
    action : ActionButton
        Only `lower`, `vent`, `latch` and `stop` have a price: the mirror must be filled again.
    row : mapping
        The newest telemetry row, for the leak, µm/s.
    config : Config or None
        The hold's configuration: sag and pressure of the mirror, full flow of the pump. None if it
        is not known here; then there is no sentence.
    """
    if action.do not in _COSTS_HOURS or config is None:
        return ""
    mirror = config.optics.mirror
    leak_um_per_s = _read_number(row, "leak_um_per_s")
    flow_um_per_s = config.loop.flow_most_um_per_s(config.pump)
    if not math.isfinite(leak_um_per_s):
        return ""
    # What it takes to come back: full flow less the leak, from flat. Down, a vent is quick; without
    # one, the leak takes its time
    filling_s = find_filling_s(mirror.sag_mm, flow_um_per_s, leak_um_per_s)
    again = (
        f"filling it from flat takes {_format_duration(filling_s)}"
        if math.isfinite(filling_s)
        else "the leak is too large to fill it from flat"
    )
    if action.do == "vent" and config.vent_fitted:
        return f"Venting: {_format_duration(filling_s)} until it holds again."
    end_pa = config.states.vented_pressure_pa
    fall_s = find_fall_s(mirror.sag_mm, mirror.pressure_pa, end_pa, leak_um_per_s)
    return (
        f"The leak lowers the mirror by {60e-3 * leak_um_per_s:.2g} mm/min, to {end_pa:g} Pa in "
        f"{_format_duration(fall_s)}; {again}."
    )


def _format_duration(seconds: float) -> str:
    return format_span(seconds) if seconds < 3600.0 else f"{seconds / 3600.0:.2g} h"


def _read_number(row: Mapping[str, Any], name: str) -> float:
    value = row.get(name)
    return float(value) if isinstance(value, (int, float)) else math.nan
