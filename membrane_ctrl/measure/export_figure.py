"""The command `export-figure`: a measured height map in the formats of other programs
(docs/reference/figure.md).

Rows of these formats start at the top, +y; a viewer in front of the mirror sees +x on the right.
High is towards +z.
"""

import io
import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.measure.export_fits import fits_bytes
from membrane_ctrl.measure.result_files import read_arrays
from membrane_ctrl.metrology.figure import best_sphere
from membrane_ctrl.metrology.figure.error_bars import LEAST_CELLS
from membrane_ctrl.metrology.numerics import grid_fit, zernike
from membrane_ctrl.model import errors, files, plain_json
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray
from membrane_ctrl.model.optional import import_optional
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

_REMOVABLE = {"piston": (0,), "tilt": (1, 2), "power": (3,)}  # places in the Fringe set
_CELLS_MAX = 4_000_000
_HEIGHT_MAX_MM = 1e4
_WAVELENGTH_M = float(
    np.float32(632.8e-9)
)  # a scale, which the formats require: no light was measured
_NO_DATA = 2147483640
_RESOLUTIONS = {1: 32768, 0: 4096}  # code in the file, counts per wavelength
_CODEV_MOST, _CODEV_MISSING = 32767, -32768


@dataclass(frozen=True)
class ExportedMap:
    """A height map on an even grid, to be written.

    Attributes
    ----------
    x_mm, y_mm : (W,), (H,) arrays
        Middle of the cells, rising, the same pitch along both.
    height_mm : (H, W) array
        Rows along y; NaN where not measured.
    radius_mm : float
        Radius of the Fringe terms' disc: about the vertex, the smallest that holds every measured
        cell.
    removed : str
        What was taken off, for people.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    height_mm: FloatArray
    radius_mm: float
    removed: str = "nothing"

    @property
    def pitch_mm(self) -> float:
        """Side of a cell."""
        return float(self.x_mm[-1] - self.x_mm[0]) / (self.x_mm.size - 1)

    @property
    def is_measured(self) -> BoolArray:
        """Cells with a height."""
        return np.isfinite(self.height_mm)

    def top_down(self, counts_per_mm: float, missing: int) -> IntArray:
        """Heights as whole numbers, first row at +y."""
        whole = np.where(
            self.is_measured, np.rint(np.nan_to_num(self.height_mm) * counts_per_mm), missing
        )
        return whole[::-1].astype(np.int64)


def export_command(
    result: Path, form: str, remove: str = "", terms: str = "", out: Path | None = None
) -> int:
    """Write a result's height map, and a table of its Zernike terms if `terms` names a set. Raises
    InputError.
    """
    if form not in _WRITERS:
        raise errors.InputError(f"--format {form}: give one of {', '.join(_WRITERS)}")
    if terms and terms not in ("noll", "osa", "fringe"):
        raise errors.InputError(f"--zernike {terms}: give one of noll, osa, fringe")
    seen, table = read_result(result)
    names = [name for name in remove.split(",") if name]
    if unknown := [name for name in names if name not in (*_REMOVABLE, "sphere")]:
        raise errors.InputError(
            f"--remove {unknown[0]}: give piston, tilt, power or sphere, separated by commas"
        )
    zernike_table = _zernike_table(terms, seen, table, result) if terms else None
    seen = remove_parts(seen, names)
    suffix, write = _WRITERS[form]
    target = files.resolve_user_path(out) if out else result.resolve() / f"figure{suffix}"
    with errors.convert_write_errors(target):
        data, step_mm = write(seen, zernike_table)
        files.write_bytes_atomic(target, data)
        if zernike_table is not None and form != "h5":
            files.write_text_atomic(
                target.with_name(target.name + ".zernike.json"), json.dumps(zernike_table, indent=1)
            )
    step = f", heights in steps of {1e6 * step_mm:.3g} nm" if step_mm else ""
    rows, columns = seen.height_mm.shape
    print(
        f"{target}: {columns} x {rows} cells of {seen.pitch_mm:.4g} mm, {seen.removed} "
        f"removed{step}"
    )
    return 0


def read_result(folder: Path) -> tuple[ExportedMap, dict[str, Any]]:
    """The height map and `result.json` of a result folder. Raises InputError."""
    try:
        arrays = read_arrays(folder / "height.npz", ("x_mm", "y_mm", "h_mm"), _CELLS_MAX)
        table = plain_json.loads(files.read_text(folder / "result.json"))
    except OSError as error:
        raise errors.InputError(
            f"{error.filename or folder}: {errors.os_reason(error)}: is it a result?"
        ) from None
    except ValueError as error:
        raise errors.InputError(f"{folder}: not a usable result: {error}") from None
    where, (x, y, height) = folder / "height.npz", arrays
    if (
        height.ndim != 2
        or height.shape != (y.size, x.size)
        or x.ndim != 1
        or y.ndim != 1
        or min(height.shape) < 2
    ):
        raise errors.InputError(f"{where}: h_mm has not the shape of y_mm and x_mm, at least 2 x 2")
    steps = np.concatenate([np.diff(x), np.diff(y)])
    if not np.isfinite(steps).all() or steps.min() <= 0 or np.ptp(steps) > 1e-6 * steps.max():
        raise errors.InputError(f"{where}: x_mm and y_mm must rise in even steps of one size")
    measured = np.isfinite(height)
    if np.count_nonzero(measured) < LEAST_CELLS:
        raise errors.InputError(
            f"{where}: has {np.count_nonzero(measured)} measured cells, too few for a figure"
        )
    if (
        not np.nanmax(np.abs(np.where(measured, height, 0))) <= _HEIGHT_MAX_MM
        or np.isinf(height).any()
    ):
        raise errors.InputError(f"{where}: h_mm has heights beyond {_HEIGHT_MAX_MM:g} mm")
    radius = float(np.max(np.where(measured, np.hypot(x, y[:, None]), 0)))
    return ExportedMap(x, y, height, radius), table if isinstance(table, dict) else {}


def _fit_terms(seen: ExportedMap, terms: int) -> grid_fit.GridFit:
    axes = seen.x_mm / seen.radius_mm, seen.y_mm / seen.radius_mm
    return grid_fit.GridFit(
        axes[0], seen.is_measured, [zernike.fringe_set_orders(j + 1) for j in range(terms)], axes[1]
    )


def remove_parts(seen: ExportedMap, names: list[str]) -> ExportedMap:
    """The map without the named parts.

    Piston, tilt and power are fitted together; what is not named stays. `sphere` leaves the
    deviation along the best sphere's normal, and then the other parts of that.
    """
    height, measured = seen.height_mm, seen.is_measured
    if "sphere" in names:
        rows, columns = np.nonzero(measured)
        points = np.stack([seen.x_mm[columns], seen.y_mm[rows], height[measured]])
        height = np.full(height.shape, np.nan)
        height[measured] = best_sphere.best_sphere(points).deviation(points)[0]
    places = [place for name in names for place in _REMOVABLE.get(name, ())]
    if places:
        fit = _fit_terms(seen, 4)
        coefficients = np.zeros(4)
        coefficients[places] = fit.coefficients(height)[places]
        height = height - fit.values(coefficients)
    return ExportedMap(seen.x_mm, seen.y_mm, height, seen.radius_mm, ", ".join(names) or "nothing")


def _zernike_table(
    index: str, seen: ExportedMap, table: dict[str, Any], where: Path
) -> dict[str, Any]:
    """Terms of the whole height in one set; Noll's are the result's own, Fringe's are fitted to the
    map.
    """
    if index == "fringe":
        coeffs = 1e3 * _fit_terms(seen, zernike.FRINGE_TERMS).coefficients(seen.height_mm)
        orders = [zernike.fringe_set_orders(j + 1) for j in range(zernike.FRINGE_TERMS)]
        radius, first, normalisation = seen.radius_mm, 1, "peak"
    else:
        own = table.get("zernike")
        own = own if isinstance(own, dict) else {}
        try:
            coeffs, radius = (
                np.array(own.get("coeffs_um"), float),
                float(own.get("radius_mm", math.nan)),
            )
        except (TypeError, ValueError):
            coeffs, radius = np.zeros(0), math.nan
        if coeffs.shape != (ZERNIKE_TERMS,) or not (np.isfinite(coeffs).all() and radius > 0):
            wanted = f"needs {ZERNIKE_TERMS} coefficients (it has {coeffs.size}) and a radius"
            raise errors.InputError(f"{where / 'result.json'}: zernike: {wanted}")
        orders, first, normalisation = (
            [zernike.noll_orders(j + 1) for j in range(ZERNIKE_TERMS)],
            1,
            "rms",
        )
        if index == "osa":
            coeffs, orders, first = zernike.osa_from_noll(coeffs), sorted(orders), 0
    return {
        "index": index,
        "first": first,
        "normalisation": normalisation,
        "radius_mm": radius,
        "centre_mm": [0.0, 0.0],
        "of": "the whole height, nothing removed",
        "n_m": [list(order) for order in orders],
        "coeffs_um": coeffs.tolist(),
    }


Written = tuple[
    bytes, float | None
]  # a file's content, and the step of its heights in mm if they are whole numbers


def _zygo_dat(seen: ExportedMap, _: object) -> Written:
    """MetroPro's binary file, version 1: a header of 834 bytes and big-endian counts."""
    largest_mm = float(np.nanmax(np.abs(seen.height_mm)))
    counts = {
        code: per_wave / (_WAVELENGTH_M * 1e3 * 0.5) for code, per_wave in _RESOLUTIONS.items()
    }
    code = next((code for code, per_mm in counts.items() if largest_mm * per_mm < _NO_DATA), None)
    if code is None:
        raise errors.InputError(
            f"--format zygo-dat: holds heights up to 166 mm, not {largest_mm:.0f} mm"
        )
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
    heights = seen.top_down(counts[code], _NO_DATA).astype(">i4")
    return bytes(header) + heights.tobytes(), 1 / counts[code]


def _zygo_xyz(seen: ExportedMap, _: object) -> Written:
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
    um = 1e3 * seen.height_mm[::-1]
    points = (
        f"{j} {i} {value:.6f}" if value == value else f"{j} {i} No Data"
        for i, row in enumerate(um.tolist())
        for j, value in enumerate(row)
    )
    return ("\n".join([*head, *points]) + "\n#\n").encode(), 1e-9


def _codev_int(seen: ExportedMap, _: object) -> Written:
    """Code V's grid interferogram of a surface: whole numbers of 16 bits, SSZ of them a wavelength
    of 1 µm.
    """
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


def _fits_file(seen: ExportedMap, _: object) -> Written:
    """FITS: path difference, mask and height."""
    return fits_bytes(seen.x_mm, seen.y_mm, seen.height_mm, seen.removed), None


_WRITERS: dict[str, tuple[str, Callable[[ExportedMap, dict[str, Any] | None], Written]]] = {
    "zygo-dat": (".dat", _zygo_dat),
    "zygo-xyz": (".xyz", _zygo_xyz),
    "codev-int": (".int", _codev_int),
    "h5": (".h5", _write_hdf5),
    "fits": (".fits", _fits_file),
}
