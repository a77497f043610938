"""A display through pygame-ce (SDL): role Screen.

Source: pygame-ce documentation, `pygame.display`. Patterns are rendered once, when the screen is opened. SDL silently
gives another size than the requested one, so every size is compared.

`flip` returns when the picture is queued, not when it is lit: `show` waits for the settle time, which
`firmware_iface.display` measures.
"""

import importlib
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_iface.display import DisplayResponse, ScreenRaster, linear_response, pattern_light
from firmware_iface.roles import Clock, DeviceIdentity, DeviceRefusedError, Levels, LinkError, Pattern

MISSING = "pygame-ce is not installed: pip install 'membrane-ctrl[screen]'"


@dataclass(frozen=True, slots=True)
class ScreenSettings:
    """Which display, and how it is used."""

    raster: ScreenRaster  # its pixels and the pattern region
    patterns: Sequence[Pattern]  # what will be shown
    display: int = 0  # from 0
    settle_s: float = 0.3  # from the command to the light; until measured

    @property
    def name(self) -> str:
        """For messages."""
        return f"screen {self.display}"


class PygameScreen:
    """The display, fullscreen, from `open` to `close`. For the main thread of a process only (SDL's rule).

    `response` makes the patterns' light linear; `show` waits `settle_s`, which may be set.
    """

    def __init__(
        self,
        settings: ScreenSettings,
        response: DisplayResponse | None = None,
        now: Clock = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._settings = settings
        self._now, self._sleep = now, sleep
        self._pygame: Any = None
        self._window: Any = None
        self._surfaces: dict[Pattern, Any] = {}
        self._shown_s = 0.0
        self.settle_s = settings.settle_s
        self.response = response or linear_response()

    def open(self) -> DeviceIdentity:
        """Take the display and render the patterns.

        Raises LinkError (no pygame, no display), DeviceRefusedError (a display of another size).
        """
        self.close()
        settings, raster = self._settings, self._settings.raster
        self._pygame = pygame = _pygame()
        size = (raster.width_px, raster.height_px)
        try:
            pygame.display.init()
            desktops = pygame.display.get_desktop_sizes()
            if settings.display >= len(desktops):
                raise LinkError(f"{settings.name}: there are {len(desktops)} displays; see `membrane-ctrl devices`")
            self._must_be("desktop", desktops[settings.display], size)
            flags = pygame.FULLSCREEN | pygame.NOFRAME
            self._window = pygame.display.set_mode(size, flags, display=settings.display)
            self._must_be("window", pygame.display.get_window_size(), size)
            self._must_be("surface", self._window.get_size(), size)
            pygame.mouse.set_visible(False)
            pygame.display.set_allow_screensaver(False)
            self.linearise(self.response)
        except pygame.error as error:
            self.close()
            raise LinkError(
                f"{settings.name}: {error}; is a desktop running, and DISPLAY set to it (usually :0)?"
            ) from None
        except LinkError:
            self.close()
            raise
        return DeviceIdentity(f"display {pygame.display.get_driver()}", "", "", f"{size[0]} x {size[1]}")

    def linearise(self, response: DisplayResponse) -> None:
        """Render all patterns for a display with this response."""
        self.response = response
        self._surfaces = {
            pattern: self._surface(response.levels_of(pattern_light(pattern, self._settings.raster)))
            for pattern in self._settings.patterns
        }

    def show(self, pattern: Pattern) -> None:
        """Show the pattern; returns when it is lit and settled. Raises LinkError."""
        self.begin(pattern)
        self.wait()

    def begin(self, pattern: Pattern) -> None:
        """Send the pattern to the display; it is lit after `wait`. Raises LinkError."""
        if pattern not in self._surfaces:
            if self._window is None:
                self.open()
            if pattern not in self._surfaces:
                raise LinkError(f"{self._settings.name}: pattern {pattern.name!r} was not prepared")
        self._flip(self._surfaces[pattern])

    def wait(self) -> None:
        """Return when the pattern is displayed and settled."""
        self._sleep(max(0.0, self._shown_s + self.settle_s - self._now()))

    def show_levels(self, levels: Levels) -> None:
        """Send an image (height, width), level for level, for tests of the display; not waited for."""
        if self._window is None:
            self.open()
        self._flip(self._surface(levels))

    def close(self) -> None:
        """Release the display. Never raises."""
        self._surfaces = {}
        self._window = None
        if self._pygame is not None:
            self._pygame.display.quit()

    def describe(self) -> dict[str, str]:
        """For people."""
        raster = self._settings.raster
        return {
            "port": f"display {self._settings.display}",
            "settings": f"{raster.width_px} x {raster.height_px}, {raster.pixel_mm:g} mm a pixel, "
            f"settle {1000 * self.settle_s:.0f} ms",
        }

    def _flip(self, surface: Any) -> None:
        pygame = self._pygame
        try:
            pygame.event.pump()  # the desktop greys out a window that answers no events
            self._window.blit(surface, (0, 0))
            pygame.display.flip()
        except pygame.error as error:
            self.close()
            raise LinkError(f"{self._settings.name}: {error}") from None
        self._shown_s = self._now()

    def _surface(self, levels: Levels) -> Any:
        raster = self._settings.raster
        if levels.shape != (raster.height_px, raster.width_px):
            raise ValueError(f"image is {levels.shape}, the screen {(raster.height_px, raster.width_px)}")
        grey = np.ascontiguousarray(np.repeat(levels[:, :, np.newaxis], 3, axis=2))
        size = (raster.width_px, raster.height_px)
        return self._pygame.image.frombuffer(grey, size, "RGB").convert(self._window)

    def _must_be(self, name: str, found: tuple[int, int], wanted: tuple[int, int]) -> None:
        if tuple(found) != wanted:
            raise DeviceRefusedError(
                f"{self._settings.name}: {name} is {found[0]} x {found[1]}, [devices.screen] says {wanted[0]} x "
                f"{wanted[1]}; set the panel's own resolution without scaling, or correct the configuration"
            )


def _pygame() -> Any:
    """The library, without its greeting and without a GPU. Raises LinkError with the remedy if not installed."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    # Straight into the display's memory: a detour over a software GPU takes 30 ms at 1920 x 1080, this 0.5
    os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
    try:
        return importlib.import_module("pygame")
    except ImportError:
        raise LinkError(MISSING) from None
