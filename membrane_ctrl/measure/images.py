"""Decodes untrusted images: reads a picture's size from its header
before allocating memory for it.
"""

import struct

import cv2
import numpy as np

from membrane_ctrl.model.arrays import AnyArray

# A file of incompressible 16-bit pixels.
IMAGE_BYTES_MAX = 150_000_000
# The largest sensors in use. A decoder may make four 16-bit channels of it, 0.5 GB.
PIXELS_MAX = 64_000_000
_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
_WIDTH, _HEIGHT = 256, 257  # tags of a TIFF
_SHORT = 3  # the type of a 16-bit number in a TIFF


def decoded_image(data: bytes, flags: int) -> AnyArray:
    """Decode an image file of unknown origin.

    Parameters
    ----------
    data : bytes
        The file's content: PNG, TIFF, BMP or JPEG.
    flags : int
        Those of `cv2.imdecode`.

    Returns
    -------
    (rows, columns) or (rows, columns, channels) array
        The pixels.

    Raises
    ------
    ValueError
        It is no image, is cut short, or has more than `PIXELS_MAX` pixels.
    """
    if data.startswith(_PNG) and b"IEND" not in data[-12:]:
        # the decoder would write to the terminal, and might fill the rest with black
        raise ValueError("the file ends too early")
    try:
        size = image_size(data)
    except struct.error:
        raise ValueError("the file ends too early") from None
    if size is None or min(size) < 1:
        raise ValueError("not an image")
    if size[0] * size[1] > PIXELS_MAX:
        raise ValueError(
            f"{size[0]} x {size[1]} pixels exceed the limit of {PIXELS_MAX / 1e6:.0f} million"
        )
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise ValueError("not an image")
    return image


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height from a file's header; None for an unsupported format."""
    if data.startswith(_PNG):
        return struct.unpack_from(">II", data, 16)
    if order := _TIFF.get(data[:4]):
        return _tiff_size(data, order)
    if data.startswith(b"BM"):
        width, height = struct.unpack_from("<ii", data, 18)
        return abs(width), abs(height)
    if data.startswith(b"\xff\xd8"):
        return _jpeg_size(data)
    return None


def _tiff_size(data: bytes, order: str) -> tuple[int, int] | None:
    (place,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, place)
    found: dict[int, int] = {}
    for entry in range(place + 2, place + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        (found[tag],) = struct.unpack_from(
            order + ("H" if kind == _SHORT else "I"), data, entry + 8
        )
    if {_WIDTH, _HEIGHT} <= found.keys():
        return (found[_WIDTH], found[_HEIGHT])
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """From the first frame header: segments follow one another, each with its length."""
    place = 2
    while data[place] == 0xFF if place < len(data) else False:
        marker = 0
        if place + 1 < len(data):
            marker = data[place + 1]
        (length,) = struct.unpack_from(">H", data, place + 2)
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, place + 5)
            return width, height
        place += 2 + length
    return None
