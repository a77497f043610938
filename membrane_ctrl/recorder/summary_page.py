"""The page of a recording with the figures of the run so far."""

import math
from collections.abc import Mapping
from datetime import timedelta
from typing import Any

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.prose import for_people
from membrane_ctrl.model.run_status import RunStatus, gains_words

SUMMARY_PATH = "/summary"
# Each page is 0.7 kB. In the first minutes somebody is watching.
SUMMARY_INTERVAL_S = 60.0
SUMMARY_EARLY_INTERVAL_S = 10.0
SUMMARY_EARLY_S = 300.0


def summary_page(summary: Mapping[str, Any], status: RunStatus, config: Config) -> str:
    """The figures of the run so far as a page of the recording.

    Parameters
    ----------
    summary : mapping
        The content of `summary.json` so far, or when read back: with None for NaN.
    status : RunStatus
        What follows from the events so far.
    config : Config
        Of the run.
    """
    held = summary["held"]
    states = summary["states"]
    of = "true centre" if held["of"] == "true" else "reading"
    # Rows without anything to say are left out.
    last_fault = ""
    if summary["faults"]:
        last_fault = str(summary["faults"][-1].get("name", ""))
    time_in_faults = ""
    if held["faults_s"]:
        share = held["faults_s"] / max(summary["duration_s"], 1e-9)
        time_in_faults = f"{_format_span(held['faults_s'])} ({_format_share(share)})"
    paused = ""
    if held["paused_s"] >= 1.0:
        paused = _format_span(held["paused_s"])
    cycles = ""
    if summary["cycles"]:
        cycles = f"{summary['cycles']}, {summary['cycles_rejected']} rejected"
    trial_left_s = status.trial_ends_s - summary["duration_s"]
    rows = {
        "held": _format_span(held["held_s"]),
        f"std of 1 s means, {of}": _format_um(held["std_um"]),
        "mean error": _format_um(held["mean_um"], "+"),
        f"1 s means within ±{config.limits.band_um:g} µm": _format_share(held["in_band"]),
        "faults": str(summary["fault_count"] or "none"),
        "last fault": last_fault,
        "time in faults": time_in_faults,
        "paused": paused,
        "leak": _format_um(summary["leak_um_per_s"], unit="µm/s"),
        "shape cycles": cycles,
        "geometry": _format_geometry(summary["geometry"]),
        "gains": gains_words(status.loop or vars(config.loop), trial_left_s),
        "ticks missed": f"{summary['missed_ticks']} of {summary['ticks']}",
        "not recorded": "; ".join(status.recording_problems),
    }
    state = states[-1]["state"] if states else "not started"
    lines = [f"| {name} | {_format_cell(words)} |" for name, words in rows.items() if words]
    return "\n".join((f"| {state} | {_format_cell(status.why)} |", "|---|---|", *lines)) + "\n"


def _format_geometry(geometry: Mapping[str, Any]) -> str:
    words = [str(geometry[key]) for key in ("hash", "file") if geometry.get(key)]
    calibrated = geometry.get("calibrated_utc")
    if calibrated:
        words.append(f"calibrated {calibrated}")
    return ", ".join(words)


def _format_um(value: float | None, sign: str = "", unit: str = "µm") -> str:
    if value is not None and math.isfinite(value):
        return f"{value:{sign}.3g} {unit}"
    return ""


def _format_share(value: float | None) -> str:
    if value is not None and math.isfinite(value):
        return f"{100 * value:.4g} %"
    return ""


def _format_span(seconds: float) -> str:
    """As `0:09:12`."""
    return str(timedelta(seconds=round(seconds)))


def _format_cell(words: str) -> str:
    return for_people(words).replace("|", "/")
