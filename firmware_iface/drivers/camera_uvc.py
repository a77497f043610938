"""USB cameras without GenICam (UVC) through OpenCV's VideoCapture: role Camera.

Source: OpenCV 4 documentation, `cv::VideoCapture` and `VideoCaptureProperties`. Such a camera runs freely and keeps
frames in a queue; a frame belongs to a pattern only if its exposure started after the pattern appeared, so earlier
frames are read and discarded.
"""

import time
from collections.abc import Callable
from typing import Any, Protocol

import cv2
import numpy as np

from firmware_iface import roles, settings

# One in the driver's queue, although its length is set to one, and one whose exposure has started
_STALE_FRAMES = 2
_EXPOSURE_MANUAL = 1.0  # V4L2's number; 3 is automatic


class VideoCapture(Protocol):
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
        """Release the camera."""


class UvcCamera:
    """The camera; opened by the first exposure, and again by the next one after it went away.

    A sensor of another size is refused; `now` is the run's clock, `capture` makes the capture from the port.
    """

    def __init__(
        self,
        config: settings.UvcCameraConfig,
        width_px: int,
        height_px: int,
        now: roles.Clock = time.monotonic,
        capture: Callable[[int | str], VideoCapture] = cv2.VideoCapture,  # type: ignore[assignment]  # the stubs differ
    ) -> None:
        self._config, self._size, self._now, self._make = config, (width_px, height_px), now, capture
        self._capture: VideoCapture | None = None

    def open(self) -> roles.DeviceIdentity:
        """Connect and set. Raises LinkDownError without a camera, DeviceRefusedError for another size or exposure."""
        self.close()
        config = self._config
        self._capture = capture = self._make(int(config.port) if config.port.isdigit() else config.port)
        if not capture.isOpened():
            self.close()
            raise roles.LinkDownError(
                f"camera {config.port}: cannot be opened; is it plugged in, used by another program, "
                "and are you in the group video?"
            )
        wanted = [
            ("width_px", cv2.CAP_PROP_FRAME_WIDTH, float(self._size[0])),
            ("height_px", cv2.CAP_PROP_FRAME_HEIGHT, float(self._size[1])),
        ]
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1.0)
        if config.exposure:
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _EXPOSURE_MANUAL)
            wanted.append(("exposure", cv2.CAP_PROP_EXPOSURE, config.exposure))
        if config.gain:
            wanted.append(("gain", cv2.CAP_PROP_GAIN, config.gain))
        for name, prop, value in wanted:
            capture.set(prop, value)
            if (found := capture.get(prop)) != value:
                self.close()
                raise roles.DeviceRefusedError(
                    f"camera {config.port}: {name} = {found:g} after {value:g} was written"
                )
        return roles.DeviceIdentity("UVC camera", "", "", self.describe()["settings"])

    def grab(self, out: roles.Levels | None = None) -> roles.Frame:
        """The next complete frame that starts after the call, as grey (the green channel of a colour camera).

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
                raise roles.LinkDownError(f"camera {self._config.port}: no frame; unplugged?")
        pixels: roles.Levels = np.asarray(image)
        if pixels.ndim == 3:
            pixels = pixels[:, :, 1]
        if out is None:
            return roles.Frame(pixels.copy(), time_s)
        if out.shape != pixels.shape:
            raise roles.DeviceRefusedError(f"camera {self._config.port}: sent {pixels.shape}, expected {out.shape}")
        np.copyto(out, pixels)
        return roles.Frame(out, time_s)

    def close(self) -> None:
        """Release the camera. Never raises."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def describe(self) -> dict[str, str]:
        """For people."""
        config = self._config
        return {
            "port": config.port,
            "settings": f"{self._size[0]} x {self._size[1]}, exposure {config.exposure:g}, gain {config.gain:g}",
        }
