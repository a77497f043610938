"""Pictures whose bytes were put together wrongly: in the other order, or from packed pixels.

Neighbouring pixels of a picture are similar. Wrongly combined bytes are not: bits of little weight
stand where those of large weight belong. So each usual mistake is undone on trial, and a mistake is
named only if the picture becomes several times smoother. Sources: GenICam's pixel format naming
convention 2.4 (Mono12p, Mono10p), GigE Vision 2.2 (Mono12Packed).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray, Image

# A picture of the right bytes is smoother than one of wrong ones by at least this factor.
_SMOOTHER = 3.0
# Roughness over the picture's own scatter: a smoother picture is right, whatever a trial gives.
_ROUGH = 0.05
_PICTURES = 5  # pictures that are judged, those with the largest scatter: dark ones show noise
_COARSE = 8  # pixels between those that show the scatter of a picture
_ROWS = 256  # rows of a picture that are judged
# Packed pixels that were read as bytes: after how many bytes the weight of the bits repeats.
_PERIODS = {
    2: "16-bit pixels were read as bytes",
    3: "12-bit pixels, packed two in three bytes, were read as bytes",
    5: "10-bit pixels, packed four in five bytes, were read as bytes",
}
_PERIODS_MAX = max(_PERIODS)
# Packed pixels in a picture of another size than stated, by the bytes of a pixel.
_PACKED_SIZES = {1.5: "12-bit pixels, packed two in three bytes", 1.25: "10-bit pixels, packed"}


@dataclass(frozen=True)
class Mistake:
    """How a picture may have been put together wrongly, and how to undo it on trial."""

    name: str
    undo: Callable[[Image], FloatArray]


def find_pixel_mistake(frames: Image) -> str:
    """Name the mistake that explains rough pictures.

    Parameters
    ----------
    frames : (frames, height, width) array
        uint8 or uint16.

    Returns
    -------
    str
        For people; empty if no mistake explains them.
    """
    if frames.shape[1] < 2 or frames.shape[2] < 2 * _PERIODS_MAX:
        return ""
    scatter = frames[:, ::_COARSE, ::_COARSE].std(axis=(1, 2))
    chosen = [k for k in np.argsort(scatter)[::-1][:_PICTURES] if scatter[k] > 0]
    if not chosen:
        return ""
    if frames.dtype == np.uint8:
        # Rows that follow each other: packed pixels continue from one row to the next.
        middle = frames.shape[1] // 2
        rows = slice(max(0, middle - _ROWS // 2), middle + _ROWS // 2)
        return _find_packing([frames[k][rows] for k in chosen])
    step = max(1, frames.shape[1] // _ROWS)
    return _find_word_mistake([np.ascontiguousarray(frames[k][::step]) for k in chosen])


def find_size_mistake(seen: tuple[int, ...], stated: tuple[int, int], dtype: np.dtype) -> str:
    """Name the packing that explains a picture of another size than stated.

    Parameters
    ----------
    seen : tuple of int
        Height and width of the picture.
    stated : (int, int)
        Height and width as stated.
    dtype : np.dtype
        Of its pixels.

    Returns
    -------
    str
        For people; empty if none does.
    """
    if len(seen) != 2 or seen[0] != stated[0]:
        return ""
    ratio = seen[1] / stated[1]
    bytes_per_pixel = ratio * np.dtype(dtype).itemsize
    if bytes_per_pixel == 2.0 and dtype == np.uint8:
        return "16-bit pixels whose two bytes stand side by side"
    return _PACKED_SIZES.get(bytes_per_pixel, "")


def _list_word_mistakes() -> tuple[Mistake, ...]:
    """Mistakes in pictures of 16-bit words.

    In the first pixel of a Mono12Packed pair the low bits stand before the high ones.
    """
    return (
        Mistake("the two bytes of each pixel are in the wrong order", _swap_bytes),
        Mistake(
            "12-bit pixels were unpacked as Mono12p, but are Mono12Packed", _turn_columns(0, 4)
        ),
        Mistake(
            "12-bit pixels were unpacked as Mono12Packed, but are Mono12p", _turn_columns(0, 8)
        ),
    )


def _swap_bytes(picture: Image) -> FloatArray:
    """Exchange the two bytes of each pixel."""
    return picture.byteswap().astype(float)


def _turn_columns(first: int, bits: int) -> Callable[[Image], FloatArray]:
    """Rotate the 12 bits of every other pixel to the left, beginning with column `first`."""

    def turn(picture: Image) -> FloatArray:
        turned = picture.astype(np.uint32)
        part = turned[:, first::2]
        turned[:, first::2] = (part << bits | part >> (12 - bits)) & 0xFFF
        return turned.astype(float)

    return turn


def _measure_roughness(pictures: Sequence[FloatArray]) -> float:
    """Mean step between neighbours in a row, of the pictures' scatter; 1.1 for pure noise."""
    scatter = sum(float(picture.std()) for picture in pictures)
    steps = sum(float(np.abs(np.diff(picture, axis=1)).mean()) for picture in pictures)
    if scatter > 0:
        return steps / scatter
    return np.inf


def _find_word_mistake(pictures: Sequence[Image]) -> str:
    """Name the mistake without which the pictures are clearly smoother; empty if there is none."""
    present = _measure_roughness([picture.astype(float) for picture in pictures])
    if present < _ROUGH:
        return ""
    tried = {
        mistake.name: _measure_roughness([mistake.undo(picture) for picture in pictures])
        for mistake in _list_word_mistakes()
    }
    best, *others = sorted(tried, key=tried.__getitem__)
    if tried[best] * _SMOOTHER > min(present, tried[others[0]]):
        return ""
    return best


def _find_packing(pictures: Sequence[Image]) -> str:
    """Name the period of bytes in which some are smooth and some are noise.

    In a picture of whole pixels every column is as rough as its neighbours; in one of packed pixels
    every second, third or fifth byte has the high bits, and another the low ones.
    """
    streams = [picture.astype(float).ravel() for picture in pictures]
    if _measure_roughness([stream[np.newaxis] for stream in streams]) < _ROUGH:
        return ""
    # For each period the ratio of the roughest to the smoothest byte.
    contrasts: dict[int, float] = {}
    for period in _PERIODS:
        steps = np.zeros(period)
        for stream in streams:
            whole = stream[: len(stream) // period * period].reshape(-1, period)
            steps += np.abs(np.diff(whole, axis=0)).mean(axis=0)
        contrasts[period] = np.inf
        if steps.min() > 0:
            contrasts[period] = float(steps.max() / steps.min())

    # The period of the largest contrast, if it is clearly larger than the next.
    best, *others = sorted(contrasts, key=contrasts.__getitem__, reverse=True)
    if contrasts[best] < _SMOOTHER * max(1.0, contrasts[others[0]]):
        return ""
    return _PERIODS[best]
