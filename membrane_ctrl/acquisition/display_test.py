"""Measures a display with the camera that sees it."""

from collections.abc import Iterator

import numpy as np

from firmware_iface import (
    checkerboard_check,
    display_patterns,
    display_response,
    display_settling,
    exposure_check,
    optical_roles,
)
from firmware_iface.pattern_screen import PatternScreen
from membrane_ctrl.acquisition.exposures import CycleClock

LONG_S = 0.5  # longer than any suitable display takes to settle
# A step of the light is followed frame after frame for this long, several times in each direction:
# refresh and exposure are not synchronised.
_FOLLOWED_S = 0.35
_TIMES = 3
# Steps of the settling test: black to white, and between two greys, where panels are slowest.
_STEPS = ((0, 255), (64, 160))
_THINNING = 4  # every fourth pixel, which has the same colour on a Bayer sensor
_LIT = 0.5  # of the brightest pixels' swing, from which on a pixel shows the screen
_BRIGHTEST_QUANTILE = 0.99


class DisplayTest:
    """Measures a display with the camera that sees it, both open.

    It waits `settle_s` before a still picture; `measure_settling` shortens that.

    Parameters
    ----------
    screen, camera : PatternScreen, Camera
        Open.
    clock : CycleClock
        By which it waits.
    width_px, height_px : int
        Size of the screen.
    """

    def __init__(
        self,
        screen: PatternScreen,
        camera: optical_roles.Camera,
        clock: CycleClock,
        width_px: int,
        height_px: int,
    ) -> None:
        self._screen = screen
        self._camera = camera
        self._clock = clock
        self._size = (height_px, width_px)
        self.settle_s = LONG_S

    def check_exposure(self, full_scale_adu: int, exposure_ms: float) -> str:
        """Find what is wrong with the camera's exposure.

        Parameters
        ----------
        full_scale_adu : int
            Count of a saturated pixel.
        exposure_ms : float
            For the message.

        Returns
        -------
        str
            The problem, for people; empty without one.
        """
        white = self._expose_still(self._make_grey(255))
        black = self._expose_still(self._make_grey(0))
        return exposure_check.explain_exposure(white, black, full_scale_adu, exposure_ms)

    def check_checkerboard(self) -> str:
        """The problem with pixel-for-pixel display; empty without one."""
        white = self._expose_still(self._make_grey(255))
        black = self._expose_still(self._make_grey(0))
        height_px, width_px = self._size
        checkerboard = display_patterns.make_checkerboard(width_px, height_px)
        shown = self._expose_still(checkerboard)
        return checkerboard_check.explain_checkerboard(shown, white, black)

    def measure_settling(self) -> display_settling.Settling:
        """Measure the time from a command to the light, over steps both ways.

        Raises ValueError if the display never settles.
        """
        delays_s: list[float] = []
        shares_left: list[float] = []
        noise = 0.0
        for one, other in _STEPS:
            # Both levels at rest, and the noise between two pictures of one.
            pictures = {
                level: _thin_pixels(self._expose_still(self._make_grey(level)))
                for level in (one, other)
            }
            repeated = _thin_pixels(self._expose_still(self._make_grey(one)))
            difference = display_settling.share_left(repeated, pictures[other], pictures[one])
            noise = max(noise, difference)

            # The share of the former level after each step; evaluated once its frames are taken.
            for before, after in ((one, other), (other, one)) * _TIMES:
                self._expose_still(self._make_grey(before))
                frames = list(self._expose_series(self._make_grey(after)))
                for delay_s, pixels in frames:
                    share = display_settling.share_left(pixels, pictures[before], pictures[after])
                    delays_s.append(delay_s)
                    shares_left.append(share)
        found = display_settling.fit_settling(delays_s, shares_left, noise)
        self.settle_s = found.settle_s
        return found

    def measure_response(self) -> display_response.DisplayResponse:
        """Measure the light of each level. Raises ValueError if the camera sees no ramp."""
        levels = display_response.RAMP_LEVELS
        frames = [self._expose_still(self._make_grey(level)) for level in levels]
        swing = frames[-1].astype(np.float64) - frames[0]
        is_lit = swing > _LIT * np.quantile(swing, _BRIGHTEST_QUANTILE)
        light = [float(np.mean(frame[is_lit])) for frame in frames]
        return display_response.make_measured_response(levels, light)

    def _expose_still(self, levels: optical_roles.Levels) -> optical_roles.Pixels:
        """Take a picture of levels that have settled."""
        self._screen.show_levels(levels)
        self._clock.sleep(self.settle_s)
        return self._camera.grab().pixels

    def _expose_series(
        self, levels: optical_roles.Levels
    ) -> Iterator[tuple[float, optical_roles.Pixels]]:
        """Take frames one after the other, each with the time from the command to its exposure."""
        self._screen.show_levels(levels)
        begun_s = self._clock.now()
        while self._clock.now() - begun_s < _FOLLOWED_S:
            frame = self._camera.grab()
            yield frame.time_s - begun_s, _thin_pixels(frame.pixels)

    def _make_grey(self, level: int) -> optical_roles.Levels:
        """A screen of one level."""
        return np.full(self._size, level, np.uint8)


def _thin_pixels(pixels: optical_roles.Pixels) -> optical_roles.Pixels:
    """Some of the pixels, enough for means over blocks."""
    return pixels[::_THINNING, ::_THINNING].copy()
