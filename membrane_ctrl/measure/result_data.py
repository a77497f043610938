"""Results of `measure` and of `stability` as labelled data: pandas frames and xarray datasets."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from membrane_ctrl.measure.exported_map import ExportedMap, read_result
from membrane_ctrl.measure.result_files import read_arrays
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model import errors, files, plain_json
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.optional import import_optional
from membrane_ctrl.model.zernike_terms import NOLL_INDICES, ZERNIKE_TERMS, zernike_columns

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_CELLS_MAX = 4_000_000
_SERIES_BYTES_MAX = 500_000_000  # a year of sets every minute
_SIGMAS = {
    "sigma_um": "1 sigma of the height",
    "sigma_noise_um": "1 sigma of the height, from this set itself",
    "sigma_geometry_um": "1 sigma of the height, from what all sets of the bench share",
}


@dataclass(frozen=True)
class MeasuredResult:
    """A result folder of `measure`.

    Attributes
    ----------
    folder : Path
    table : dict
        `result.json`.
    height : ExportedMap
        The height map.
    sigma_mm : (2, N) array
        Axes x and y of the maps of standard deviations.
    sigmas_um : dict of (N, N) array
        Standard deviations of the height, by name; empty without a stated uncertainty.
    """

    folder: Path
    table: dict[str, Any]
    height: ExportedMap
    sigma_mm: FloatArray
    sigmas_um: dict[str, FloatArray]

    def to_pandas(self) -> pd.DataFrame:
        """Zernike terms: `n`, `m`, `coeffs_um` and `sigma_um` by Noll's index."""
        orders = np.array([zernike.noll_orders(j) for j in NOLL_INDICES])
        columns = {
            "n": orders[:, 0],
            "m": orders[:, 1],
            "coeffs_um": self._coeffs_um(),
            "sigma_um": self._sigma_um(),
        }
        pandas = import_optional("pandas", "data", "a frame")
        return pandas.DataFrame(columns, index=pandas.Index(NOLL_INDICES, name="noll"))

    def to_xarray(self) -> xr.Dataset:
        """Height along `y_mm` and `x_mm`, its standard deviations on their own grid, coefficients
        along `noll`.
        """
        variables: dict[str, Any] = {
            "height_mm": (
                ("y_mm", "x_mm"),
                self.height.height_mm,
                _make_axis_labels("mm", "height above the vertex"),
            ),
            "coeffs_um": (
                "noll",
                self._coeffs_um(),
                _make_axis_labels("µm", "Zernike coefficients, orthonormal"),
            ),
            "coeffs_sigma_um": (
                "noll",
                self._sigma_um(),
                _make_axis_labels("µm", "1 sigma of the coefficients"),
            ),
        }
        for name, values in self.sigmas_um.items():
            variables[name] = (
                ("sigma_y_mm", "sigma_x_mm"),
                values,
                _make_axis_labels("µm", _SIGMAS[name]),
            )
        coordinates: dict[str, Any] = {
            "x_mm": self.height.x_mm,
            "y_mm": self.height.y_mm,
            "noll": NOLL_INDICES,
        }
        if self.sigmas_um:
            coordinates |= {"sigma_x_mm": self.sigma_mm[0], "sigma_y_mm": self.sigma_mm[1]}
        xarray = import_optional("xarray", "data", "a dataset")
        return xarray.Dataset(variables, coords=coordinates, attrs=self._describe_source())

    def _coeffs_um(self) -> FloatArray:
        return _read_coefficients(self.table, "zernike")

    def _sigma_um(self) -> FloatArray:
        return _read_coefficients(self.table, "uncertainty")

    def _describe_source(self) -> dict[str, str | float]:
        quality, terms = (_require_table(self.table, name) for name in ("quality", "zernike"))
        texts = {key: str(self.table.get(key, "")) for key in ("schema", "program", "commit")}
        about = {
            "verdict": str(quality.get("verdict", "")),
            "reason": str(quality.get("reason", "")),
        }
        radius_mm = terms.get("radius_mm")
        return (
            texts
            | about
            | {"zernike_radius_mm": radius_mm if isinstance(radius_mm, float) else math.nan}
        )


def open_result(folder: str | Path) -> MeasuredResult:
    """Open a result folder of `measure`. Raises InputError."""
    folder = Path(folder)
    height, table = read_result(folder)
    path = folder / "sigma.npz"
    if not path.exists():
        return MeasuredResult(folder, table, height, np.empty((2, 0)), {})
    try:
        x_mm, y_mm, *maps = read_arrays(path, ("x_mm", "y_mm", *_SIGMAS), _CELLS_MAX)
    except (OSError, ValueError) as error:
        raise errors.InputError(f"{path}: {error}") from None
    if any(values.shape != (y_mm.size, x_mm.size) for values in maps) or x_mm.size != y_mm.size:
        raise errors.InputError(f"{path}: its maps have not the shape of y_mm and x_mm")
    return MeasuredResult(
        folder, table, height, np.stack([x_mm, y_mm]), dict(zip(_SIGMAS, maps, strict=True))
    )


@dataclass(frozen=True)
class StabilityResult:
    """A result folder of `stability`.

    Attributes
    ----------
    folder : Path
    table : dict
        `stability.json`.
    """

    folder: Path
    table: dict[str, Any]

    def to_pandas(self, table: Literal["series", "pairs"] = "series") -> pd.DataFrame:
        """One row a set by its name (`series`), or one row a pair of sets (`pairs`). Raises
        InputError.
        """
        pandas = import_optional("pandas", "data", "a frame")
        path = self.folder / f"{table}.csv"
        names = ["set"] if table == "series" else ["earlier", "later"]
        try:
            data = files.read_bytes(path, _SERIES_BYTES_MAX)
            frame = pandas.read_csv(
                io.BytesIO(data), dtype=dict.fromkeys([*names, "verdict", "reason"], str)
            )
            if table == "series":
                return frame.set_index("set")
            return frame
        except (OSError, ValueError, KeyError) as error:
            raise errors.InputError(f"{path}: {error}") from None

    def to_xarray(self) -> xr.Dataset:
        """Numbers along `set`, coefficients also along `noll`, and the map `sd_um` of standard
        deviations.
        """
        xarray = import_optional("xarray", "data", "a dataset")
        series = self.to_pandas()
        terms = [name for name in zernike_columns() if name in series]
        variables: dict[str, Any] = {
            name: ("set", series[name].to_numpy())
            for name in series.columns
            if name not in zernike_columns()
        }
        variables |= {
            name: ("set", series[name].fillna("").to_numpy(str)) for name in ("verdict", "reason")
        }
        coordinates: dict[str, Any] = {"set": series.index.to_numpy(str)}
        if len(terms) == ZERNIKE_TERMS:
            variables["coeffs_um"] = (("set", "noll"), series[terms].to_numpy())
            coordinates["noll"] = NOLL_INDICES
        path = self.folder / "sd.npz"
        if path.exists():
            try:
                x_mm, y_mm, sd_um = read_arrays(path, ("x_mm", "y_mm", "sd_um"), _CELLS_MAX)
            except (OSError, ValueError) as error:
                raise errors.InputError(f"{path}: {error}") from None
            variables["sd_um"] = (
                ("y_mm", "x_mm"),
                sd_um,
                _make_axis_labels("µm", "standard deviation of the height"),
            )
            coordinates |= {"x_mm": x_mm, "y_mm": y_mm}
        about = {key: str(self.table.get(key, "")) for key in ("schema", "program", "commit")}
        try:
            return xarray.Dataset(variables, coords=coordinates, attrs=about)
        except ValueError as error:
            raise errors.InputError(f"{self.folder}: {error}") from None


def open_stability(folder: str | Path) -> StabilityResult:
    """Open a result folder of `stability`. Raises InputError."""
    path = Path(folder) / "stability.json"
    try:
        table = plain_json.loads(files.read_text(path))
    except (OSError, ValueError) as error:
        raise errors.InputError(f"{path}: {error}: is it a result of stability?") from None
    if not isinstance(table, dict):
        raise errors.InputError(f"{path}: not a JSON object")
    return StabilityResult(Path(folder), table)


def _make_axis_labels(unit: str, meaning: str) -> dict[str, str]:
    return {"units": unit, "long_name": meaning}


def _require_table(table: dict[str, Any], name: str) -> dict[str, Any]:
    found = table.get(name)
    if isinstance(found, dict):
        return found
    return {}


def _read_coefficients(table: dict[str, Any], name: str) -> FloatArray:
    """(terms,) the coefficients of a block; NaN where there are none."""
    found = _require_table(table, name).get("coeffs_um")
    try:
        numbers = np.array(found, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape == (ZERNIKE_TERMS,):
        return numbers
    return np.full(ZERNIKE_TERMS, np.nan)
