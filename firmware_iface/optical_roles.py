"""The interface to cameras and displays: their roles, and the values exchanged.

Their drivers run in the acquisition process, which waits for them: nothing there is awaited.
`roles` has the instruments of the tick.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from firmware_iface.roles import Clock, DeviceIdentity, LinkError

# One lost packet destroys a frame; three in a row are not an accident
TRIES = 3
Levels = NDArray[np.uint8]  # of a display, or an 8-bit camera
Pixels = Levels | NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Pattern:
    """One image on the screen: role "sin" (index k of N, shift_rad), "gray" (bit from 1), "white"
    or "black".

    `period_mm` is that of further sinusoids, which are coarser than the pattern's own (0).
    "crossed" shows sinusoids of x and y at once, `index` periods of each, with `shift_rad` and
    `shift_y_rad`.
    """

    role: str
    axis: str = ""
    index: int = 0
    shift_rad: float = 0.0
    period_mm: float = 0.0
    shift_y_rad: float = 0.0

    @property
    def name(self) -> str:
        """The name used for files and Rerun paths: `x_sin_0`, `y_gray_1`, `white`,
        `x_sin_0_of_61.7mm`.
        """
        coarser = f"_of_{self.period_mm:g}mm" if self.period_mm else ""
        if not self.axis:
            return self.role
        return f"{self.axis}_{self.role}_{self.index}{coarser}"


@dataclass(frozen=True, slots=True)
class Frame:
    """One exposure: `pixels` (height, width) uint8 or uint16, `time_s` the start of exposure on the
    run's clock.
    """

    pixels: Pixels
    time_s: float


class Screen(Protocol):
    """Shows patterns."""

    def show(self, pattern: Pattern) -> None:
        """Show the pattern; returns when it is displayed and settled."""

    def close(self) -> None:
        """Release the screen."""


@runtime_checkable
class Camera(Protocol):
    """Takes frames."""

    def grab(self, out: Pixels | None = None) -> Frame:
        """Trigger one exposure and return it, in `out` if the camera supports that. Raises
        LinkError.
        """

    def close(self) -> None:
        """Release the camera."""


class FrameLostError(LinkError):
    """An exposure gave no complete frame; the camera is present and may try again."""


@runtime_checkable
class ExposingCamera(Protocol):
    """A camera whose transfer may overlap with the next pattern."""

    def expose(self, out: Pixels | None = None) -> None:
        """Trigger, and return when the exposure is over. Raises LinkError."""

    def fetch(self) -> Frame:
        """The frame of the last `expose`. Raises FrameLostError, LinkError."""


@dataclass(frozen=True, slots=True)
class SensorFormat:
    """Picture of a camera as configured in `[optics.camera]`; a driver refuses a sensor that gives
    another one.
    """

    width_px: int
    height_px: int
    bits: int = 8

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of `Frame.pixels`: (height, width)."""
        return self.height_px, self.width_px

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a pixel: uint8 for 8 bits, uint16 for more."""
        return np.dtype(np.uint8 if self.bits == 8 else np.uint16)


@dataclass(frozen=True, slots=True)
class DriverClock:
    """The run's clock and a way to wait on it, which a driver uses instead of `time`."""

    now: Clock = time.monotonic
    sleep: Callable[[float], None] = time.sleep


class OpticalDevice(Protocol):
    """A camera or a display. A camera is a `Camera` or, if its transfer may overlap, an
    `ExposingCamera` as well.
    """

    def open(self) -> DeviceIdentity:
        """Connect, check the identity, apply the settings and read them back; again after every
        lost link.

        Raises LinkError (no valid answer; LinkDownError without a connection), DeviceRefusedError
        (not the configured device, or one that does not accept its settings).
        """

    def close(self) -> None:
        """Release it; also while it is closed. Never raises."""

    def describe(self) -> dict[str, str]:
        """For people: port, settings, manual."""


class Display(OpticalDevice, Protocol):
    """A panel or projector that shows pictures pixel by pixel, without scaling or correction."""

    def prepare(self, levels: Levels) -> Any:
        """Convert a picture (height, width) to the form that `show` takes; called once for each
        pattern.
        """

    def show(self, picture: Any) -> None:
        """Send a prepared picture to the display; returns once it is queued. Raises LinkError."""
