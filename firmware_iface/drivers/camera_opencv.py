"""Cameras through OpenCV: role Camera.

USB cameras without GenICam (UVC) by its VideoCapture. Source: OpenCV 4 documentation,
`cv::VideoCapture` and `VideoCaptureProperties`. Such a camera runs freely and keeps frames in a
queue; a frame belongs to a pattern only if its exposure started after the pattern appeared, so
earlier frames are read and discarded.

A folder of pictures: one file per exposure, in order of name, repeated endlessly. For trying the
cycle without a camera, with pictures of a bench or from `membrane-ctrl simulate`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from firmware_iface import optical_roles, roles, settings

# One in the driver's queue, although its length is set to one, and one whose exposure has started
_STALE_FRAMES = 2
_REAL_TIME = optical_roles.DriverClock()
_EXPOSURE_MANUAL = 1.0  # V4L2's number; 3 is automatic
_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".pgm")


class VideoCapture(Protocol):
    """The part of cv2.VideoCapture that is used."""

    def isOpened(self) -> bool:  # noqa: N802
        """There is a camera."""

    def read(self) -> tuple[bool, Any]:
        """Whether there was a frame, and the frame."""

    def set(self, prop: int, value: float) -> bool:
        """Set a property.

        Parameters
        ----------
        prop : int
            One of OpenCV's `CAP_PROP_...`.
        value : float
            In the driver's unit, which for exposures differs between systems.

        Returns
        -------
        bool
            Whether the camera knows the property; not whether it took the value: read it back.
        """

    def get(self, prop: int) -> float:
        """A property."""

    def release(self) -> None:
        """Release the camera."""


class UvcCamera:
    """The camera; opened by the first exposure, and again by the next one after it went away.

    Parameters
    ----------
    config : UvcCameraConfig
        Port (a number, or a path such as `/dev/video0`), exposure and gain.
    sensor : SensorFormat
        Size of the sensor in `[optics.camera]`; a camera of another size is refused.
    clock : DriverClock
        Of the frames' times; the run's clock in a hold.
    capture : callable
        Makes the capture from the port.
    """

    def __init__(
        self,
        config: settings.UvcCameraConfig,
        sensor: optical_roles.SensorFormat,
        clock: optical_roles.DriverClock = _REAL_TIME,
        capture: Callable[[int | str], VideoCapture] = cv2.VideoCapture,  # type: ignore[assignment]  # the stubs differ
    ) -> None:
        self._config = config
        self._size = (sensor.width_px, sensor.height_px)
        self._now = clock.now
        self._make = capture
        self._capture: VideoCapture | None = None

    def open(self) -> roles.DeviceIdentity:
        """Connect and set. Raises LinkDownError without a camera, DeviceRefusedError for another
        size or exposure.
        """
        self.close()
        config = self._config
        self._capture = capture = self._make(
            int(config.port) if config.port.isdigit() else config.port
        )
        if not capture.isOpened():
            self.close()
            raise roles.LinkDownError(
                f"camera {config.port}: cannot be opened; is it plugged in, used by another "
                "program, and are you in the group video?"
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

    def grab(self, out: optical_roles.Levels | None = None) -> optical_roles.Frame:
        """The next complete frame that starts after the call, as grey (the green channel of a
        colour camera).

        Raises LinkDownError (the camera went away).
        """
        if self._capture is None:
            self.open()
        assert self._capture is not None
        # The camera runs freely: frames whose exposure may have begun before this call are read and
        # dropped. The last one begins after the frame before it was delivered.
        image, time_s = None, self._now()
        for _ in range(_STALE_FRAMES + 1):
            time_s = self._now()
            good, image = self._capture.read()
            if not good:
                self.close()
                raise roles.LinkDownError(f"camera {self._config.port}: no frame; unplugged?")
        pixels: optical_roles.Levels = np.asarray(image)
        if pixels.ndim == 3:
            pixels = pixels[:, :, 1]
        if out is None:
            return optical_roles.Frame(pixels.copy(), time_s)
        if out.shape != pixels.shape:
            raise roles.DeviceRefusedError(
                f"camera {self._config.port}: sent {pixels.shape}, expected {out.shape}"
            )
        np.copyto(out, pixels)
        return optical_roles.Frame(out, time_s)

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
            "settings": f"{self._size[0]} x {self._size[1]}, exposure {config.exposure:g}, gain "
            f"{config.gain:g}",
        }


class FolderCamera:
    """Camera and screen: after `show(pattern)` the next picture is the one of that name.

    The pictures are 8 or 16 bit grey and of one size; `x_sin_0.png` is the picture of the pattern
    `x_sin_0`.

    Parameters
    ----------
    config : FolderCameraConfig
        The folder; `~` is the home folder.
    sensor : SensorFormat
        Size in `[optics.camera]`; pictures of another size are refused.
    clock : DriverClock
        Of the frames' times, which are those of reading.
    """

    def __init__(
        self,
        config: settings.FolderCameraConfig,
        sensor: optical_roles.SensorFormat,
        clock: optical_roles.DriverClock = _REAL_TIME,
    ) -> None:
        self._folder = Path(config.folder).expanduser()
        self._size = sensor.shape
        self._now = clock.now
        self._files: list[Path] = []
        self._next = 0

    def open(self) -> roles.DeviceIdentity:
        """List the pictures. Raises LinkError without pictures, DeviceRefusedError for another
        size.
        """
        if self._folder.is_dir():
            self._files = sorted(
                path for path in self._folder.iterdir() if path.suffix.lower() in _SUFFIXES
            )
        if not self._files:
            raise roles.LinkError(
                f"camera: {self._folder}: contains no pictures ({', '.join(_SUFFIXES)})"
            )
        self._read(self._files[0])
        return roles.DeviceIdentity(
            "folder of frames", "", "", f"{len(self._files)} pictures in {self._folder}"
        )

    def show(self, pattern: optical_roles.Pattern) -> None:
        """Role Screen: choose the picture of this name; without one the next in the order comes."""
        if not self._files:
            self.open()
        names = [path.stem for path in self._files]
        if pattern.name in names:
            self._next = names.index(pattern.name)

    def grab(self, out: optical_roles.Pixels | None = None) -> optical_roles.Frame:
        """The next picture. Raises LinkError if it cannot be read or has another size."""
        if not self._files:
            self.open()
        time_s = self._now()
        pixels = self._read(self._files[self._next % len(self._files)])
        self._next = (self._next + 1) % len(self._files)
        if out is None:
            return optical_roles.Frame(pixels, time_s)
        if out.dtype != pixels.dtype:
            raise roles.LinkError(
                f"camera: {self._folder}: pictures are {pixels.dtype}, [optics.camera] bits "
                f"requires {out.dtype}"
            )
        np.copyto(out, pixels)
        return optical_roles.Frame(out, time_s)

    def close(self) -> None:
        """Start from the first picture next time."""
        self._files = []
        self._next = 0

    def describe(self) -> dict[str, str]:
        """For people."""
        return {"port": str(self._folder), "settings": f"{self._size[1]} x {self._size[0]}"}

    def _read(self, path: Path) -> optical_roles.Pixels:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise roles.LinkError(f"camera: {path}: cannot be read as a picture")
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
            raise roles.DeviceRefusedError(
                f"camera: {path}: {image.dtype} with {image.ndim} axes; expected 8- or 16-bit grey"
            )
        if image.shape != self._size:
            raise roles.DeviceRefusedError(
                f"camera: {path}: {image.shape[1]} x {image.shape[0]} pixels, [optics.camera] "
                f"states {self._size[1]} x {self._size[0]}"
            )
        return image  # type: ignore[return-value]  # OpenCV's stubs know only its general array
