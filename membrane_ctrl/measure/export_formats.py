"""The file formats of other programs for a height map (docs/reference/figure.md).

Rows of these formats start at the top, +y; a viewer in front of the mirror sees +x on the right.
High is towards +z.
"""

import io
import math
import struct
from typing import Any

import numpy as np

from membrane_ctrl.measure.export_fits import fits_bytes
from membrane_ctrl.measure.exported_map import ExportedMap
from membrane_ctrl.model import errors
from membrane_ctrl.model.optional import import_optional

# Formats and the suffixes of their files.
SUFFIXES = {
    "zygo-dat": ".dat",
    "zygo-xyz": ".xyz",
    "codev-int": ".int",
    "h5": ".h5",
    "fits": ".fits",
}
# A scale that the formats require: no light was measured.
_WAVELENGTH_M = float(np.float32(632.8e-9))
_NO_DATA = 2147483640
_RESOLUTIONS = {1: 32768, 0: 4096}  # code in the file, counts per wavelength
_CODEV_MOST = 32767
_CODEV_MISSING = -32768

# A file's content, and the step of its heights in mm if they are whole numbers.
Written = tuple[bytes, float | None]


def write_map(form: str, seen: ExportedMap, zernike_table: dict[str, Any] | None) -> Written:
    """Write a height map into the bytes of a file.

    Parameters
    ----------
    form : str
        One of `SUFFIXES`.
    seen : ExportedMap
        The map.
    zernike_table : dict, optional
        Its Zernike terms, which "h5" contains.

    Returns
    -------
    bytes
        The file's content.
    float or None
        Step of its heights in mm, if they are whole numbers.

    Raises
    ------
    InputError
        The format cannot hold the map, or a package is missing.
    """
    if form == "zygo-dat":
        return _write_zygo_dat(seen)
    if form == "zygo-xyz":
        return _write_zygo_xyz(seen)
    if form == "codev-int":
        return _write_codev_int(seen)
    if form == "h5":
        return _write_hdf5(seen, zernike_table)
    return fits_bytes(seen.x_mm, seen.y_mm, seen.height_mm, seen.removed), None


def _write_zygo_dat(seen: ExportedMap) -> Written:
    """MetroPro's binary file, version 1: a header of 834 bytes and big-endian counts."""
    # The finest resolution that holds the largest height; a wave of path is half a wave of height.
    largest_mm = float(np.nanmax(np.abs(seen.height_mm)))
    counts_per_mm = {
        code: per_wave / (_WAVELENGTH_M * 1e3 * 0.5) for code, per_wave in _RESOLUTIONS.items()
    }
    fitting = [code for code, per_mm in counts_per_mm.items() if largest_mm * per_mm < _NO_DATA]
    if not fitting:
        raise errors.InputError(
            f"--format zygo-dat: holds heights up to 166 mm, not {largest_mm:.0f} mm"
        )
    code = fitting[0]

    # Fields of the header by their place in bytes; all others are 0. The heights follow.
    rows, columns = seen.height_mm.shape
    header = bytearray(834)
    fields: tuple[tuple[int, str, Any], ...] = (
        (0, ">I", 0x881B036F),
        (4, ">H", 1),
        (6, ">I", len(header)),
        (10, ">H", 1),
        (68, ">H", columns),
        (70, ">H", rows),
        (72, ">I", 4 * rows * columns),
        (80, "82s", f"membrane_ctrl; removed: {seen.removed}".encode()),
        (164, ">f", 0.5),
        (168, ">f", _WAVELENGTH_M),
        (176, ">f", 1.0),
        (184, ">f", 1e-3 * seen.pitch_mm),
        (218, ">H", code),
        (234, ">H", columns),
        (236, ">H", rows),
        (258, "40s", b"membrane mirror"),
    )
    for place, kind, value in fields:
        struct.pack_into(kind, header, place, value)
    heights = seen.top_down(counts_per_mm[code], _NO_DATA).astype(">i4")
    return bytes(header) + heights.tobytes(), 1 / counts_per_mm[code]


def _write_zygo_xyz(seen: ExportedMap) -> Written:
    """MetroPro's text of points: column, row, height in µm."""
    rows, columns = seen.height_mm.shape
    head = (
        "Zygo XYZ Data File - Format 1",
        '0 0 0 0 "membrane_ctrl"',
        "0 0 0 0 0 0",
        f"0 0 {columns} {rows}",
        f'"membrane_ctrl; removed: {seen.removed}"',
        '""',
        '"membrane mirror"',
        f"0 0.5 {_WAVELENGTH_M:.9g} 0 1 0 {1e-3 * seen.pitch_mm:.9g} 0",
        f'{columns} {rows} 0 0 0 0 ""',
        "0 0 0 0 0 0 0 0 0 0",
        "1 0 0 0 0 0 0 0 0",
        '0 ""',
        "1 0",
        "#",
    )

    # One line a cell: column, row and height; row 0 is at the top.
    height_um = 1e3 * seen.height_mm[::-1]
    points = []
    for row, values in enumerate(height_um.tolist()):
        for column, value in enumerate(values):
            text = f"{value:.6f}"
            if math.isnan(value):
                text = "No Data"
            points.append(f"{column} {row} {text}")
    return ("\n".join([*head, *points]) + "\n#\n").encode(), 1e-9


def _write_codev_int(seen: ExportedMap) -> Written:
    """Code V's grid interferogram of a surface: whole numbers of 16 bits, SSZ of them a wavelength
    of 1 µm.
    """
    # The largest height takes the largest number, if it is not 0.
    per_um = _CODEV_MOST / max(1e3 * float(np.nanmax(np.abs(seen.height_mm))), 1e-6)
    scale = float(f"{per_um:.9g}")  # as the file states it
    rows, columns = seen.height_mm.shape
    text = io.StringIO()
    text.write(f"membrane_ctrl, cells of {seen.pitch_mm:.6g} mm, removed: {seen.removed}\n")
    text.write(f"GRD {columns} {rows} SUR WVL 1.0 SSZ {scale} NDA {_CODEV_MISSING}\n")
    counts = np.clip(seen.top_down(1e3 * scale, _CODEV_MISSING), _CODEV_MISSING, _CODEV_MOST)
    np.savetxt(text, counts.reshape(-1, 1), fmt="%d")
    return text.getvalue().encode(), 1e-3 / scale


def _write_hdf5(seen: ExportedMap, table: dict[str, Any] | None) -> Written:
    """HDF5: the map with its axes as NumPy keeps them, and the Zernike terms."""
    h5py = import_optional("h5py", "h5", "--format h5")
    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        for name, values in (
            ("x_mm", seen.x_mm),
            ("y_mm", seen.y_mm),
            ("height_mm", seen.height_mm),
        ):
            file.create_dataset(name, data=values, compression="gzip" if values.ndim > 1 else None)
        file.attrs["removed"] = seen.removed
        file["height_mm"].attrs["axes"] = (
            "rows along y_mm, columns along x_mm; NaN where not measured"
        )
        for name, value in (table or {}).items():
            file.require_group("zernike").attrs[name] = value
    return memory.getvalue(), None
