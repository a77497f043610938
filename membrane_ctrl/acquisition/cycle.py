"""Measurement cycles, one after the other: show, expose, reconstruct, and recover from failures.

Synchronous and free of real clocks and devices: everything is an argument, so the same code runs
with a camera, with the twin's renderer and with a fake in a test. `keep_cycling` takes a cycle at
each deadline, publishes the estimates and reports the failures.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from firmware_iface.roles import Camera, Pattern, Pixels, Screen
from membrane_ctrl.acquisition import exposures, process
from membrane_ctrl.geometry.file import InForce
from membrane_ctrl.metrology.cycle.geometry_monitors import DriftMonitor, RingMonitor, noise_urad
from membrane_ctrl.metrology.phase import phase_steps, screen_scale
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction import slope_noise
from membrane_ctrl.model import events, run_events, shape_estimate
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.clock import pause_s
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import TelemetryRow
from membrane_ctrl.processes.frames import FrameWriter
from membrane_ctrl.processes.ring import RingAddress, RingReader

# A door or a moving mirror may spoil a full cycle: take two more at once. Three failures in a row
# mean that no mirror is visible (flat, dark, covered), which a pause does not worsen.
REJECTED_IN_A_ROW = 3


class Reconstructor(Protocol):
    """Turns frames into the figure; keeps the last absolute phase between calls."""

    def full(
        self, frames: Sequence[Pixels], time_s: FloatArray, displacement_um: FloatArray
    ) -> ShapeEstimate:
        """Figure from sinusoids, Gray codes, white and black, in the order of the full sequence."""

    def fringes(
        self, frames: Sequence[Pixels], time_s: FloatArray, displacement_um: FloatArray
    ) -> ShapeEstimate:
        """Figure from the frames after a full cycle alone,
        tracked against the last absolute phase.
        """

    def prepare(self) -> None:
        """Do ahead what the next figure needs."""


@dataclass(frozen=True, slots=True)
class CyclePlan:
    """The patterns of both kinds of cycle, in order, and the least time between exposures.

    `standing` gives the crossed pattern of the moment where one frame of it takes the place of
    `fringes`.
    """

    full: Sequence[Pattern]
    fringes: Sequence[Pattern]
    frame_interval_s: float
    standing: Callable[[], Pattern] | None = None

    def patterns(self, full: bool) -> Sequence[Pattern]:
        """Of the next cycle."""
        if full:
            return self.full
        return self.fringes if self.standing is None else [self.standing()]


@dataclass(frozen=True, slots=True)
class CycleDone:
    """A cycle with an estimate, whatever its verdict; wait `pause_s` before the next."""

    estimate: ShapeEstimate
    pause_s: float


@dataclass(frozen=True, slots=True)
class CycleFailed:
    """A cycle without an estimate, where it failed and why; wait `pause_s` before the next."""

    cycle: int
    stage: exposures.Stage
    message: str
    pause_s: float


class ShapeCycle:
    """Takes cycles: a full one first and after losing the fringe orders, else fringes only.

    `frames` must hold a full cycle. `stopping` is checked before each exposure: True ends the cycle
    without a result.
    """

    def __init__(
        self,
        camera: Camera,
        screen: Screen,
        reconstructor: Reconstructor,
        plan: CyclePlan,
        frames: FrameWriter,
        clock: exposures.CycleClock,
        laser: exposures.Laser,
        stopping: Callable[[], bool] = lambda: False,
    ) -> None:
        self._exposures = exposures.Exposures(
            camera, screen, frames, clock, laser, plan.frame_interval_s
        )
        self._reconstructor = reconstructor
        self._plan = plan
        self._clock = clock
        self._laser = laser
        self._stopping = stopping
        self._full_next = True
        self._cycle = 0
        self._failed_in_a_row = 0
        self._full_rejected_in_a_row = 0

    def want_full(self) -> None:
        """Make the next cycle a full one."""
        self._full_next = True

    def take(self) -> CycleDone | CycleFailed | None:
        """Take one cycle; None if it was stopped. Catches whatever devices and numerics raise."""
        self._cycle += 1
        try:
            estimate = self._measure("full" if self._full_next else "fringes")
        except exposures.StageError as error:
            self._failed_in_a_row += 1
            return CycleFailed(self._cycle, error.stage, str(error), pause_s(self._failed_in_a_row))
        if estimate is None:
            return None
        self._failed_in_a_row = 0
        self._judge(estimate)
        return CycleDone(estimate, pause_s(self._full_rejected_in_a_row - REJECTED_IN_A_ROW + 1))

    def prepare(self) -> None:
        """Do ahead what the next figure needs: not while it is waited for. That cycle tells of a
        failure.
        """
        with suppress(exposures.StageError), exposures.during("reconstruction"):
            self._reconstructor.prepare()

    def _judge(self, estimate: ShapeEstimate) -> None:
        """Decide the kind of the next cycle."""
        rejected = estimate.verdict == "rejected"
        if estimate.kind == "full":
            self._full_next = rejected
            self._full_rejected_in_a_row = self._full_rejected_in_a_row + 1 if rejected else 0
        elif estimate.tracking_lost:
            self._full_next = True

    def _measure(self, kind: Literal["full", "fringes"]) -> ShapeEstimate | None:
        patterns = self._plan.patterns(kind == "full")
        frames = self._exposures.take(patterns, self._cycle, self._stopping)
        if frames is None:
            return None
        arrived_s = self._clock.now()
        # asked again for all frames: when a frame arrives, half of the readings around it are still
        # to come
        displacement_um = np.array([self._laser.at(frame.time_s) for frame in frames])
        time_s = np.array([frame.time_s for frame in frames])
        with exposures.during("reconstruction"):
            reconstruct = (
                self._reconstructor.full if kind == "full" else self._reconstructor.fringes
            )
            estimate = reconstruct([frame.pixels for frame in frames], time_s, displacement_um)
        return replace(
            estimate, latency_s=round(self._clock.now() - arrived_s, 5), cycle=self._cycle
        )


# One reading has 1 µm of noise, ten times the held centre's motion between frames: a frame gets the
# mean of the readings around it. 0.2 s to each side are 20 readings at 50 Hz (0.22 µm), symmetric
# in time so that a steady motion cancels; in these 0.4 s the held centre moves less than the
# remaining noise.
HALF_WINDOW_S = 0.2
HALF_WINDOW_TICKS = 2.0  # below 10 Hz there would be too few readings for a mean
LEAST_READINGS = 3
_KEPT_S = 60.0  # longer than any full cycle takes


class LaserHistory:
    """The last minute of laser readings, from `TelemetryRow` rows at `rate_hz`.

    A frame gets the readings within `half_window_s` before and after it.
    """

    def __init__(self, telemetry: RingAddress, rate_hz: float) -> None:
        self._reader = RingReader(telemetry)
        self.half_window_s = max(HALF_WINDOW_S, HALF_WINDOW_TICKS / rate_hz)
        self._readings: deque[tuple[float, float]] = deque()  # (mono_s, displacement_um)
        self._counter = math.nan

    def at(self, time_s: float) -> float:
        """Mean reading (µm) within `half_window_s` of a time on the run's clock.

        NaN with fewer than `LEAST_READINGS` good ones; missing, flagged and repeated samples do not
        count.
        """
        self._update()
        near = [
            reading
            for mono_s, reading in self._readings
            if abs(mono_s - time_s) <= self.half_window_s
        ]
        return math.fsum(near) / len(near) if len(near) >= LEAST_READINGS else math.nan

    def close(self) -> None:
        """Detach from the telemetry."""
        self._reader.close()

    def _update(self) -> None:
        for message in self._reader.drain():
            row = TelemetryRow.unpack(message)
            repeated = row.sample_counter == self._counter
            self._counter = row.sample_counter
            if (
                math.isfinite(row.displacement_um)
                and row.displacement_quality == 0
                and not repeated
            ):
                self._readings.append((row.mono_s, row.displacement_um))
        while self._readings and self._readings[0][0] < self._readings[-1][0] - _KEPT_S:
            self._readings.popleft()


def keep_cycling(
    taking: ShapeCycle,
    remote: process.Remote,
    publish: Callable[[shape_estimate.ShapeEstimate], None],
    clock: exposures.CycleClock,
    period_s: Callable[[], float],
    keep: Callable[[shape_estimate.ShapeEstimate], Path],
) -> None:
    """Take cycles until stopped.

    A cycle must end early when `remote.interrupts()`; one longer than `period_s()` skips the
    deadlines it covers. `publish` gets every estimate, whatever its verdict. `keep` writes the
    frames of a cycle and returns the set's folder, or raises OSError with the reason.
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
        taking.prepare()


def next_deadline_s(last_s: float, period_s: float, earliest_s: float) -> float:
    """The first of `last_s + k period_s`, k >= 1, that is not before `earliest_s`."""
    return last_s + max(1, math.ceil((earliest_s - last_s) / period_s)) * period_s


def _captured(
    result: CycleDone | CycleFailed | None, keep: Callable[[shape_estimate.ShapeEstimate], Path]
) -> run_events.Capture:
    """Result of a requested set; a rejected one is not kept."""
    match result:
        case None:
            return run_events.Capture(failed="the cycle was stopped")
        case CycleFailed(number, stage, message, _):
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
    result: CycleDone | CycleFailed | None,
    remote: process.Remote,
    publish: Callable[[shape_estimate.ShapeEstimate], None],
) -> None:
    match result:
        case CycleDone(estimate, pause_s):
            publish(estimate)
            later = f"; next in {pause_s:g} s" if pause_s else ""
            verdict = (
                f"{estimate.verdict}: {estimate.reason}{later}"
                if estimate.reason
                else estimate.verdict
            )
            remote.report("running", verdict, cycle=estimate.cycle)
        case CycleFailed(number, stage, message, pause_s):
            remote.report("retrying", f"{stage}: {message}; again in {pause_s:g} s", cycle=number)


def geometry_event(geometry: InForce) -> run_events.GeometryInForce:
    """The event that records the geometry."""
    origin = geometry.origin
    return run_events.GeometryInForce(
        origin.hash, origin.file or None, origin.calibrated_utc or None, geometry.note
    )


class LiveDrift:
    """Compares residual and ring of each cycle with the calibrated ones; silent without a
    calibration.
    """

    def __init__(self, geometry: InForce, bin_px: int) -> None:
        optics = geometry.optics
        self._geometry, self._radius_mm = Geometry.from_config(optics), optics.mirror.radius_mm
        shifts = phase_steps.equal_shifts(optics.pattern.steps)
        sigma_rad = phase_steps.phase_sigma_rad(
            shifts, slope_noise.pixel_sigma_adu(optics.camera.noise_adu), 1.0
        )
        self._sigma_mm_adu = (
            screen_scale.mm_per_rad(optics.pattern) * sigma_rad / bin_px
        )  # over the modulation
        known = geometry.calibration
        self._monitors: tuple[DriftMonitor, RingMonitor] | None = None
        if known is not None:
            residual = DriftMonitor(known.slope_residual_urad, known.slope_noise_urad)
            self._monitors = residual, RingMonitor(np.array(known.ring_um))
        self._said = False

    def noise_urad(self, estimate: shape_estimate.ShapeEstimate) -> float:
        """The camera noise's share of a cycle's residual."""
        return noise_urad(
            self._geometry,
            self._surface(estimate),
            self._sigma_mm_adu / estimate.modulation_median_adu,
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
