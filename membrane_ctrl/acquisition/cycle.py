"""One measurement cycle: show, expose, reconstruct.

Synchronous and free of real clocks and devices: everything is an argument, so the same code runs
with a camera, with the twin's renderer and with a fake in a test.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from firmware_iface.optical_roles import Camera, Pixels, Screen
from membrane_ctrl.acquisition import exposures, stage_errors
from membrane_ctrl.acquisition.cycle_plan import CyclePlan
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.durations import pause_s
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.processes.frames import FrameWriter

# A door or a moving mirror may spoil a full cycle: take two more at once. Three failures in a row
# mean that no mirror is visible (flat, dark, covered), which a pause does not worsen.
REJECTED_IN_A_ROW = 3
# What is degraded in three full cycles in a row is so on the bench.
DEGRADED_IN_A_ROW = 3


class Reconstructor(Protocol):
    """Turns frames into the figure; keeps the last absolute phase between calls."""

    def measure_full(
        self, frames: Sequence[Pixels], time_s: FloatArray, displacement_um: FloatArray
    ) -> ShapeEstimate:
        """Measure a full cycle: sinusoids, Gray codes, white and black, in the order of the
        full sequence.

        Parameters
        ----------
        frames : sequence of (height, width) arrays
        time_s, displacement_um : (frames,) arrays
            Of each exposure; NaN where there is no laser reading.
        """

    def measure_fringes(
        self, frames: Sequence[Pixels], time_s: FloatArray, displacement_um: FloatArray
    ) -> ShapeEstimate:
        """Measure a cycle of the frames after a full cycle alone, tracked against the last
        absolute phase.

        Parameters
        ----------
        frames : sequence of (height, width) arrays
        time_s, displacement_um : (frames,) arrays
            Of each exposure; NaN where there is no laser reading.
        """

    def prepare(self) -> None:
        """Precompute for the next figure."""


@dataclass(frozen=True, slots=True)
class CycleDone:
    """A cycle with an estimate, whatever its verdict; wait `pause_s` before the next."""

    estimate: ShapeEstimate
    pause_s: float


@dataclass(frozen=True, slots=True)
class CycleFailed:
    """A cycle without an estimate, where it failed and why; wait `pause_s` before the next."""

    cycle: int
    stage: stage_errors.Stage
    message: str
    pause_s: float


class ShapeCycle:
    """Takes cycles: a full one first and after losing the fringe orders, else fringes only.

    A degraded full cycle is repeated until `DEGRADED_IN_A_ROW` of them agree.

    Parameters
    ----------
    camera, screen : Camera, Screen
        Open.
    reconstructor : Reconstructor
        Makes the figure of the frames.
    plan : CyclePlan
        Patterns of the cycles, and the least interval of their frames.
    frames : FrameWriter
        Ring that holds a full cycle.
    clock : CycleClock
        The run's clock.
    laser : Laser
        The displacement at each frame.
    stopping : callable
        Checked before each exposure: True ends the cycle without a result.
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
        self._full_degraded_in_a_row = 0

    def want_full(self) -> None:
        """Make the next cycle a full one."""
        self._full_next = True

    def run_cycle(self) -> CycleDone | CycleFailed | None:
        """Take one cycle; None if it was stopped. Catches whatever devices and numerics raise."""
        self._cycle += 1
        try:
            estimate = self._measure_shape("full" if self._full_next else "fringes")
        except stage_errors.StageError as error:
            self._failed_in_a_row += 1
            return CycleFailed(self._cycle, error.stage, str(error), pause_s(self._failed_in_a_row))
        if estimate is None:
            return None
        self._failed_in_a_row = 0
        self._choose_next_kind(estimate)
        return CycleDone(estimate, pause_s(self._full_rejected_in_a_row - REJECTED_IN_A_ROW + 1))

    def prepare_next(self) -> None:
        """Precompute for the next figure, between cycles; a failure is reported by that cycle."""
        with suppress(stage_errors.StageError), stage_errors.convert_stage_errors("reconstruction"):
            self._reconstructor.prepare()

    def _choose_next_kind(self, estimate: ShapeEstimate) -> None:
        """Decide the kind of the next cycle."""
        rejected = estimate.verdict == "rejected"
        if estimate.kind == "full":
            # One spoiled full cycle, as by a person who passes, would degrade all that follow it
            degraded = estimate.verdict == "degraded"
            self._full_degraded_in_a_row = self._full_degraded_in_a_row + 1 if degraded else 0
            repeated = degraded and self._full_degraded_in_a_row < DEGRADED_IN_A_ROW
            self._full_next = rejected or repeated
            self._full_rejected_in_a_row = self._full_rejected_in_a_row + 1 if rejected else 0
        elif estimate.tracking_lost:
            self._full_next = True

    def _measure_shape(self, kind: Literal["full", "fringes"]) -> ShapeEstimate | None:
        patterns = self._plan.list_patterns(kind == "full")
        frames = self._exposures.expose_patterns(patterns, self._cycle, self._stopping)
        if frames is None:
            return None
        arrived_s = self._clock.now()
        # asked again for all frames: when a frame arrives, half of the readings around it are still
        # to come
        displacement_um = np.array([self._laser.at(frame.time_s) for frame in frames])
        time_s = np.array([frame.time_s for frame in frames])
        pixels = [frame.pixels for frame in frames]
        with stage_errors.convert_stage_errors("reconstruction"):
            if kind == "full":
                estimate = self._reconstructor.measure_full(pixels, time_s, displacement_um)
            else:
                estimate = self._reconstructor.measure_fringes(pixels, time_s, displacement_um)
        return replace(
            estimate, latency_s=round(self._clock.now() - arrived_s, 5), cycle=self._cycle
        )
