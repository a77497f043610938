"""The loop of the acquisition process: a cycle at each deadline, its estimate to the ring, its troubles reported."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from membrane_ctrl.acquisition.cycle import CycleClock, CycleDone, CycleFailed, ShapeCycle
from membrane_ctrl.acquisition.remote import Remote
from membrane_ctrl.estimate import ShapeEstimate, pack_estimate
from membrane_ctrl.tick import Event


def keep_cycling(
    cycle: ShapeCycle,
    remote: Remote,
    publish: Callable[[ShapeEstimate], None],
    clock: CycleClock,
    period_s: float,
    keep: Callable[[ShapeEstimate], Path],
) -> None:
    """Take cycles until told to stop.

    Parameters
    ----------
    cycle : ShapeCycle
        Must end early when `remote.interrupts()`.
    remote : Remote
        Commands and reports.
    publish : callable
        Gets every estimate, whatever its verdict.
    clock : CycleClock
        The run's clock.
    period_s : float
        From deadline to deadline. A cycle that takes longer costs the deadlines it covers; they are not made up.
    keep : callable
        Writes the frames of a cycle and returns the set's folder; OSError says why not.
    """
    due_s = clock.now()
    while not remote.stop:
        if remote.paused:
            remote.report("paused", "until told to resume")
            while remote.paused and not remote.stop:
                remote.listen(math.inf)
            due_s = clock.now()
            continue
        remaining_s = due_s - clock.now()
        if remaining_s > 0:
            remote.listen(remaining_s)
            continue
        captures = remote.take_capture()
        if remote.take_full() or captures:
            cycle.want_full()
        result = cycle.take()
        _tell(result, remote, publish)
        if captures:
            remote.tell(_captured(result, keep))
        pause_s = result.pause_s if result is not None else 0.0
        due_s = next_deadline_s(due_s, period_s, clock.now() + pause_s)


def next_deadline_s(last_s: float, period_s: float, earliest_s: float) -> float:
    """The first moment of `last_s + k period_s`, k >= 1, that is not before `earliest_s`."""
    return last_s + max(1, math.ceil((earliest_s - last_s) / period_s)) * period_s


def estimate_message(estimate: ShapeEstimate) -> bytes:
    """An estimate as it crosses in the ring of shapes, its covariance in the 24 bits of a single.

    A variance known to 1e-7 is known better than its noise model, and what the controller is given has to be
    recorded to the last bit: in doubles that would be 0.2 GB a day.
    """
    covariance_um2 = estimate.covariance_um2.astype(np.float32).astype(np.float64)
    return pack_estimate(replace(estimate, covariance_um2=covariance_um2))


def _captured(result: CycleDone | CycleFailed | None, keep: Callable[[ShapeEstimate], Path]) -> Event:
    """What became of a set that was asked for; a rejected one is not worth its room on the disk."""
    match result:
        case None:
            return {"kind": "capture", "failed": "the cycle was stopped"}
        case CycleFailed(number, stage, message, _):
            return {"kind": "capture", "cycle": number, "failed": f"{stage}: {message}"}
    estimate = result.estimate
    if estimate.verdict == "rejected":
        return {"kind": "capture", "cycle": estimate.cycle, "failed": f"rejected: {estimate.reason}"}
    try:
        folder = keep(estimate)
    except OSError as error:
        return {"kind": "capture", "cycle": estimate.cycle, "failed": error.strerror or str(error)}
    told: Event = {"kind": "capture", "cycle": estimate.cycle, "set": f"{folder.parent.name}/{folder.name}"}
    moved_um = {"displacement_um": estimate.displacement_um} if math.isfinite(estimate.displacement_um) else {}
    return {**told, **moved_um, "verdict": estimate.verdict, "reason": estimate.reason}


def _tell(result: CycleDone | CycleFailed | None, remote: Remote, publish: Callable[[ShapeEstimate], None]) -> None:
    match result:
        case CycleDone(estimate, pause_s):
            publish(estimate)
            later = f"; next in {pause_s:g} s" if pause_s else ""
            verdict = f"{estimate.verdict}: {estimate.reason}{later}" if estimate.reason else estimate.verdict
            remote.report("running", verdict, cycle=estimate.cycle)
        case CycleFailed(number, stage, message, pause_s):
            remote.report("retrying", f"{stage}: {message}; again in {pause_s:g} s", cycle=number)
