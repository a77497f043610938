"""The signals that other systems get: one table of names with units, and their values.

The interface for programs and all bridges publish these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from membrane_ctrl.control_port.status_lines import fault_line, lock_lines, notice_lines
from membrane_ctrl.model.columns import PUBLISHED
from membrane_ctrl.model.notices import Topic
from membrane_ctrl.service.hold_seen import HoldSeen
from membrane_ctrl.service.published_signal import Published

Value = float | str | None  # None: not known
_TERMS = range(4, 12)  # Noll: defocus to the first spherical term


_TICK = tuple(Published(each.name, each.description) for each in PUBLISHED)
_FIGURE = (
    Published("sag_um", "sag of the newest figure"),
    Published("sag_change_sigma_um", "standard deviation of its changes"),
    Published("figure_age_s", "age of that figure"),
    *(Published(f"z{j}_um", f"its Zernike term j = {j} (Noll, RMS)") for j in _TERMS),
)
_TEXTS = (
    Published("state", "state of the hold, or `no contact`", is_text=True),
    Published("why", "the one-line reason", is_text=True),
    Published("run", "name of the run", is_text=True),
    Published("fault", "the fault with its cause and remedy; empty without one", is_text=True),
    Published(
        "locks", "the locks: text, author, time and word of each; empty without one", is_text=True
    ),
    Published(
        "interlocks", "the open interlocks with their texts; empty without one", is_text=True
    ),
    Published(
        "notices",
        "all notices: open interlocks, maintenance, recording, link, processes",
        is_text=True,
    ),
    Published("figure_verdict", "verdict on the newest figure", is_text=True),
)
SIGNAL_TABLE = (*_TEXTS, *_TICK, *_FIGURE)


def table_lines(published: Sequence[Published]) -> list[str]:
    """Return published values as the lines of a Markdown table."""
    rows = [
        f"| `{each.name}` | {'text' if each.is_text else each.unit or '1'} | {each.description} |"
        for each in published
    ]
    return ["| name | unit | what |", "|---|---|---|", *rows]


def signal_values(seen: HoldSeen) -> dict[str, Value]:
    """The values of `SIGNAL_TABLE`; None, or `no contact`, instead of old ones."""
    # A hold that does not answer has no values, not its last ones.
    found: dict[str, Value] = {each.name: None for each in SIGNAL_TABLE}
    found["run"] = seen.name
    if seen.silent:
        return {**found, "state": "no contact", "why": seen.silent}
    # What `ctl status` prints, and the newest tick.
    status, row = seen.status, seen.status.get("row") or {}
    found |= {
        "state": str(status.get("state", "")),
        "why": str(status.get("why") or "as it should be"),
        "fault": fault_line(status),
        "locks": "; ".join(lock_lines(status)),
        "interlocks": "; ".join(notice_lines(status, Topic.INTERLOCK)),
        "notices": "; ".join(notice_lines(status)),
    }
    found |= {each.name: row.get(each.name) for each in _TICK}
    # The newest figure with its age, s.
    if seen.figure is not None:
        age_s = (row.get("mono_s") or math.nan) - seen.figure.time_s
        found |= {"figure_verdict": seen.figure.verdict, "figure_age_s": age_s}
        found |= {
            "sag_um": seen.figure.sag_um,
            "sag_change_sigma_um": seen.figure.sag_change_sigma_um,
        }
        found |= {f"z{j}_um": float(seen.figure.coeffs_um[j - 1]) for j in _TERMS}
    return {
        name: None if isinstance(v, float) and not math.isfinite(v) else v
        for name, v in found.items()
    }
