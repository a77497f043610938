"""The measured figure over a run: coefficients, their covariance, heights anywhere on the mirror."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from membrane_ctrl.metrology.optics import zernike
from membrane_ctrl.metrology.optics.surface import Surface
from membrane_ctrl.model import shape_estimate
from membrane_ctrl.model.arrays import AnyArray, Column
from membrane_ctrl.model.zernike_terms import FIRST_FIGURE_INDEX, ZERNIKE_TERMS, zernike_columns


@dataclass(frozen=True, slots=True)
class Shapes:
    """Cycles in order; arrays (n,) unless stated otherwise, NaN where nothing was recorded.

    Attributes
    ----------
    time_s, sag_um, sag_sigma_um, displacement_um, slope_residual_urad, valid_fraction, latency_s, hencky_um : array
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
    sag_sigma_um: Column
    displacement_um: Column
    slope_residual_urad: Column
    valid_fraction: Column
    latency_s: Column
    verdict: NDArray[np.str_]
    covariance_time_s: Column
    covariance_um2: Column

    def __len__(self) -> int:
        return int(self.time_s.size)

    def select(self, wanted: NDArray[np.bool_]) -> Shapes:
        """The cycles for which `wanted` (n,) is true, with all covariances."""
        if wanted.all():
            return self  # a month of 36 coefficients is 190 MB
        parts = {name: getattr(self, name)[wanted] for name in (*NUMBERS, "coeffs_um", "verdict")}
        return Shapes(**parts, covariance_time_s=self.covariance_time_s, covariance_um2=self.covariance_um2)

    def columns(self) -> dict[str, Column | NDArray[np.str_]]:
        """Columns of a table with one row per cycle: time, terms from Z1, sag, quality, verdict."""
        coeffs = dict(zip(zernike_columns(), np.ascontiguousarray(self.coeffs_um.T), strict=True))
        numbers = {name: getattr(self, name) for name in NUMBERS}
        return {"time_s": self.time_s} | coeffs | numbers | {"verdict": self.verdict}

    def heights_um(self, x: Column, y: Column) -> Column:
        """(n, points) height above the vertex at points of the unit disc (mirror radius 1), um."""
        return self.parameters_um() @ height_basis(x, y)

    def parameters_um(self) -> Column:
        """(n, terms + 1): the coefficients and the amplitude of the additional Hencky part."""
        return np.column_stack((self.coeffs_um, self.hencky_um))

    def covariance_near(self, time_s: float) -> Column | None:
        """Covariance (terms, terms) in um^2 recorded nearest to a time; None if there is none."""
        if not self.covariance_time_s.size:
            return None
        return np.asarray(self.covariance_um2[np.argmin(np.abs(self.covariance_time_s - time_s))])


NUMBERS = (
    "time_s", "hencky_um", "sag_um", "sag_sigma_um", "displacement_um", "slope_residual_urad", "valid_fraction",
    "latency_s",
)  # fmt: skip


def height_basis(x: Column, y: Column) -> Column:
    """(terms + 1, points): height above the vertex per unit of each parameter."""
    units = np.eye(ZERNIKE_TERMS + 1)
    return np.stack([Surface(unit[:-1], unit[-1], 1.0).height(x, y) for unit in units])


# Columns read from the recorder's table.
TABLE_COLUMNS = (*NUMBERS, "verdict", "coeffs_um", "covariance_um2")


def from_table(table: pa.Table) -> Shapes:
    """Shapes from the recorder's table, whatever columns it has."""
    count = table.num_rows
    kept, covariances = _covariances(table)
    time_s = _numbers(table, "time_s")
    coeffs = table.column("coeffs_um").combine_chunks() if "coeffs_um" in table.column_names else None
    return Shapes(
        **{name: _numbers(table, name) for name in NUMBERS},
        coeffs_um=np.full((count, ZERNIKE_TERMS), np.nan) if coeffs is None else _matrix(coeffs, count),
        verdict=np.array(table.column("verdict").to_pylist() if "verdict" in table.column_names else ["ok"] * count),
        covariance_time_s=time_s[kept],
        covariance_um2=covariances,
    )


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


def estimates(table: pa.Table) -> Iterator[shape_estimate.ShapeEstimate]:
    """The estimates in the recorder's table, as given to the controller. Raises ValueError if they are invalid."""
    names = ESTIMATE_COLUMNS[:-2]
    heads = zip(*(table.column(name).to_pylist() for name in names), strict=True)
    coeffs = _matrix(table.column("coeffs_um").combine_chunks(), table.num_rows)
    uppers = table.column("upper_um2").combine_chunks().flatten().to_numpy().reshape(table.num_rows, -1)
    for head, row, upper in zip(heads, coeffs, uppers, strict=True):
        named = dict(zip(names, head, strict=True))
        yield shape_estimate.unpack_estimate(shape_estimate.packed_parts(named, row, upper))


def from_columns(columns: Mapping[str, Column]) -> Shapes:
    """Shapes from a Rerun segment (`rrd_reader.read_shapes`), which lacks the Hencky part and the covariance."""
    count = columns["time_s"].size if columns else 0
    numbers = {name: columns.get(name, np.full(count, np.nan)) for name in NUMBERS}
    return Shapes(
        **{**numbers, "hencky_um": np.zeros(count)},
        coeffs_um=columns.get("coeffs_um", np.empty((0, ZERNIKE_TERMS))),
        verdict=np.array(["ok"] * count),
        covariance_time_s=np.empty(0),
        covariance_um2=np.empty((0, ZERNIKE_TERMS, ZERNIKE_TERMS)),
    )


def joined(parts: list[Shapes]) -> Shapes:
    """Concatenate shapes, each cycle once."""
    if not parts:
        return from_columns({})
    names = (*NUMBERS, "coeffs_um", "verdict", "covariance_time_s", "covariance_um2")
    whole = Shapes(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
    # a journal may repeat rows that the recorder wrote just before it was killed
    until_s = np.maximum.accumulate(np.concatenate(([-np.inf], whole.time_s)))[:-1]
    return whole.select(whole.time_s > until_s)


def _numbers(table: pa.Table, name: str) -> Column:
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(table.column(name).to_numpy(), dtype=np.float64)


def _matrix(cells: pa.Array, count: int) -> Column:
    return np.asarray(cells.flatten().to_numpy(zero_copy_only=False), dtype=np.float64).reshape(count, ZERNIKE_TERMS)


def _covariances(table: pa.Table) -> tuple[NDArray[np.int64], Column]:
    """Rows with a covariance, and the (k, terms, terms) matrices."""
    if "covariance_um2" not in table.column_names:
        return np.empty(0, dtype=np.int64), np.empty((0, ZERNIKE_TERMS, ZERNIKE_TERMS))
    cells = table.column("covariance_um2").combine_chunks()
    lengths = np.diff(np.asarray(cells.offsets))
    values = np.asarray(cells.flatten(), dtype=np.float64)
    whole = lengths == ZERNIKE_TERMS**2
    return np.flatnonzero(whole), values[np.repeat(whole, lengths)].reshape(-1, ZERNIKE_TERMS, ZERNIKE_TERMS)


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

Map = NDArray[np.float32]

MAP_PX = 96  # far finer than what the terms can change over


def height_map_mm(estimate: shape_estimate.ShapeEstimate) -> Map:
    """Height over the mirror's disc, above the vertex.

    Returns
    -------
    (MAP_PX, MAP_PX) float32
        mm; row 0 at the top (+y), NaN outside the disc.
    """
    return _spread(_surface(estimate).height(*_points()))


def difference_map_um(estimate: shape_estimate.ShapeEstimate, reference: shape_estimate.ShapeEstimate) -> Map:
    """Height minus that of the reference, each above its own vertex; um, as `height_map_mm`."""
    change_um = estimate.coeffs_um - reference.coeffs_um
    return change_map_um(np.append(change_um, estimate.hencky_um - reference.hencky_um))


def change_map_um(parameters_um: Column) -> Map:
    """Height of a change of the parameters (`Shapes.parameters_um`), um, as `height_map_mm`."""
    return _spread(parameters_um @ _basis())


def deviation_map_um(parameters_um: Column) -> Map:
    """Standard deviation of the height over at least two cycles with (n, terms + 1) parameters, um."""
    variance = np.einsum("jp,jp->p", _basis(), np.cov(parameters_um.T) @ _basis())
    return _spread(np.sqrt(np.maximum(variance, 0.0)))


def without_terms(height: AnyArray, terms: int) -> AnyArray:
    """A square map of the unit disc less the best fit of the first terms, at most 4, to its finite pixels.

    3 terms are piston and tilt, 4 defocus as well.
    """
    there = np.isfinite(height)
    x, y = (axis[there] for axis in _grid(len(height)))
    # spans the same as the Zernike terms, which take 70 ms
    basis, left = np.stack((np.ones_like(x), x, y, x**2 + y**2))[:terms], height.copy()
    left[there] -= np.linalg.lstsq(basis.T, height[there].astype(np.float64), rcond=None)[0] @ basis
    return left


def uncertainty_map_um(covariance_um2: NDArray[np.float64]) -> Map:
    """Standard deviation of the height, um: sqrt of z C z' with the row z of the terms at each point."""
    variance = np.einsum("jp,jp->p", _terms(), covariance_um2 @ _terms())
    return _spread(np.sqrt(np.maximum(variance, 0.0)))


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
        """Standard deviation of the height, um; zero for one cycle."""
        return uncertainty_map_um(self._squares / max(self.count - 1, 1))


def outside_disc() -> NDArray[np.uint8]:
    """1 where a map has no value, (MAP_PX, MAP_PX)."""
    return (~_inside()).astype(np.uint8)


def _surface(estimate: shape_estimate.ShapeEstimate) -> Surface:
    """The surface over the unit disc: maps do not depend on the mirror's size."""
    return Surface(estimate.coeffs_um * 1e-3, estimate.hencky_um * 1e-3, 1.0)


def _spread(values: NDArray[np.float64]) -> Map:
    picture = np.full((MAP_PX, MAP_PX), np.nan, dtype=np.float32)
    picture[_inside()] = values
    return picture


@cache
def _basis() -> NDArray[np.float64]:
    """(terms + 1, points) height per unit of each parameter."""
    return height_basis(*_points())


@cache
def _inside() -> NDArray[np.bool_]:
    x, y = _grid()
    return np.asarray(np.hypot(x, y) <= 1.0)


@cache
def _points() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = _grid()
    return x[_inside()], y[_inside()]


@cache
def _terms() -> NDArray[np.float64]:
    """(terms, points) the Zernike terms."""
    return zernike.values(*_points())


def _grid(px: int = MAP_PX) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixel centres on the unit disc's square."""
    axis = (np.arange(px) + 0.5) * 2 / px - 1
    x, y = np.meshgrid(axis, -axis)
    return x, y
