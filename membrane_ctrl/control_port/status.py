"""The status of a hold as the port answers it; `status_lines` makes the lines of displays."""

import math
from dataclasses import asdict
from typing import Any

from membrane_ctrl.model import telemetry
from membrane_ctrl.model.notices import Notice
from membrane_ctrl.model.run_status import RunStatus


def status_table(status: RunStatus) -> dict[str, Any]:
    """The status for people and programs: names instead of codes, None for missing values."""
    # JSON has neither NaN nor infinity: a missing value is None, here and in the row
    row = status.row
    if row is None:
        return {"state": "starting", "why": "no tick has run yet"}
    locks = [
        {**asdict(lock), "problem": status.unstored.get(lock.word, "")} for lock in status.locks
    ]
    fault = None
    if status.fault:
        fault = {key: getattr(status.fault, key) for key in ("code", "name", "cause", "remedy")}
    held = None
    if status.held:
        held = {key: getattr(status.held, key) for key in ("holds", "state", "reason")}
    trial_left_s = None
    if math.isfinite(status.trial_left_s):
        trial_left_s = round(status.trial_left_s, 1)
    columns = {key: value if math.isfinite(value) else None for key, value in asdict(row).items()}
    return {
        "state": telemetry.State(int(row.state)).name.lower(),
        "state_age_s": round(row.mono_s - status.since_s, 3),
        "why": status.why,
        "paused": status.paused,
        "locks": locks,
        "latched": status.latched,
        "fault": fault,
        "notices": [_notice_table(notice) for notice in status.other_notices],
        "recording_ok": not status.recording_problems,
        "safe_level": telemetry.SafeLevel(int(row.safe_level)).name.lower(),
        "shape": telemetry.ShapeState(int(row.shape_state)).name.lower(),
        "shape_reason": status.shape_reason,
        "held": held,
        "trial_left_s": trial_left_s,
        "geometry": asdict(status.geometry) if status.geometry else None,
        "row": columns,
    }


def _notice_table(notice: Notice) -> dict[str, str]:
    return {
        "topic": notice.key.topic.value,
        "subject": notice.key.subject,
        "severity": notice.severity,
        "text": notice.short_text,
    }
