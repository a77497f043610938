"""The command `export-figure`: a measured height map in the formats of other programs."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.measure.export_formats import WRITERS
from membrane_ctrl.measure.exported_map import (
    REMOVABLE,
    ExportedMap,
    fit_fringe_terms,
    read_result,
    remove_parts,
)
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model import errors, files
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS


def export_command(
    result: Path, form: str, remove: str = "", terms: str = "", out: Path | None = None
) -> int:
    """Write a result's height map, and a table of its Zernike terms if `terms` names a set. Raises
    InputError.
    """
    if form not in WRITERS:
        raise errors.InputError(f"--format {form}: give one of {', '.join(WRITERS)}")
    if terms and terms not in ("noll", "osa", "fringe"):
        raise errors.InputError(f"--zernike {terms}: give one of noll, osa, fringe")
    seen, table = read_result(result)
    names = [name for name in remove.split(",") if name]
    if unknown := [name for name in names if name not in (*REMOVABLE, "sphere")]:
        raise errors.InputError(
            f"--remove {unknown[0]}: give piston, tilt, power or sphere, separated by commas"
        )
    zernike_table = _zernike_table(terms, seen, table, result) if terms else None
    seen = remove_parts(seen, names)
    suffix, write = WRITERS[form]
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


def _zernike_table(
    index: str, seen: ExportedMap, table: dict[str, Any], where: Path
) -> dict[str, Any]:
    """Terms of the whole height in one set; Noll's are the result's own, Fringe's are fitted to the
    map.
    """
    if index == "fringe":
        coeffs = 1e3 * fit_fringe_terms(seen, zernike.FRINGE_TERMS).coefficients(seen.height_mm)
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
