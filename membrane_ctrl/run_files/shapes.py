"""The measured figure over a run: coefficients, their covariance,
heights anywhere on the mirror.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model import shape_estimate
from membrane_ctrl.model.arrays import AnyArray, Column
from membrane_ctrl.model.zernike_terms import FIRST_FIGURE_INDEX, ZERNIKE_TERMS, zernike_columns

NUMBERS = (
    "time_s",
    "hencky_um",
    "sag_um",
    "sag_change_sigma_um",
    "displacement_um",
    "slope_residual_urad",
    "valid_fraction",
    "latency_s",
)
# Columns read from the recorder's tables.
TABLE_COLUMNS = (*NUMBERS, "verdict", "coeffs_um")
# All columns of an estimate.
ESTIMATE_COLUMNS = (
    *shape_estimate.NUMBERS,
    "cycle",
    "tracking_lost",
    "kind",
    "verdict",
    "reason",
    "coeffs_um",
    "upper_um2",
)
BARS_PATH = "/shape/change_bars"
WATERFALL_PATH = "/shape/waterfall"
WATERFALL_TERMS = slice(FIRST_FIGURE_INDEX - 1, None)  # tilts are hundreds of times larger
# The maps below `/shape/map/`, and their names for people.
MAPS = {
    "height": "height",
    "difference": "change",
    "difference_no_tilt": "less piston, tilt",
    "difference_no_defocus": "less piston, tilt, defocus",
    "scatter": "standard deviation",
    "uncertainty": "noise of a cycle, 1σ",
}
MAP_PX = 96  # far finer than what the terms can change over
Map = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Shapes:
    """Cycles in order; arrays (n,) unless stated otherwise, NaN where nothing was recorded.

    Attributes
    ----------
    time_s, hencky_um, sag_um, sag_change_sigma_um, displacement_um : array
        As in `ShapeEstimate`.
    slope_residual_urad, valid_fraction, latency_s : array
        As in `ShapeEstimate`.
    coeffs_um : (n, terms) array
    verdict : (n,) array of str
    covariance_time_s : (k,) array
        Times of the cycles with a recorded covariance.
    covariance_um2 : (k, terms, terms) array
    """

    time_s: Column
    coeffs_um: Column
    hencky_um: Column
    sag_um: Column
    sag_change_sigma_um: Column
    displacement_um: Column
    slope_residual_urad: Column
    valid_fraction: Column
    latency_s: Column
    verdict: NDArray[np.str_]
    covariance_time_s: Column
    covariance_um2: Column

    def __len__(self) -> int:
        return int(self.time_s.size)

    def select_cycles(self, wanted: NDArray[np.bool_]) -> Shapes:
        """The cycles for which `wanted` (n,) is true, with all covariances."""
        if wanted.all():
            return self  # a month of 36 coefficients is 190 MB
        parts = {name: getattr(self, name)[wanted] for name in (*NUMBERS, "coeffs_um", "verdict")}
        return Shapes(
            **parts, covariance_time_s=self.covariance_time_s, covariance_um2=self.covariance_um2
        )

    def make_columns(self) -> dict[str, Column | NDArray[np.str_]]:
        """Columns of a table with one row per cycle: time, terms from Z1, sag, quality, verdict."""
        coeffs = dict(zip(zernike_columns(), np.ascontiguousarray(self.coeffs_um.T), strict=True))
        numbers = {name: getattr(self, name) for name in NUMBERS}
        return {"time_s": self.time_s} | coeffs | numbers | {"verdict": self.verdict}

    def heights_um(self, x: Column, y: Column) -> Column:
        """Return the heights of all figures above their vertex at points of the mirror.

        Parameters
        ----------
        x, y : (points,) array
            Points of the unit disc; the mirror's radius is 1.

        Returns
        -------
        (n, points) array
            µm.
        """
        return self.parameters_um() @ make_height_basis(x, y)

    def parameters_um(self) -> Column:
        """(n, terms + 1): the coefficients and the amplitude of the additional Hencky part."""
        return np.column_stack((self.coeffs_um, self.hencky_um))

    def covariance_near(self, time_s: float) -> Column | None:
        """Covariance (terms, terms) in µm^2 recorded nearest to a time; None if there is none."""
        if not self.covariance_time_s.size:
            return None
        return np.asarray(self.covariance_um2[np.argmin(np.abs(self.covariance_time_s - time_s))])


def make_height_basis(x: Column, y: Column) -> Column:
    """Return the height above the vertex per unit of each parameter.

    Parameters
    ----------
    x, y : (points,) array
        Points of the unit disc.

    Returns
    -------
    (terms + 1, points) array
        The last row is that of the Hencky bowl.
    """
    units = np.eye(ZERNIKE_TERMS + 1)
    return np.stack([Surface(unit[:-1], unit[-1], 1.0).height(x, y) for unit in units])


def from_tables(figures: Iterable[pa.Table], covariances: Iterable[pa.Table]) -> Shapes:
    """Shapes from the recorder's tables, by time.

    Parameters
    ----------
    figures : iterable of pyarrow.Table
        With `time_s` (s) and `coeffs_um` (µm); others are left out. Columns that are missing in a
        run of another version are NaN, and a missing verdict is `ok`.
    covariances : iterable of pyarrow.Table
        With `time_s` and `covariance_um2` (terms * terms numbers, µm^2); recorded less often than
        the figures.
    """
    parts = [
        _read_figures(table)
        for table in figures
        if {"time_s", "coeffs_um"} <= set(table.column_names)
    ]
    kept = [table for table in covariances if table.num_columns == 2]
    names = (*NUMBERS, "coeffs_um", "verdict")
    empty: dict[str, Any] = {
        name: np.empty((0, ZERNIKE_TERMS) if name == "coeffs_um" else 0) for name in names
    }
    if parts:
        joined = {name: np.concatenate([part[name] for part in parts]) for name in names}
    else:
        joined = empty
    # Cycles and tracked frames are in two tables: by time they are one series
    order = np.argsort(joined["time_s"], kind="stable")
    matrices = [_to_matrix(table.column("covariance_um2"), ZERNIKE_TERMS**2) for table in kept]
    return Shapes(
        **{name: values[order] for name, values in joined.items()},
        covariance_time_s=np.concatenate(
            [np.empty(0), *(_read_numbers(table, "time_s") for table in kept)]
        ),
        covariance_um2=np.concatenate([np.empty((0, ZERNIKE_TERMS**2)), *matrices]).reshape(
            -1, ZERNIKE_TERMS, ZERNIKE_TERMS
        ),
    )


def _read_figures(table: pa.Table) -> dict[str, AnyArray]:
    count = table.num_rows
    if "verdict" in table.column_names:
        verdicts = table.column("verdict").to_pylist()
    else:
        verdicts = ["ok"] * count
    figures: dict[str, AnyArray] = {name: _read_numbers(table, name) for name in NUMBERS}
    return figures | {
        "coeffs_um": _to_matrix(table.column("coeffs_um"), ZERNIKE_TERMS),
        "verdict": np.array([verdict or "" for verdict in verdicts]),
    }


def read_estimates(table: pa.Table) -> Iterator[shape_estimate.ShapeEstimate]:
    """The estimates in the recorder's table, as given to the controller. Raises ValueError if they
    are invalid.
    """
    names = ESTIMATE_COLUMNS[:-2]
    heads = zip(*(table.column(name).to_pylist() for name in names), strict=True)
    coeffs = _to_matrix(table.column("coeffs_um"), ZERNIKE_TERMS)
    upper_size = table.schema.field("upper_um2").type.list_size
    uppers = _to_matrix(table.column("upper_um2"), upper_size).astype(np.float32)
    for head, row, upper in zip(heads, coeffs, uppers, strict=True):
        named = dict(zip(names, head, strict=True))
        named |= {name: math.nan for name in shape_estimate.NUMBERS if named[name] is None}
        yield shape_estimate.unpack_estimate(shape_estimate.packed_parts(named, row, upper))


def _read_numbers(table: pa.Table, name: str) -> Column:
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(table.column(name).to_numpy(), dtype=np.float64)


def _to_matrix(cells: pa.ChunkedArray, width: int) -> Column:
    """A column of fixed-size lists as (n, width) numbers; a missing list is a row of NaN."""
    if cells.null_count:
        rows = cells.combine_chunks().fill_null([math.nan] * width)
    else:
        rows = cells.combine_chunks()
    return np.asarray(rows.flatten().to_numpy(zero_copy_only=False), dtype=np.float64).reshape(
        -1, width
    )


def height_map_mm(estimate: shape_estimate.ShapeEstimate) -> Map:
    """Height over the mirror's disc, above the vertex.

    Returns
    -------
    (MAP_PX, MAP_PX) float32
        mm; row 0 at the top (+y), NaN outside the disc.
    """
    return _value_range(_unit_surface(estimate).height(*_disc_points()))


def difference_map_um(
    estimate: shape_estimate.ShapeEstimate, reference: shape_estimate.ShapeEstimate
) -> Map:
    """Return the map of a change: height minus that of the reference, each above its own vertex.

    Parameters
    ----------
    estimate, reference : ShapeEstimate
        The two figures.

    Returns
    -------
    (m, m) array
        µm, NaN outside the mirror.
    """
    change_um = estimate.coeffs_um - reference.coeffs_um
    return change_map_um(np.append(change_um, estimate.hencky_um - reference.hencky_um))


def change_map_um(parameters_um: Column) -> Map:
    """Height of a change of the parameters (`Shapes.parameters_um`), µm, as `height_map_mm`."""
    return _value_range(parameters_um @ _height_basis())


def deviation_map_um(parameters_um: Column) -> Map:
    """Standard deviation of the height over at least two cycles with (n, terms + 1) parameters,
    µm.
    """
    variance = np.einsum("jp,jp->p", _height_basis(), np.cov(parameters_um.T) @ _height_basis())
    return _value_range(np.sqrt(np.maximum(variance, 0.0)))


def without_terms(height: AnyArray, terms: int) -> AnyArray:
    """Return a map less the best fit of the first Zernike terms to its finite pixels.

    3 terms are piston and tilt, 4 defocus as well.

    Parameters
    ----------
    height : (m, m) array
        Map of the unit disc; NaN outside it.
    terms : int
        How many, at most 4: 3 are piston and tilt, 4 defocus as well.

    Returns
    -------
    (m, m) array
        In the unit of the map, and NaN where it is.
    """
    finite = np.isfinite(height)
    x, y = (axis[finite] for axis in _disc_grid(len(height)))
    # These span the same as the Zernike terms, which take 70 ms to compute
    basis = np.stack((np.ones_like(x), x, y, x**2 + y**2))[:terms]
    values = height[finite].astype(np.float64)
    coeffs, *_ = np.linalg.lstsq(basis.T, values, rcond=None)
    residual = height.copy()
    residual[finite] -= coeffs @ basis
    return residual


def without_noll_terms(height: AnyArray, indices: Sequence[int]) -> AnyArray:
    """Return a map less the best fit of some Zernike terms to its finite pixels.

    Parameters
    ----------
    height : (m, m) array
        Map of the unit disc, on the grid of this module's maps; NaN where it is not measured.
    indices : sequence of int
        Noll indices of the terms.

    Returns
    -------
    (m, m) array
        In the unit of the map, and NaN where it is.
    """
    there = np.isfinite(height)
    inside = _inside_disc()
    basis = _term_values()[[index - 1 for index in indices]][:, there[inside]]
    left = height.copy()
    coefficients = np.linalg.lstsq(basis.T, height[there].astype(np.float64), rcond=None)[0]
    left[there] -= coefficients @ basis
    return left


def uncertainty_map_um(covariance_um2: NDArray[np.float64]) -> Map:
    """Standard deviation of the height, µm: sqrt of z C z' with the row z of the terms at each
    point.
    """
    variance = np.einsum("jp,jp->p", _term_values(), covariance_um2 @ _term_values())
    return _value_range(np.sqrt(np.maximum(variance, 0.0)))


class Scatter:
    """Covariance of the coefficients over the cycles so far (Welford's update)."""

    def __init__(self) -> None:
        self.count = 0
        self._mean = np.zeros(ZERNIKE_TERMS)
        self._squares = np.zeros((ZERNIKE_TERMS, ZERNIKE_TERMS))

    def add(self, coeffs_um: NDArray[np.float64]) -> None:
        """Add (terms,) coefficients."""
        self.count += 1
        off = coeffs_um - self._mean
        self._mean = self._mean + off / self.count
        self._squares += np.outer(off, coeffs_um - self._mean)

    def map_um(self) -> Map:
        """Standard deviation of the height, µm; zero for one cycle."""
        return uncertainty_map_um(self._squares / max(self.count - 1, 1))


def outside_disc() -> NDArray[np.uint8]:
    """1 where a map has no value, (MAP_PX, MAP_PX)."""
    return (~_inside_disc()).astype(np.uint8)


def _unit_surface(estimate: shape_estimate.ShapeEstimate) -> Surface:
    """The surface over the unit disc: maps do not depend on the mirror's size."""
    return Surface(estimate.coeffs_um * 1e-3, estimate.hencky_um * 1e-3, 1.0)


def _value_range(values: NDArray[np.float64]) -> Map:
    picture = np.full((MAP_PX, MAP_PX), np.nan, dtype=np.float32)
    picture[_inside_disc()] = values
    return picture


@cache
def _height_basis() -> NDArray[np.float64]:
    """(terms + 1, points) height per unit of each parameter."""
    return make_height_basis(*_disc_points())


@cache
def _inside_disc() -> NDArray[np.bool_]:
    x, y = _disc_grid()
    return np.asarray(np.hypot(x, y) <= 1.0)


@cache
def _disc_points() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = _disc_grid()
    return x[_inside_disc()], y[_inside_disc()]


@cache
def _term_values() -> NDArray[np.float64]:
    """(terms, points) the Zernike terms."""
    return zernike.evaluate_terms(*_disc_points())


def _disc_grid(px: int = MAP_PX) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixel centres on the unit disc's square."""
    axis = (np.arange(px) + 0.5) * 2 / px - 1
    x, y = np.meshgrid(axis, -axis)
    return x, y
