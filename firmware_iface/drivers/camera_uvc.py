"""USB cameras without GenICam (UVC) through OpenCV's VideoCapture: role Camera.

Source: OpenCV 4 documentation, `cv::VideoCapture` and `VideoCaptureProperties`. Such a camera runs freely and keeps
frames in a queue; a frame belongs to a pattern only if it was begun after the pattern was lit, so that everything
which may have been begun before is read and thrown away.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from firmware_iface.roles import DeviceIdentity, DeviceRefusedError, Frame, LinkDownError

# One in the driver's queue although one was asked for, and one whose exposure had begun
_STALE_FRAMES = 2
_EXPOSURE_MANUAL = 1.0  # V4L2's number; 3 is automatic


class Capture(Protocol):
    """The part of cv2.VideoCapture that is used."""

    def isOpened(self) -> bool:  # noqa: N802 (OpenCV's name)
        """There is a camera."""

    def read(self) -> tuple[bool, Any]:
        """Whether there was a frame, and the frame."""

    def set(self, prop: int, value: float) -> bool:
        """Whether the property is known to the camera."""

    def get(self, prop: int) -> float:
        """A property."""

    def release(self) -> None:
        """Give the camera back."""


@dataclass(frozen=True, slots=True)
class UvcSettings:
    """How to set the camera."""

    port: str = "0"  # its number, or its path such as /dev/video0 (better: below /dev/v4l/by-id)
    width_px: int = 1920
    height_px: int = 1080
    exposure: float = 0.0  # in the camera's own unit, often 0.1 ms; 0 leaves it as it is
    gain: float = 0.0  # in the camera's own unit; 0 leaves it as it is


class UvcCamera:
    """The camera; opened by the first exposure, and again by the next one after it went away.

    Parameters
    ----------
    now : callable
        The run's clock.
    capture : callable
        Makes the capture from the port.
    """

    def __init__(
        self,
        settings: UvcSettings,
        now: Callable[[], float] = time.monotonic,
        capture: Callable[[int | str], Capture] = cv2.VideoCapture,  # type: ignore[assignment]  # stubs name differently
    ) -> None:
        self._settings, self._now, self._make = settings, now, capture
        self._capture: Capture | None = None

    def open(self) -> DeviceIdentity:
        """Connect and set. Raises LinkDownError without a camera, DeviceRefusedError for another size or exposure."""
        self.close()
        settings = self._settings
        self._capture = capture = self._make(int(settings.port) if settings.port.isdigit() else settings.port)
        if not capture.isOpened():
            self.close()
            raise LinkDownError(
                f"camera {settings.port}: cannot be opened; is it plugged in, used by another program, "
                "and are you in the group video?"
            )
        wanted = [
            ("width_px", cv2.CAP_PROP_FRAME_WIDTH, float(settings.width_px)),
            ("height_px", cv2.CAP_PROP_FRAME_HEIGHT, float(settings.height_px)),
        ]
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1.0)
        if settings.exposure:
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _EXPOSURE_MANUAL)
            wanted.append(("exposure", cv2.CAP_PROP_EXPOSURE, settings.exposure))
        if settings.gain:
            wanted.append(("gain", cv2.CAP_PROP_GAIN, settings.gain))
        for name, prop, value in wanted:
            capture.set(prop, value)
            if (found := capture.get(prop)) != value:
                self.close()
                raise DeviceRefusedError(f"camera {settings.port}: {name} = {found:g} after {value:g} was written")
        return DeviceIdentity("UVC camera", "", "", self.describe()["settings"])

    def grab(self, out: NDArray[np.uint8] | None = None) -> Frame:
        """The next whole frame that was begun after the call, as grey (the green channel of a colour camera).

        Raises LinkDownError (the camera went away).
        """
        if self._capture is None:
            self.open()
        assert self._capture is not None
        image, time_s = None, self._now()
        for _ in range(_STALE_FRAMES + 1):
            time_s = self._now()
            good, image = self._capture.read()
            if not good:
                self.close()
                raise LinkDownError(f"camera {self._settings.port}: no frame; unplugged?")
        pixels: NDArray[np.uint8] = np.asarray(image)
        if pixels.ndim == 3:
            pixels = pixels[:, :, 1]
        if out is None:
            return Frame(pixels.copy(), time_s)
        if out.shape != pixels.shape:
            raise DeviceRefusedError(f"camera {self._settings.port}: sent {pixels.shape}, wanted is {out.shape}")
        np.copyto(out, pixels)
        return Frame(out, time_s)

    def close(self) -> None:
        """Give the camera back. Never raises."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def describe(self) -> dict[str, str]:
        """For people."""
        settings = self._settings
        return {
            "port": settings.port,
            "settings": f"{settings.width_px} x {settings.height_px}, "
            f"exposure {settings.exposure:g}, gain {settings.gain:g}",
        }
