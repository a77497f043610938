"""The command `export-figure`: a measured height map in the formats of other programs."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.measure.export_formats import SUFFIXES, write_map
from membrane_ctrl.measure.exported_map import (
    REMOVABLE,
    ExportedMap,
    fit_fringe_terms,
    read_result,
    remove_parts,
)
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model import errors, files
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

_TERM_SETS = ("noll", "osa", "fringe")


def export_command(
    result: Path, form: str, remove: str = "", terms: str = "", out: Path | None = None
) -> int:
    """Write a result's height map, and a table of its Zernike terms.

    Parameters
    ----------
    result : Path
        Folder of the result.
    form : str
        Format, one of `SUFFIXES`.
    remove : str
        Parts to remove, separated by commas.
    terms : str
        Set of the terms: "noll", "osa" or "fringe"; empty: no table.
    out : Path, optional
        File to write, by default `figure` in the result's folder.

    Returns
    -------
    int
        Exit code.

    Raises
    ------
    InputError
        An option or the result is not valid.
    """
    # Options that are not valid are refused before anything is read.
    if form not in SUFFIXES:
        raise errors.InputError(f"--format {form}: give one of {', '.join(SUFFIXES)}")
    if terms and terms not in _TERM_SETS:
        raise errors.InputError(f"--zernike {terms}: give one of {', '.join(_TERM_SETS)}")
    seen, table = read_result(result)
    names = [name for name in remove.split(",") if name]
    if unknown := [name for name in names if name not in (*REMOVABLE, "sphere")]:
        raise errors.InputError(
            f"--remove {unknown[0]}: give piston, tilt, power or sphere, separated by commas"
        )

    # The table of the whole height; then the map without the named parts.
    zernike_table = None
    if terms:
        zernike_table = _zernike_table(terms, seen, table, result)
    seen = remove_parts(seen, names)

    # Map and table, each complete before it has its name.
    target = result.resolve() / f"figure{SUFFIXES[form]}"
    if out:
        target = files.resolve_user_path(out)
    with errors.convert_write_errors(target):
        data, step_mm = write_map(form, seen, zernike_table)
        files.write_bytes_atomic(target, data)
        if zernike_table is not None and form != "h5":
            beside = target.with_name(target.name + ".zernike.json")
            files.write_text_atomic(beside, json.dumps(zernike_table, indent=1))

    # What was written.
    step = ""
    if step_mm:
        step = f", heights in steps of {1e6 * step_mm:.3g} nm"
    rows, columns = seen.height_mm.shape
    print(
        f"{target}: {columns} x {rows} cells of {seen.pitch_mm:.4g} mm, {seen.removed} "
        f"removed{step}"
    )
    return 0


def _zernike_table(
    index: str, seen: ExportedMap, table: dict[str, Any], where: Path
) -> dict[str, Any]:
    """Terms of the whole height in one set; Noll's are the result's own, Fringe's are fitted to the
    map.
    """
    if index == "fringe":
        first = 1
        normalisation = "peak"
        radius_mm = seen.radius_mm
        orders = [zernike.fringe_set_orders(j + 1) for j in range(zernike.FRINGE_TERMS)]
        fit = fit_fringe_terms(seen, zernike.FRINGE_TERMS)
        coeffs_um = 1e3 * fit.coefficients(seen.height_mm)
    else:
        first = 1
        normalisation = "rms"
        orders = [zernike.noll_orders(j + 1) for j in range(ZERNIKE_TERMS)]
        coeffs_um, radius_mm = _read_own_terms(table, where)
        if index == "osa":
            first = 0
            orders = sorted(orders)
            coeffs_um = zernike.osa_from_noll(coeffs_um)
    return {
        "index": index,
        "first": first,
        "normalisation": normalisation,
        "radius_mm": radius_mm,
        "centre_mm": [0.0, 0.0],
        "of": "the whole height, nothing removed",
        "n_m": [list(order) for order in orders],
        "coeffs_um": coeffs_um.tolist(),
    }


def _read_own_terms(table: dict[str, Any], where: Path) -> tuple[FloatArray, float]:
    """Noll coefficients (terms,) in µm and the disc's radius of a result. Raises InputError."""
    own = table.get("zernike")
    own = own if isinstance(own, dict) else {}
    try:
        coeffs_um = np.array(own.get("coeffs_um"), float)
        radius_mm = float(own.get("radius_mm", math.nan))
    except (TypeError, ValueError):
        coeffs_um = np.zeros(0)
        radius_mm = math.nan
    is_complete = coeffs_um.shape == (ZERNIKE_TERMS,) and bool(np.isfinite(coeffs_um).all())
    if not is_complete or not radius_mm > 0:
        wanted = f"needs {ZERNIKE_TERMS} coefficients (it has {coeffs_um.size}) and a radius"
        raise errors.InputError(f"{where / 'result.json'}: zernike: {wanted}")
    return coeffs_um, radius_mm
