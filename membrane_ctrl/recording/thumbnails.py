"""Small pictures of the camera's frames, now and then."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from membrane_ctrl.acquisition.frame_address import FrameAddress
from membrane_ctrl.acquisition.frames import FrameHead, FrameReader, Pixels
from membrane_ctrl.recording.sink import Recording

# Raw frames would be 1.7 TB a day; a set of eight thumbnails each half minute is about 0.3 GB.
THUMBNAIL_INTERVAL_S = 30.0
THUMBNAIL_HEIGHT_PX = 256
_JPEG_QUALITY = 80


class Thumbnails:
    """Takes the newest frame of each pattern from the shared frames, at most one set each `THUMBNAIL_INTERVAL_S`."""

    def __init__(self, recording: Recording, address: FrameAddress) -> None:
        self._recording = recording
        self._reader = FrameReader(address)
        self._step = max(1, address.height_px // THUMBNAIL_HEIGHT_PX)
        self._next_s = 0.0
        self._newest_index = -1

    def send(self, now_s: float) -> None:
        """Send a set if one is due and there are new frames."""
        if now_s < self._next_s:
            return
        newest: dict[str, FrameHead] = {head.pattern: head for head in self._reader.heads()}
        fresh = [head for head in newest.values() if head.index > self._newest_index]
        if not fresh:
            return
        self._next_s = now_s + THUMBNAIL_INTERVAL_S
        self._newest_index = max(head.index for head in fresh)
        for head in fresh:
            pixels = self._reader.copy(head, self._step)
            if pixels is not None:
                picture = rr.Image(_eight_bit(pixels), color_model="L").compress(jpeg_quality=_JPEG_QUALITY)
                self._recording.log(f"/frames/{head.pattern}", head.time_s, picture)

    def close(self) -> None:
        """Detach from the shared frames."""
        self._reader.close()


def _eight_bit(pixels: Pixels) -> NDArray[np.uint8]:
    """JPEG takes 8 bits: of wider pixels the upper ones that are in use."""
    shift = max(0, int(pixels.max()).bit_length() - 8)
    return (pixels >> shift).astype(np.uint8)
