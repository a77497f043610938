"""One measurement cycle after the other: show, expose, reconstruct; and what to do when that fails.

Synchronous and free of any real clock or device: everything it needs is passed in, so the same code runs over
a camera, over the twin's renderer and over a fake in a test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_iface.roles import Frame, Pattern, Screen
from membrane_ctrl.acquisition.frames import FrameWriter, Pixels
from membrane_ctrl.estimate import ShapeEstimate

Stage = Literal["screen", "camera", "reconstruction"]

# A full cycle may be spoilt by a door or by the mirror still moving: take two more at once. Three in a row mean
# that there is no mirror to be seen (flat, dark, covered), which a pause does not worsen.
REJECTED_IN_A_ROW = 3
FIRST_PAUSE_S = 1.0
LONGEST_PAUSE_S = 60.0  # within a minute of the cause being gone the shape is measured again

TRACKING_LOST = "tracking lost"


class CycleClock(Protocol):
    """The run's clock, and a way to wait on it."""

    def now(self) -> float:
        """Seconds since the run's start."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Return after `duration_s` on this clock."""
        ...


class CycleCamera(Protocol):
    """A camera that can write a frame where it is wanted."""

    def grab(self, out: Pixels | None = None) -> Frame:
        """One exposure, in `out` if the camera is able to. Raises LinkError."""
        ...


class Laser(Protocol):
    """Knows the displacement at a moment of the near past."""

    def at(self, time_s: float) -> float:
        """Displacement in um, NaN if unknown."""
        ...


class Reconstructor(Protocol):
    """From frames to the figure; keeps the last absolute phase between calls."""

    def full(
        self, frames: Sequence[Pixels], time_s: NDArray[np.float64], displacement_um: NDArray[np.float64]
    ) -> ShapeEstimate:
        """Figure from sinusoids, Gray codes, white and black, in the order of the full sequence."""
        ...

    def fringes(
        self, frames: Sequence[Pixels], time_s: NDArray[np.float64], displacement_um: NDArray[np.float64]
    ) -> ShapeEstimate:
        """Figure from the sinusoids alone, tracked against the last absolute phase."""
        ...


@dataclass(frozen=True, slots=True)
class CyclePlan:
    """The patterns of both kinds of cycle in their order, and the least time between two exposures."""

    full: Sequence[Pattern]
    fringes: Sequence[Pattern]
    frame_interval_s: float


@dataclass(frozen=True, slots=True)
class CycleDone:
    """A cycle that gave an estimate (whatever its verdict); wait `pause_s` before the next."""

    estimate: ShapeEstimate
    pause_s: float


@dataclass(frozen=True, slots=True)
class CycleFailed:
    """A cycle that gave none, where and why; wait `pause_s` before the next."""

    cycle: int
    stage: Stage
    message: str
    pause_s: float


class ShapeCycle:
    """Takes cycles: a full one first and whenever the fringe orders are lost, else fringes only.

    Parameters
    ----------
    camera, screen, laser, reconstructor
        What the cycle works with.
    plan : CyclePlan
        What to show and how fast.
    frames : FrameWriter
        Where the pixels go; it must hold a full cycle.
    clock : CycleClock
        The run's clock.
    stopping : callable
        Asked before every exposure: True ends the cycle without a result.
    """

    def __init__(
        self,
        camera: CycleCamera,
        screen: Screen,
        reconstructor: Reconstructor,
        plan: CyclePlan,
        frames: FrameWriter,
        clock: CycleClock,
        laser: Laser,
        stopping: Callable[[], bool] = lambda: False,
    ) -> None:
        self._camera = camera
        self._screen = screen
        self._reconstructor = reconstructor
        self._plan = plan
        self._frames = frames
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
        """One cycle; None if it was stopped on the way. Raises nothing a device or the numerics may raise."""
        self._cycle += 1
        try:
            estimate = self._measure("full" if self._full_next else "fringes")
        except _StageError as error:
            self._failed_in_a_row += 1
            return CycleFailed(self._cycle, error.stage, str(error), pause_s(self._failed_in_a_row))
        if estimate is None:
            return None
        self._failed_in_a_row = 0
        self._judge(estimate)
        return CycleDone(estimate, pause_s(self._full_rejected_in_a_row - REJECTED_IN_A_ROW + 1))

    def _judge(self, estimate: ShapeEstimate) -> None:
        """Decide of which kind the next cycle is."""
        rejected = estimate.verdict == "rejected"
        if estimate.kind == "full":
            self._full_next = rejected
            self._full_rejected_in_a_row = self._full_rejected_in_a_row + 1 if rejected else 0
        elif rejected and estimate.reason.startswith(TRACKING_LOST):
            self._full_next = True

    def _measure(self, kind: Literal["full", "fringes"]) -> ShapeEstimate | None:
        pixels: list[Pixels] = []
        time_s: list[float] = []
        for pattern in self._plan.full if kind == "full" else self._plan.fringes:
            if self._stopping():
                return None
            frame = self._expose(pattern, time_s[-1] if time_s else None)
            pixels.append(frame.pixels)
            time_s.append(frame.time_s)
        arrived_s = self._clock.now()
        # asked again for all: when a frame arrives, the second half of the readings around it is still to come
        displacement_um = np.array([self._laser.at(moment_s) for moment_s in time_s])
        with _during("reconstruction"):
            reconstruct = self._reconstructor.full if kind == "full" else self._reconstructor.fringes
            estimate = reconstruct(pixels, np.array(time_s), displacement_um)
        return replace(estimate, latency_s=self._clock.now() - arrived_s, cycle=self._cycle)

    def _expose(self, pattern: Pattern, last_s: float | None) -> Frame:
        with _during("screen"):
            self._screen.show(pattern)
        if last_s is not None:
            self._clock.sleep(max(0.0, last_s + self._plan.frame_interval_s - self._clock.now()))
        slot = self._frames.begin()
        with _during("camera"):
            frame = self._camera.grab(out=slot.pixels)
            if frame.pixels is not slot.pixels:
                if frame.pixels.shape != slot.pixels.shape or frame.pixels.dtype != slot.pixels.dtype:
                    raise ValueError(_mismatch(frame.pixels, slot.pixels))
                slot.pixels[...] = frame.pixels
        slot.commit(pattern.name, frame.time_s, self._laser.at(frame.time_s), self._cycle)
        return Frame(slot.pixels, frame.time_s)


def pause_s(failures: int) -> float:
    """How long to wait after so many failures in a row: 0, 1, 2, 4, ... 60 s."""
    if failures <= 0:
        return 0.0
    return float(min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** min(failures - 1, 32)))


class _StageError(Exception):
    def __init__(self, stage: Stage, message: str) -> None:
        super().__init__(message)
        self.stage = stage


@contextmanager
def _during(stage: Stage) -> Iterator[None]:
    """Whatever a device or the numerics raise becomes one kind of error that names where it happened."""
    try:
        yield
    except Exception as error:
        raise _StageError(stage, f"{type(error).__name__}: {error}") from error


def _mismatch(got: Pixels, wanted: Pixels) -> str:
    return (
        f"camera gave {got.shape[1]} x {got.shape[0]} {got.dtype}, "
        f"the configuration says {wanted.shape[1]} x {wanted.shape[0]} {wanted.dtype}"
    )
