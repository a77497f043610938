"""Takes a cycle at each deadline, publishes the estimates and reports failures."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Protocol

from membrane_ctrl.acquisition import exposures
from membrane_ctrl.acquisition.cycle import CycleDone, CycleFailed, ShapeCycle
from membrane_ctrl.acquisition.remote import CaptureRequest, Remote
from membrane_ctrl.model import acquisition_events, shape_estimate


class KeepSet(Protocol):
    """Writes the frames of a cycle as the requested set."""

    def __call__(self, estimate: shape_estimate.ShapeEstimate, request: CaptureRequest) -> Path:
        """The set's folder. Raises OSError with the reason."""
        ...


def keep_cycling(
    taking: ShapeCycle,
    remote: Remote,
    publish: Callable[[shape_estimate.ShapeEstimate], None],
    clock: exposures.CycleClock,
    period_s: Callable[[], float],
    keep: KeepSet,
) -> None:
    """Take cycles until stopped.

    Parameters
    ----------
    taking : ShapeCycle
        Takes one cycle; it must end early when `remote.interrupts()`.
    remote : Remote
        The other end of the process: stop, requests, reports.
    publish : callable
        Gets every estimate, whatever its verdict.
    clock : CycleClock
    period_s : callable
        The period at present; a longer cycle skips the deadlines it covers.
    keep : callable
        Writes the frames of a cycle and returns the set's folder, or raises OSError with the
        reason.
    """
    due_s = clock.now()
    while not remote.stop:
        # Paused: wait for a command, and begin a new period after it.
        if remote.paused:
            remote.report_state("paused", "until the command to resume")
            while remote.paused and not remote.stop:
                remote.take_commands(math.inf)
            due_s = clock.now()
            continue

        # Wait for the deadline; a command may arrive meanwhile.
        remaining_s = due_s - clock.now()
        if remaining_s > 0:
            remote.take_commands(remaining_s)
            continue

        # One cycle. A capture that was asked for is a full one.
        capture = remote.take_capture()
        if remote.take_full() or capture is not None:
            taking.want_full()
        result = taking.run_cycle()
        _report_result(result, remote, publish)
        if capture is not None:
            remote.send_event(_capture_event(result, partial(keep, request=capture)))

        # The next deadline on the grid of the period; those that have passed are skipped.
        pause_s = 0.0
        if result is not None:
            pause_s = result.pause_s
        due_s = next_deadline_s(due_s, period_s(), clock.now() + pause_s)
        taking.prepare_next()


def next_deadline_s(last_s: float, period_s: float, earliest_s: float) -> float:
    """The first of `last_s + k period_s`, k >= 1, that is not too early.

    Parameters
    ----------
    last_s : float
        The last deadline.
    period_s : float
    earliest_s : float
        The result is not before it.
    """
    return last_s + max(1, math.ceil((earliest_s - last_s) / period_s)) * period_s


def _capture_event(
    result: CycleDone | CycleFailed | None, keep: Callable[[shape_estimate.ShapeEstimate], Path]
) -> acquisition_events.Capture:
    """Result of a requested set; a rejected one is not kept."""
    match result:
        case None:
            return acquisition_events.Capture(failed="the cycle was stopped")
        case CycleFailed(number, stage, message, _):
            return acquisition_events.Capture(number, failed=f"{stage}: {message}")
    estimate = result.estimate
    if estimate.verdict == "rejected":
        return acquisition_events.Capture(estimate.cycle, failed=f"rejected: {estimate.reason}")
    try:
        folder = keep(estimate)
    except OSError as error:
        return acquisition_events.Capture(estimate.cycle, failed=error.strerror or str(error))
    moved_um = None
    if math.isfinite(estimate.displacement_um):
        moved_um = estimate.displacement_um
    name = f"{folder.parent.name}/{folder.name}"
    return acquisition_events.Capture(
        estimate.cycle, name, moved_um, estimate.verdict, estimate.reason
    )


def _report_result(
    result: CycleDone | CycleFailed | None,
    remote: Remote,
    publish: Callable[[shape_estimate.ShapeEstimate], None],
) -> None:
    match result:
        case CycleDone(estimate, pause_s):
            publish(estimate)
            later = ""
            if pause_s:
                later = f"; next in {pause_s:g} s"
            verdict = (
                f"{estimate.verdict}: {estimate.reason}{later}"
                if estimate.reason
                else estimate.verdict
            )
            remote.report_state("running", verdict, cycle=estimate.cycle)
        case CycleFailed(number, stage, message, pause_s):
            remote.report_state(
                "retrying", f"{stage}: {message}; again in {pause_s:g} s", cycle=number
            )
