"""The pump's flow over weeks, from the runs of one bench.

Each run measures it by its probe (`pump.probe_um`).
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control import pump_curve
from membrane_ctrl.model import events
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.run_files import event_log, run_config, run_lookup, summary_file
from membrane_ctrl.run_files.event_log import LoggedEvent
from membrane_ctrl.run_files.run import origin_of

_LOOKED_BACK = 400  # runs
_CERTAIN_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class PumpSeen:
    """What a run had learned of the pump at its end."""

    run: str
    started_utc: datetime
    scale: float  # flow at half the full flow, relative to the curve of the newest run
    sigma: float
    leak_um_per_s: float  # with any offset of the curve; NaN without a summary
    same_curve: bool  # as the newest run's


def explain_pump_change(history: Sequence[PumpSeen], change_max: float) -> str:
    """Describe how the pump has changed since the first run that has the newest run's curve.

    Parameters
    ----------
    history : sequence of PumpSeen
        Oldest first, as `pump_history` returns them.
    change_max : float
        `pump.change_max`, the share of the flow up to which a change is normal.

    Returns
    -------
    str
        A sentence, if the change exceeds `change_max` and 3 sigma of the two runs; else empty.
    """
    if not history:
        return ""
    newest = history[-1]
    first = next(seen for seen in history if seen.same_curve)
    change = newest.scale / first.scale - 1
    sigma = math.hypot(newest.sigma, first.sigma) / first.scale
    if abs(change) <= max(change_max, _CERTAIN_SIGMAS * sigma):
        return ""
    side = "less" if change < 0 else "more"
    return (
        f"the pump gives {100 * abs(change):.0f} % {side} than in {first.run} "
        f"(+- {100 * sigma:.0f} %): check it, then `tune pump`"
    )


def pump_history(newest: Path) -> list[PumpSeen]:
    """The pump in a run and in earlier ones of its folder with the same devices, oldest first.

    Runs that have learned nothing are omitted.
    """
    # From the newest run back; the first that is found is what the others are compared with.
    devices = run_config.read_config(newest, []).devices
    latest: PumpConfig | None = None
    found: list[PumpSeen] = []
    folders = [folder for folder in sorted(newest.parent.iterdir()) if folder.name <= newest.name]
    for folder in reversed(folders[-_LOOKED_BACK:]):
        with contextlib.suppress(OSError):
            if folder.name.startswith(".") or not run_lookup.is_run(folder):
                continue
            log = event_log.read_events(folder, [])
            config = run_config.read_config(folder, [])
            last = _last_learned(log)
            if last is None or config.devices != devices:
                continue
            learned, gains = last
            pump = config.with_gains(gains).pump
            latest = latest or pump
            seen = _compare_pump(folder, log, learned, pump, latest)
            if seen.scale > 0 and seen.sigma > 0:
                found.append(seen)
    return found[::-1]


def _compare_pump(
    folder: Path,
    log: Sequence[LoggedEvent],
    learned: events.PumpLearned,
    pump: PumpConfig,
    latest: PumpConfig,
) -> PumpSeen:
    """What a run has learned, with its scale relative to the curve of the newest run."""
    # The flow by the run's own curve at the command that gives half of the newest curve's flow
    half_um_per_s = 0.5 * latest.flow_full_um_per_s
    fraction = pump_curve.PumpCurve(latest).fraction(half_um_per_s)
    share = pump_curve.PumpCurve(pump).flow(fraction) / half_um_per_s
    summary = summary_file.read_summary(folder, []) or {}
    watched = {"probe_um", "change_max"}
    return PumpSeen(
        run=folder.name,
        started_utc=origin_of(folder, log),
        scale=share * _to_finite(learned.scale),
        sigma=share * _to_finite(learned.sigma),
        leak_um_per_s=_to_finite(summary.get("leak_um_per_s")),
        same_curve=pump.model_dump(exclude=watched) == latest.model_dump(exclude=watched),
    )


def _last_learned(log: Sequence[LoggedEvent]) -> tuple[events.PumpLearned, dict[str, Any]] | None:
    """The last event on a run's pump, and the gains and curve then set."""
    status = RunStatus()
    last = None
    for each in log:
        status = status.after_event(each.event, each.mono_s)
        if isinstance(each.event, events.PumpLearned):
            last = each.event, dict(status.loop or {})
    return last


def _to_finite(value: object) -> float:
    if not isinstance(value, int | float):
        return math.nan
    return float(value)
