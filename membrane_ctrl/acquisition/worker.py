"""The loop of the acquisition process: takes a cycle at each deadline, publishes estimates, reports failures."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from membrane_ctrl.acquisition import cycle, exposures, process
from membrane_ctrl.geometry.file import InForce
from membrane_ctrl.metrology import bins, phase
from membrane_ctrl.metrology.calibrate.drift import DriftMonitor, RingMonitor, noise_urad
from membrane_ctrl.metrology.optics.geometry import Geometry
from membrane_ctrl.metrology.optics.surface import Surface
from membrane_ctrl.model import events, run_events, shape_estimate


def keep_cycling(
    taking: cycle.ShapeCycle,
    remote: process.Remote,
    publish: Callable[[shape_estimate.ShapeEstimate], None],
    clock: exposures.CycleClock,
    period_s: Callable[[], float],
    keep: Callable[[shape_estimate.ShapeEstimate], Path],
) -> None:
    """Take cycles until stopped.

    A cycle must end early when `remote.interrupts()`; one longer than `period_s()` skips the deadlines it covers.
    `publish` gets every estimate, whatever its verdict. `keep` writes the frames of a cycle and returns the set's
    folder, or raises OSError with the reason.
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
            taking.want_full()
        result = taking.take()
        _tell(result, remote, publish)
        if captures:
            remote.tell(_captured(result, keep))
        pause_s = result.pause_s if result is not None else 0.0
        due_s = next_deadline_s(due_s, period_s(), clock.now() + pause_s)


def next_deadline_s(last_s: float, period_s: float, earliest_s: float) -> float:
    """The first of `last_s + k period_s`, k >= 1, that is not before `earliest_s`."""
    return last_s + max(1, math.ceil((earliest_s - last_s) / period_s)) * period_s


def _captured(
    result: cycle.CycleDone | cycle.CycleFailed | None, keep: Callable[[shape_estimate.ShapeEstimate], Path]
) -> run_events.Capture:
    """Result of a requested set; a rejected one is not kept."""
    match result:
        case None:
            return run_events.Capture(failed="the cycle was stopped")
        case cycle.CycleFailed(number, stage, message, _):
            return run_events.Capture(number, failed=f"{stage}: {message}")
    estimate = result.estimate
    if estimate.verdict == "rejected":
        return run_events.Capture(estimate.cycle, failed=f"rejected: {estimate.reason}")
    try:
        folder = keep(estimate)
    except OSError as error:
        return run_events.Capture(estimate.cycle, failed=error.strerror or str(error))
    moved_um = estimate.displacement_um if math.isfinite(estimate.displacement_um) else None
    name = f"{folder.parent.name}/{folder.name}"
    return run_events.Capture(estimate.cycle, name, moved_um, estimate.verdict, estimate.reason)


def _tell(
    result: cycle.CycleDone | cycle.CycleFailed | None,
    remote: process.Remote,
    publish: Callable[[shape_estimate.ShapeEstimate], None],
) -> None:
    match result:
        case cycle.CycleDone(estimate, pause_s):
            publish(estimate)
            later = f"; next in {pause_s:g} s" if pause_s else ""
            verdict = f"{estimate.verdict}: {estimate.reason}{later}" if estimate.reason else estimate.verdict
            remote.report("running", verdict, cycle=estimate.cycle)
        case cycle.CycleFailed(number, stage, message, pause_s):
            remote.report("retrying", f"{stage}: {message}; again in {pause_s:g} s", cycle=number)


# The geometry of live cycles: its origin, and whether it still fits the cycles.


def geometry_event(geometry: InForce) -> run_events.GeometryInForce:
    """The event that records the geometry."""
    origin = geometry.origin
    return run_events.GeometryInForce(origin.hash, origin.file or None, origin.calibrated_utc or None, geometry.note)


class LiveDrift:
    """Compares residual and ring of each cycle with the calibrated ones; silent without a calibration."""

    def __init__(self, geometry: InForce, bin_px: int) -> None:
        optics = geometry.optics
        self._geometry, self._radius_mm = Geometry.from_config(optics), optics.mirror.radius_mm
        shifts = phase.equal_shifts(optics.pattern.steps)
        sigma_rad = phase.phase_sigma_rad(shifts, bins.pixel_sigma_adu(optics.camera.noise_adu), 1.0)
        self._sigma_mm_adu = phase.mm_per_rad(optics.pattern) * sigma_rad / bin_px  # over the modulation
        known = geometry.calibration
        self._monitors: tuple[DriftMonitor, RingMonitor] | None = None
        if known is not None:
            residual = DriftMonitor(known.slope_residual_urad, known.slope_noise_urad)
            self._monitors = residual, RingMonitor(np.array(known.ring_um))
        self._said = False

    def noise_urad(self, estimate: shape_estimate.ShapeEstimate) -> float:
        """The camera noise's share of a cycle's residual."""
        return noise_urad(
            self._geometry, self._surface(estimate), self._sigma_mm_adu / estimate.modulation_median_adu
        )

    def after(self, estimate: shape_estimate.ShapeEstimate) -> events.Event | None:
        """Returns a notice when a new calibration becomes due, and when no longer."""
        if self._monitors is None or estimate.verdict == "rejected" or estimate.kind == "track":
            return None
        residual, ring = self._monitors
        residual.add(estimate.slope_residual_urad, self.noise_urad(estimate))
        ring.add(self._surface(estimate))
        says = ring.says or residual.says
        if bool(says) == self._said:
            return None
        self._said = not self._said
        news = events.Maintenance if self._said else events.MaintenanceOver
        return news("calibrate", says or "the geometry fits again")

    def _surface(self, estimate: shape_estimate.ShapeEstimate) -> Surface:
        return Surface(estimate.coeffs_um / 1e3, estimate.hencky_um / 1e3, self._radius_mm)
