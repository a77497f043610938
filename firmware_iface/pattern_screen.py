"""A screen: shows patterns on any display, corrected for its response, and waits until they are
settled.

Patterns are rendered once, when the screen is opened. A display returns when a picture is queued,
not when it is lit: `wait` lasts for the settle time, which `display_settling.py` measures.
"""

from collections.abc import Sequence
from typing import Any

from firmware_iface.display_patterns import ScreenRaster, compute_pattern_light
from firmware_iface.display_response import DisplayResponse, make_linear_response
from firmware_iface.driver_calls import call_driver, close_driver
from firmware_iface.optical_roles import Display, DriverClock, Levels, Pattern
from firmware_iface.roles import DeviceIdentity, LinkError

SETTLE_S = 0.3  # until it is measured


class PatternScreen:
    """The role Screen on a display, from `open` to `close`.

    Whatever the display's driver raises becomes a LinkError, and the display is opened again by the
    next picture.

    Parameters
    ----------
    display : Display
        The driver.
    raster : ScreenRaster
        Where the display's pixels are on the pattern, mm.
    patterns : sequence of Pattern
        Prepared at `open`, so that none is computed between two frames.
    clock : DriverClock
        Of the wait for the display to settle.
    name : str
        Begins the messages.

    Attributes
    ----------
    settle_s : float
        How long `wait` lasts from the command on; may be set, for example as measured.
    response : DisplayResponse
        By which the levels are chosen so that the patterns' light is linear.
    """

    def __init__(
        self,
        display: Display,
        raster: ScreenRaster,
        patterns: Sequence[Pattern],
        clock: DriverClock,
        name: str,
    ) -> None:
        self.settle_s = SETTLE_S
        self.response = make_linear_response()
        self._display = display
        self._raster = raster
        self._patterns = patterns
        self._clock = clock
        self._name = name
        self._opened = False
        self._prepared: dict[Pattern, Any] = {}
        self._shown_s = 0.0

    def open(self) -> DeviceIdentity:
        """Take the display and prepare the patterns. Raises LinkError."""
        self.close()
        identity: DeviceIdentity = self._call_display("open", returns=DeviceIdentity)
        self._opened = True
        self.linearise(self.response)
        return identity

    def linearise(self, response: DisplayResponse) -> None:
        """Prepare all patterns for a display with this response. Raises LinkError."""
        self.response = response
        self._prepared = {
            pattern: self._call_display(
                "prepare", response.find_levels(compute_pattern_light(pattern, self._raster))
            )
            for pattern in self._patterns
        }

    def show(self, pattern: Pattern) -> None:
        """Show the pattern; returns when it is lit and settled. Raises LinkError."""
        self.begin(pattern)
        self.wait()

    def begin(self, pattern: Pattern) -> None:
        """Send the pattern to the display; it is lit after `wait`. Raises LinkError."""
        if not self._opened:
            self.open()
        if pattern not in self._prepared:
            raise LinkError(f"{self._name}: pattern {pattern.name!r} was not prepared")
        self._send_picture(self._prepared[pattern])

    def wait(self) -> None:
        """Return when the pattern is displayed and settled."""
        self._clock.sleep(max(0.0, self._shown_s + self.settle_s - self._clock.now()))

    def show_levels(self, levels: Levels) -> None:
        """Send an image (height, width), level for level, for tests of the display;
        not waited for.
        """
        shape = self._raster.height_px, self._raster.width_px
        if levels.shape != shape:
            raise ValueError(f"image is {levels.shape}, the screen {shape}")
        if not self._opened:
            self.open()
        self._send_picture(self._call_display("prepare", levels))

    def close(self) -> None:
        """Release the display. Never raises."""
        self._prepared = {}
        self._opened = False
        close_driver(self._display)

    def describe(self) -> dict[str, str]:
        """For people: what the display states, and the settle time."""
        found: dict[str, str] = call_driver(self._name, self._display, "describe", returns=dict)
        return {"port": self._name, **found, "settle": f"{1000 * self.settle_s:.0f} ms"}

    def _send_picture(self, picture: Any) -> None:
        self._call_display("show", picture)
        self._shown_s = self._clock.now()

    def _call_display(self, method: str, *arguments: Any, returns: type[Any] = object) -> Any:
        try:
            return call_driver(self._name, self._display, method, *arguments, returns=returns)
        except LinkError:
            self.close()
            raise
