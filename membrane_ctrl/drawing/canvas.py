"""A picture in memory: lines, areas, images and text, each with soft edges."""

from __future__ import annotations

from functools import cache, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from membrane_ctrl.drawing.colour_tables import Pixels
from membrane_ctrl.model.colours import Colour

BLACK: Colour = (0, 0, 0)
DOTS_PER_INCH = 110
_POINT_PX = DOTS_PER_INCH / 72
_PAPER = 255
_SUBPIXEL_BITS = 4  # OpenCV's coordinates are whole numbers of 1/16 pixel
_FARTHEST_PX = 20_000  # OpenCV counts in 32 bits; what is so far outside is cut off anyway
_COMPRESSION = 3  # of a PNG: higher levels take longer and save little
_LINE_SPACING = 1.25  # over the height of the letters
_KEPT_TEXTS = 500  # labels that may occur again
_FONT = "DejaVuSans.ttf"  # Matplotlib's own, which is found without loading it

HorizontalPlace = Literal["left", "middle", "right"]
VerticalPlace = Literal["top", "middle", "bottom"]


class Canvas:
    """A white picture to draw on; coordinates in pixels from the upper left corner.

    Parameters
    ----------
    width_px, height_px : int
        Its size.
    """

    def __init__(self, width_px: int, height_px: int) -> None:
        self.pixels: Pixels = np.full((height_px, width_px, 3), _PAPER, np.uint8)

    def draw_line(self, points_px: ArrayLike, colour: Colour, width_px: int = 2) -> None:
        """Draw a line through points (n, 2)."""
        points = _subpixels(points_px)
        cv2.polylines(
            self.pixels, [points], False, colour, width_px, cv2.LINE_AA, shift=_SUBPIXEL_BITS
        )

    def fill_area(self, points_px: ArrayLike, colour: Colour, opacity: float = 1.0) -> None:
        """Fill the polygon with the corners (n, 2)."""
        points = _subpixels(points_px)
        if opacity >= 1:
            cv2.fillPoly(self.pixels, [points], colour, cv2.LINE_AA, shift=_SUBPIXEL_BITS)
            return
        # Only the pixels about the polygon are mixed with its colour.
        left, top = np.floor(np.min(points, axis=0) / 2**_SUBPIXEL_BITS).astype(int) - 1
        right, bottom = np.ceil(np.max(points, axis=0) / 2**_SUBPIXEL_BITS).astype(int) + 2
        height, width = self.pixels.shape[:2]
        left, right = np.clip([left, right], 0, width)
        top, bottom = np.clip([top, bottom], 0, height)
        if left >= right or top >= bottom:
            return
        cover = np.zeros((bottom - top, right - left), np.uint8)
        inside = points - np.array([left, top], np.int32) * 2**_SUBPIXEL_BITS
        level = round(255 * opacity)
        cv2.fillPoly(cover, [inside], level, cv2.LINE_AA, shift=_SUBPIXEL_BITS)
        self._blend(cover, int(left), int(top), colour)

    def draw_dot(self, x: float, y: float, radius_px: float, colour: Colour) -> None:
        """Fill a circle."""
        ((centre,),) = _subpixels([[x, y]])[None]
        radius = round(radius_px * 2**_SUBPIXEL_BITS)
        place = (int(centre[0]), int(centre[1]))
        cv2.circle(self.pixels, place, radius, colour, -1, cv2.LINE_AA, shift=_SUBPIXEL_BITS)

    def paste(self, image: Pixels, left: int, top: int) -> None:
        """Put an image (rows, columns, 3) on the picture, of which it may not stand out."""
        rows, columns = image.shape[:2]
        self.pixels[top : top + rows, left : left + columns] = image

    def draw_text(
        self,
        text: str,
        x: float,
        y: float,
        size_pt: float = 10.0,
        across: HorizontalPlace = "middle",
        along: VerticalPlace = "middle",
        colour: Colour = BLACK,
        upright: bool = False,
    ) -> None:
        """Write text, of one or more lines.

        Parameters
        ----------
        text : str
            What to write.
        x, y : float
            The point of the text that `across` and `along` name.
        size_pt : float
            Size of the letters.
        across, along : str
            Which point of the text stands at (x, y).
        colour : Colour
            Of the letters.
        upright : bool
            The text runs from below to above.
        """
        cover = _text_cover(text, size_pt)
        if upright:
            cover = np.rot90(cover)
        rows, columns = cover.shape
        left = x - {"left": 0.0, "middle": 0.5, "right": 1.0}[across] * columns
        top = y - {"top": 0.0, "middle": 0.5, "bottom": 1.0}[along] * rows
        self._blend(cover, round(left), round(top), colour)

    def encode_png(self) -> bytes:
        """The picture as a PNG file."""
        blue_first = cv2.cvtColor(self.pixels, cv2.COLOR_RGB2BGR)
        _, encoded = cv2.imencode(".png", blue_first, [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION])
        return encoded.tobytes()

    def _blend(self, cover: Pixels, left: int, top: int, colour: Colour) -> None:
        """Colour the pixels below `cover` (0: not at all, 255: fully); parts outside are cut."""
        height, width = self.pixels.shape[:2]
        rows = slice(max(top, 0), min(top + cover.shape[0], height))
        columns = slice(max(left, 0), min(left + cover.shape[1], width))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return
        part = cover[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
        below = self.pixels[rows, columns].astype(np.float32)
        share = (part / np.float32(255))[..., None]
        mixed = below + share * (np.array(colour, np.float32) - below)
        self.pixels[rows, columns] = np.rint(mixed).astype(np.uint8)


def text_width_px(text: str, size_pt: float) -> int:
    """Width of a text as `Canvas.draw_text` writes it."""
    return int(_text_cover(text, size_pt).shape[1])


@cache
def _load_font(size_pt: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The font of all labels; Pillow's own if Matplotlib has moved its files."""
    size_px = size_pt * _POINT_PX
    package = find_spec("matplotlib")
    if package is not None and package.origin is not None:
        path = Path(package.origin).with_name("mpl-data") / "fonts" / "ttf" / _FONT
        if path.is_file():
            return ImageFont.truetype(path, size_px)
    return ImageFont.load_default(size_px)


@lru_cache(_KEPT_TEXTS)
def _text_cover(text: str, size_pt: float) -> Pixels:
    """How far each pixel of a text is covered (0 to 255); as high as its lines, letters or not."""
    font = _load_font(size_pt)
    step_px = round(_LINE_SPACING * size_pt * _POINT_PX)
    lines = text.split("\n")
    width_px = max(1, *(round(font.getbbox(line)[2]) + 1 for line in lines))
    image = Image.new("L", (width_px, step_px * len(lines)))
    draw = ImageDraw.Draw(image)
    for number, line in enumerate(lines):
        draw.text((0, number * step_px), line, fill=255, font=font)
    return np.asarray(image)


def _subpixels(points_px: ArrayLike) -> NDArray[np.int32]:
    """Points in OpenCV's units; its pixels have their centres at whole numbers."""
    near = np.clip(np.asarray(points_px, float), -_FARTHEST_PX, _FARTHEST_PX)
    return np.asarray(np.rint((near - 0.5) * 2**_SUBPIXEL_BITS), np.int32)
