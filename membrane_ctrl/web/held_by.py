"""What holds the mirror: the sensors with their weights, and the standard deviation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from membrane_ctrl.console.why import list_used_sensors
from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.model.held_words import describe_held
from membrane_ctrl.model.telemetry import FIELDS, TelemetryRow


def describe_holder(status: Mapping[str, Any]) -> str:
    """Which sensors the loop follows, each with its weight, and the estimate's standard deviation;
    empty if nothing is held. Behind it, what is held besides the centre.

    Parameters
    ----------
    status : mapping
        As the control port answers it.
    """
    values = status.get("row")
    if status.get("state") not in ("hold", "settle", "tune") or not isinstance(values, dict):
        return ""
    sensors = _describe_sensors(status, values)
    scalar = describe_held(status.get("held"), values)
    return "; ".join(part for part in (sensors, scalar) if part)


def _describe_sensors(status: Mapping[str, Any], values: Mapping[str, Any]) -> str:
    row = TelemetryRow(**{name: _to_number(values.get(name)) for name in FIELDS})
    if math.isfinite(row.estimate_sigma_um):
        sigma = COLUMNS["estimate_sigma_um"].format_value(row.estimate_sigma_um)
        return f"held by {list_used_sensors(row)}: centre ± {sigma} µm (1 σ)"
    if math.isfinite(row.displacement_um):
        if math.isnan(row.displacement_quality):  # readings of the optics have no code
            return "held by the optics"
        trimmed = status.get("shape") == "tracking"
        corrected = "; the optics correct its setpoint" if trimmed else ""
        return f"held by the laser{corrected}"
    return "held by nothing: no reading"


def _to_number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan
