"""What is held besides the centre, as a sentence for every display."""

import math
from collections.abc import Mapping
from typing import Any

from membrane_ctrl.model.columns import COLUMNS

# By the state of the event `held`: (the scalar and what the hold does with it)
_SENTENCES = {
    "off": "{name} is not followed",
    "waiting": "{name} waits for its reference",
    "tracking": "{name} is held",
    "kept": "{name} is not followed: the centre rests at the last offset",
    "vertex": "{name} is not followed: the centre rests at the last offset",  # of older holds
    "expired": "{name} is not known any more",
}


def describe_held(held: Mapping[str, Any] | None, row: Mapping[str, Any]) -> str:
    """Return what is held, how well, and how far the centre stands from the setpoint for it.

    Parameters
    ----------
    held : mapping or None
        `holds`, `state` and `reason` of the last event `held`; None while the centre is held.
    row : mapping
        The newest telemetry row: values by column, None or NaN where missing.

    Returns
    -------
    str
        Empty while the centre is held.
    """
    if held is None:
        return ""
    name = str(held["holds"]).replace("_", " ")
    words = _SENTENCES.get(str(held["state"]), "{name}: " + str(held["state"]))
    sentence = words.format(name=name)
    if held.get("reason"):
        sentence += f" ({held['reason']})"
    offset_um = _to_number(row.get("held_offset_um"))
    if not math.isfinite(offset_um):
        return sentence
    offset = COLUMNS["held_offset_um"].format_value(offset_um, sign=True)
    sigma_um = _to_number(row.get("held_offset_sigma_um"))
    if math.isfinite(sigma_um):
        offset += f" ± {COLUMNS['held_offset_sigma_um'].format_value(sigma_um)}"
    return f"{sentence}; the centre stands {offset} µm from the setpoint for it"


def _to_number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan
