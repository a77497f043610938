"""Small pictures of camera frames, now and then."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.optical_roles import Pixels
from membrane_ctrl.processes.frame_address import FrameAddress
from membrane_ctrl.processes.frames import FrameHead, FrameReader

# Raw frames would be 1.7 TB a day; eight thumbnails every half minute are about 0.2 GB (no video:
# docs/reference/recording.md).
THUMBNAIL_INTERVAL_S = 30.0
THUMBNAIL_HEIGHT_PX = 256
_JPEG_QUALITY = 80


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A small picture of a camera frame, as JPEG."""

    time_s: float  # middle of the exposure
    pattern: str
    jpeg: bytes


class Thumbnails:
    """Makes pictures of the newest shared frame of each pattern, at most one set per
    `THUMBNAIL_INTERVAL_S`.
    """

    def __init__(self, address: FrameAddress) -> None:
        self._reader = FrameReader(address)
        self._step = max(1, address.height_px // THUMBNAIL_HEIGHT_PX)
        self._next_s = 0.0
        self._newest_index = -1

    def take_due(self, now_s: float) -> list[Thumbnail]:
        """A set if one is due and there are new frames, else none."""
        import rerun as rr

        if now_s < self._next_s:
            return []
        # The newest frame of each pattern, if it is newer than the last set
        newest: dict[str, FrameHead] = {head.pattern: head for head in self._reader.heads()}
        fresh = [head for head in newest.values() if head.index > self._newest_index]
        if not fresh:
            return []
        self._next_s = now_s + THUMBNAIL_INTERVAL_S
        self._newest_index = max(head.index for head in fresh)
        made = []
        # A frame that is overwritten meanwhile is left out
        for head in fresh:
            pixels = self._reader.copy(head, self._step)
            if pixels is not None:
                picture = rr.Image(_eight_bit(pixels), color_model="L").compress(
                    jpeg_quality=_JPEG_QUALITY
                )
                assert isinstance(picture, rr.EncodedImage)
                assert picture.blob is not None
                jpeg = bytes(picture.blob.as_arrow_array()[0].as_py())
                made.append(Thumbnail(head.time_s, head.pattern, jpeg))
        return made

    def close(self) -> None:
        """Detach from the shared frames."""
        self._reader.close()


def _eight_bit(pixels: Pixels) -> NDArray[np.uint8]:
    """Reduce to JPEG's 8 bits: of wider pixels, the upper bits in use."""
    shift = max(0, int(pixels.max()).bit_length() - 8)
    return (pixels >> shift).astype(np.uint8)
