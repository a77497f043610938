"""A display through pygame-ce (SDL): a `Display`.

Source: pygame-ce documentation, `pygame.display`. SDL silently gives another size than the
requested one, so every size is compared. `flip` returns when the picture is queued, not when it is
lit.
"""

import importlib
import os
from typing import Any

import numpy as np

from firmware_iface.optical_roles import Levels
from firmware_iface.roles import DeviceIdentity, DeviceRefusedError, LinkError
from firmware_iface.settings import PygameScreenConfig

MISSING = "pygame-ce is not installed: pip install 'membrane-ctrl[screen]'"


class PygameDisplay:
    """The display, fullscreen, from `open` to `close`. For the main thread of a process only (SDL's
    rule).
    """

    def __init__(self, config: PygameScreenConfig) -> None:
        self._config = config
        self._name = f"screen {config.display}"
        self._pygame: Any = None
        self._window: Any = None

    def open(self) -> DeviceIdentity:
        """Take the display. Raises LinkError (no pygame, no display), DeviceRefusedError (another
        size).
        """
        self.close()
        config = self._config
        self._pygame = pygame = _import_pygame()
        size = (config.width_px, config.height_px)
        try:
            pygame.display.init()
            desktops = pygame.display.get_desktop_sizes()
            if config.display >= len(desktops):
                raise LinkError(
                    f"{self._name}: there are {len(desktops)} displays; see `membrane-ctrl devices`"
                )
            self._must_be("desktop", desktops[config.display], size)
            flags = pygame.FULLSCREEN | pygame.NOFRAME
            self._window = pygame.display.set_mode(size, flags, display=config.display)
            self._must_be("window", pygame.display.get_window_size(), size)
            self._must_be("surface", self._window.get_size(), size)
            pygame.mouse.set_visible(False)
            pygame.display.set_allow_screensaver(False)
        except pygame.error as error:
            self.close()
            raise LinkError(
                f"{self._name}: {error}; is a desktop running, and DISPLAY set to it (usually :0)?"
            ) from None
        except LinkError:
            self.close()
            raise
        return DeviceIdentity(
            f"display {pygame.display.get_driver()}", "", "", f"{size[0]} x {size[1]}"
        )

    def prepare(self, levels: Levels) -> Any:
        """Convert a picture (height, width) to the display's own format."""
        grey = np.ascontiguousarray(np.repeat(levels[:, :, np.newaxis], 3, axis=2))
        size = (self._config.width_px, self._config.height_px)
        return self._pygame.image.frombuffer(grey, size, "RGB").convert(self._window)

    def show(self, picture: Any) -> None:
        """Send a prepared picture to the display. Raises LinkError."""
        pygame = self._pygame
        try:
            pygame.event.pump()  # the desktop greys out a window that answers no events
            self._window.blit(picture, (0, 0))
            pygame.display.flip()
        except pygame.error as error:
            self.close()
            raise LinkError(f"{self._name}: {error}") from None

    def close(self) -> None:
        """Release the display. Never raises."""
        self._window = None
        if self._pygame is not None:
            self._pygame.display.quit()

    def describe(self) -> dict[str, str]:
        """For people."""
        config = self._config
        return {
            "port": f"display {config.display}",
            "settings": f"{config.width_px} x {config.height_px}, {config.pixel_mm:g} mm a pixel",
        }

    def _must_be(self, name: str, found: tuple[int, int], wanted: tuple[int, int]) -> None:
        if tuple(found) != wanted:
            raise DeviceRefusedError(
                f"{self._name}: {name} is {found[0]} x {found[1]}, [devices.screen] states "
                f"{wanted[0]} x {wanted[1]}; set the panel's own resolution without scaling, or "
                "correct the configuration"
            )


def _import_pygame() -> Any:
    """The library, without its greeting and without a GPU. Raises LinkError with the remedy if not
    installed.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    # Straight into the display's memory: a detour over a software GPU takes 30 ms at 1920 x 1080,
    # this 0.5
    os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
    try:
        return importlib.import_module("pygame")
    except ImportError:
        raise LinkError(MISSING) from None
