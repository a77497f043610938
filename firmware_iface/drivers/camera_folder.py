"""A folder of pictures as role Camera: one file per exposure, in order of name, repeated endlessly.

For trying the cycle without a camera, with pictures of a bench or from `membrane-ctrl simulate`.
"""

import time
from pathlib import Path

import cv2
import numpy as np

from firmware_iface.roles import Clock, DeviceIdentity, DeviceRefusedError, Frame, LinkError, Pattern, Pixels

_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".pgm")


class FolderCamera:
    """Camera and screen: after `show(pattern)` the next picture is the one of that name.

    The pictures are 8 or 16 bit grey and of one size; `x_sin_0.png` is the picture of the pattern `x_sin_0`.
    """

    def __init__(self, folder: Path, width_px: int, height_px: int, now: Clock = time.monotonic) -> None:
        self._folder, self._size, self._now = folder, (height_px, width_px), now
        self._files: list[Path] = []
        self._next = 0

    def open(self) -> DeviceIdentity:
        """List the pictures. Raises LinkError without pictures, DeviceRefusedError for another size."""
        if self._folder.is_dir():
            self._files = sorted(path for path in self._folder.iterdir() if path.suffix.lower() in _SUFFIXES)
        if not self._files:
            raise LinkError(f"camera: {self._folder}: contains no pictures ({', '.join(_SUFFIXES)})")
        self._read(self._files[0])
        return DeviceIdentity("folder of frames", "", "", f"{len(self._files)} pictures in {self._folder}")

    def show(self, pattern: Pattern) -> None:
        """Role Screen: choose the picture of this name; without one the next in the order comes."""
        if not self._files:
            self.open()
        names = [path.stem for path in self._files]
        if pattern.name in names:
            self._next = names.index(pattern.name)

    def grab(self, out: Pixels | None = None) -> Frame:
        """The next picture. Raises LinkError if it cannot be read or has another size."""
        if not self._files:
            self.open()
        time_s = self._now()
        pixels = self._read(self._files[self._next % len(self._files)])
        self._next = (self._next + 1) % len(self._files)
        if out is None:
            return Frame(pixels, time_s)
        if out.dtype != pixels.dtype:
            raise LinkError(
                f"camera: {self._folder}: pictures are {pixels.dtype}, [optics.camera] bits requires {out.dtype}"
            )
        np.copyto(out, pixels)
        return Frame(out, time_s)

    def close(self) -> None:
        """Start from the first picture next time."""
        self._files, self._next = [], 0

    def describe(self) -> dict[str, str]:
        """For people."""
        return {"port": str(self._folder), "settings": f"{self._size[1]} x {self._size[0]}"}

    def _read(self, path: Path) -> Pixels:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise LinkError(f"camera: {path}: cannot be read as a picture")
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
            raise DeviceRefusedError(
                f"camera: {path}: {image.dtype} with {image.ndim} axes; expected 8- or 16-bit grey"
            )
        if image.shape != self._size:
            raise DeviceRefusedError(
                f"camera: {path}: {image.shape[1]} x {image.shape[0]} pixels, [optics.camera] says "
                f"{self._size[1]} x {self._size[0]}"
            )
        return image  # type: ignore[return-value]  # OpenCV's stubs know only its general array
