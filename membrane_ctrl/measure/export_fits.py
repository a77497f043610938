"""A height map as FITS for programs of physical optics, such as POPPY: path difference, mask and
height.

Source: FITS Standard 4.0 (World Coordinate System: section 8); POPPY 1.1, `FITSOpticalElement`.
"""

import io
from typing import Any

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.optional import import_optional
from membrane_ctrl.model.program import file_origin

# Where the mirror is high, the light turns back earlier: the reflected wavefront leads by twice the
# height. POPPY has this sign: a mirror that rises towards +x sends the light to -x.
_LEAD_PER_HEIGHT = 2.0
_M_PER_MM = 1e-3


def fits_bytes(x_mm: FloatArray, y_mm: FloatArray, height_mm: FloatArray, removed: str) -> bytes:
    """Content of a FITS file with the images `OPD`, `MASK` and `HEIGHT`.

    Parameters
    ----------
    x_mm, y_mm : (W,), (H,) array
        Middle of the cells, rising, in even steps of one size.
    height_mm : (H, W) array
        Height towards +z, rows along y; NaN where not measured.
    removed : str
        What was subtracted from the height, for the header.

    Returns
    -------
    bytes
        The images are square, as POPPY requires. Cells without a measurement have mask 0 and a path
        difference of 0 m.

    Raises InputError if astropy is missing.
    """
    fits = import_optional("astropy.io.fits", "fits", "--format fits")
    x_mm, y_mm, height_mm = _pad_to_square(x_mm, y_mm, height_mm)
    measured = np.isfinite(height_mm)
    lead_m = np.where(measured, _LEAD_PER_HEIGHT * _M_PER_MM * np.nan_to_num(height_mm), 0.0)
    images = (
        ("OPD", lead_m, "m", "lead of the reflected wavefront, 2 height"),
        ("MASK", measured.astype(np.uint8), "", "1 where the mirror was measured"),
        ("HEIGHT", _M_PER_MM * height_mm, "m", "height towards the light"),
    )
    file = fits.HDUList()
    for name, values, unit, meaning in images:
        make = fits.ImageHDU if file else fits.PrimaryHDU
        image = make(values)
        image.header["EXTNAME"] = (name, meaning)
        if unit:
            image.header["BUNIT"] = unit
        image.header.extend(_place_cards(x_mm, y_mm))
        image.header.extend(_origin_cards(removed))
        file.append(image)
    memory = io.BytesIO()
    file.writeto(memory)
    return memory.getvalue()


def _pad_to_square(
    x_mm: FloatArray, y_mm: FloatArray, height_mm: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The map with NaN appended in rows or columns until it is square."""
    rows, columns = height_mm.shape
    side = max(rows, columns)
    square = np.full((side, side), np.nan)
    square[:rows, :columns] = height_mm
    steps = np.arange(side)
    pitch_mm = (x_mm[-1] - x_mm[0]) / (columns - 1)
    return x_mm[0] + pitch_mm * steps, y_mm[0] + pitch_mm * steps, square


def _place_cards(x_mm: FloatArray, y_mm: FloatArray) -> list[tuple[str, Any, str]]:
    """Pitch and coordinates: the first pixel is at the lowest x and y."""
    pitch_m = _M_PER_MM * float(x_mm[-1] - x_mm[0]) / (x_mm.size - 1)
    cards: list[tuple[str, Any, str]] = [("PUPLSCAL", pitch_m, "m a pixel")]
    for number, (name, axis_mm) in enumerate((("X", x_mm), ("Y", y_mm)), start=1):
        cards += [
            (f"CTYPE{number}", name, "axis of the mirror, origin at its vertex"),
            (f"CUNIT{number}", "m", ""),
            (f"CRPIX{number}", 1.0, ""),
            (f"CRVAL{number}", _M_PER_MM * float(axis_mm[0]), ""),
            (f"CDELT{number}", pitch_m, ""),
        ]
    return cards


def _origin_cards(removed: str) -> list[tuple[str, Any, str]]:
    origin = file_origin("membrane-figure/1")
    return [
        ("SCHEMA", origin["schema"], "format of this file"),
        ("CREATOR", origin["program"], "program"),
        ("COMMIT", origin["commit"], "of its source"),
        ("REMOVED", removed, "from the height"),
    ]
