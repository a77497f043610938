"""Before the first cycle: exposure, checkerboard, settle time and response of the display, seen by the camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_iface.display.checkerboard import checkerboard_problem
from firmware_iface.display.exposure import exposure_problem
from firmware_iface.display.gamma import RAMP_LEVELS, DisplayResponse, measured_response
from firmware_iface.display.pattern_image import checkerboard
from firmware_iface.display.settle import Settling, settling, share_left
from firmware_iface.roles import Frame
from membrane_ctrl.acquisition.exposures import CycleClock

Levels = NDArray[np.uint8]
Frames = NDArray[np.uint8] | NDArray[np.uint16]

# Longer than any display takes that is fit for this
LONG_S = 0.5
# One frame after the other for this long, three times for each direction: refresh and exposure are not in step
_FOLLOWED_S = 0.35
_TIMES = 3


class TestCamera(Protocol):
    """What is needed of the camera."""

    def grab(self) -> Frame:
        """One exposure. Raises LinkError."""
        ...


class TestScreen(Protocol):
    """What is needed of the screen."""

    def show_levels(self, levels: Levels) -> None:
        """Send an image to the display, level for level; not waited for. Raises LinkError."""
        ...


class DisplayTest:
    """Measures a display through the camera that looks at it.

    Parameters
    ----------
    screen, camera
        Open.
    clock : CycleClock
        The run's clock.
    width_px, height_px : int
        Of the screen.
    settle_s : float
        Wait before a still picture; `settling` lowers it.
    """

    def __init__(
        self, screen: TestScreen, camera: TestCamera, clock: CycleClock, width_px: int, height_px: int
    ) -> None:
        self._screen, self._camera, self._clock = screen, camera, clock
        self._size = (height_px, width_px)
        self.settle_s = LONG_S

    def exposure(self, full_scale_adu: int, exposure_ms: float) -> str:
        """What is wrong with the camera's exposure; empty when nothing is."""
        white, black = self._still(self._grey(255)), self._still(self._grey(0))
        return exposure_problem(white, black, full_scale_adu, exposure_ms)

    def checkerboard(self) -> str:
        """Whether the screen shows pixel for pixel; empty when it does."""
        white, black = self._still(self._grey(255)), self._still(self._grey(0))
        return checkerboard_problem(self._still(checkerboard(self._size[1], self._size[0])), white, black)

    def settling(self) -> Settling:
        """Time from a command to the light, over steps both ways between black, white and two greys.

        The greys are there because panels are slowest between them.

        Raises
        ------
        ValueError
            If the display never settles.
        """
        delays_s: list[float] = []
        left: list[float] = []
        noise = 0.0
        for one, other in ((0, 255), (64, 160)):
            pictures = {level: _thin(self._still(self._grey(level))) for level in (one, other)}
            again = _thin(self._still(self._grey(one)))
            noise = max(noise, share_left(again, pictures[other], pictures[one]))
            for before, after in ((one, other), (other, one)) * _TIMES:
                self._still(self._grey(before))
                for delay_s, pixels in list(self._follow(self._grey(after))):  # looked at afterwards
                    delays_s.append(delay_s)
                    left.append(share_left(pixels, pictures[before], pictures[after]))
        found = settling(delays_s, left, noise)
        self.settle_s = found.settle_s
        return found

    def response(self) -> DisplayResponse:
        """Light against level. Raises ValueError if the camera sees no ramp."""
        frames = [self._still(self._grey(level)) for level in RAMP_LEVELS]
        swing = frames[-1].astype(np.float64) - frames[0]
        lit = swing > 0.5 * np.quantile(swing, 0.99)
        return measured_response(RAMP_LEVELS, [float(np.mean(frame[lit])) for frame in frames])

    def _still(self, levels: Levels) -> Frames:
        self._screen.show_levels(levels)
        self._clock.sleep(self.settle_s)
        return self._camera.grab().pixels

    def _follow(self, levels: Levels) -> Iterator[tuple[float, Frames]]:
        """Frames one after the other, each with the time from the command to the start of its exposure."""
        self._screen.show_levels(levels)
        begun_s = self._clock.now()
        while self._clock.now() - begun_s < _FOLLOWED_S:
            frame = self._camera.grab()
            yield frame.time_s - begun_s, _thin(frame.pixels)

    def _grey(self, level: int) -> Levels:
        return np.full(self._size, level, np.uint8)


def _thin(pixels: Frames) -> Frames:
    """Every fourth pixel both ways (of a Bayer sensor always the same colour): enough for means over blocks."""
    return pixels[::4, ::4].copy()


def told(name: str, measure: Callable[[], str]) -> str:
    """A finding with the name of what it is about; empty for none. A measurement that failed is a finding."""
    try:
        problem = measure()
    except ValueError as error:
        problem = str(error)
    return f"{name}: {problem}" if problem else ""
