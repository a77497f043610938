"""The figure over a run: the paper's half-hour analysis, for any hold."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import BoolArray, Column
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.review.statistics.drift import FittedSlope, fit_slope
from membrane_ctrl.run_files.shapes import Shapes, make_height_basis

MAP_PX = 128

# Monitored points on the unit disc: within the analysis area, at three radii and azimuths (the
# paper gives A, B and C only in a figure).
POINTS: dict[str, tuple[float, float]] = {"A": (0.0, 0.3), "B": (-0.52, -0.3), "C": (0.74, -0.43)}
PAIRS_S = (60.0, 600.0)
# Slopes are fitted to means over enough cycles to leave at most this many values.
_SLOPE_VALUES = 5000
_LEAST_CYCLES = 3


@dataclass(frozen=True, slots=True)
class CyclePair:
    """Two cycles some time apart."""

    first_s: float
    lag_s: float
    change_um: Column  # (MAP_PX, MAP_PX): height change; NaN outside the analysis area
    sigma_um: Column | None  # (MAP_PX, MAP_PX): 1 sigma of that change from both covariances
    rms_um: float  # over the area
    mean_sigma_um: float
    all_rms_um: float  # RMS change of all pairs this far apart
    pairs: int  # their number


@dataclass(frozen=True, slots=True)
class ShapeReview:
    """Figure of a held mirror over the run."""

    # (n,): of the cycles used: settled and not rejected; the first is what changes refer to
    time_s: Column
    cycles: int  # of the run
    rejected: int
    points_um: dict[str, Column]  # (n,) change of height at `POINTS` against the first cycle
    sd_um: Column  # (MAP_PX, MAP_PX): standard deviation of the height
    mean_sd_um: float  # mean over the area
    drift_um_per_hour: tuple[FittedSlope, ...]  # of Z2 and all terms above
    sag_um: Column  # (n,): changes by camera and by laser since the first cycle
    laser_um: Column  # (n,)
    disagreement: FittedSlope  # of sag by the camera minus laser: the mount's drift, or the films'
    pairs: tuple[CyclePair, ...]


def review_shapes(shapes: Shapes, held: BoolArray, analysis_share: float) -> ShapeReview | None:
    """Review of the cycles; None when fewer than three held ones are good.

    Parameters
    ----------
    shapes : Shapes
        All of the run.
    held : (n,) array of bool
        Which cycles fell into a settled hold.
    analysis_share : float
        Radius of the analysis area over the mirror's.
    """
    # The settled cycles with a usable figure; all changes refer to the first
    good = shapes.select_cycles(
        held & (shapes.verdict != "rejected") & np.isfinite(shapes.coeffs_um).all(axis=1)
    )
    if len(good) < _LEAST_CYCLES:
        return None
    area = _Area(analysis_share)
    parameters = good.parameters_um()
    parameters -= parameters[0].copy()
    # Standard deviation of the height at each pixel, from the covariance of the parameters over the
    # cycles
    sd_um = np.sqrt(np.maximum(_quadratic_form(area.basis, np.cov(parameters.T)), 0.0))
    # Height of the monitored points over time, and the sag by camera and by laser
    x, y = (np.array([point[axis] for point in POINTS.values()]) for axis in (0, 1))
    points = parameters @ make_height_basis(x, y)
    sag_um = good.sag_um - good.sag_um[0]
    laser_um = good.displacement_um - good.displacement_um[0]
    return ShapeReview(
        time_s=good.time_s,
        cycles=len(shapes),
        rejected=int((shapes.verdict == "rejected").sum()),
        points_um=dict(zip(POINTS, points.T, strict=True)),
        sd_um=area.make_map(sd_um),
        mean_sd_um=float(sd_um.mean()),
        drift_um_per_hour=tuple(_fit_slope(good.time_s, term) for term in good.coeffs_um[:, 1:].T),
        sag_um=sag_um,
        laser_um=laser_um,
        disagreement=_fit_slope(good.time_s, sag_um - laser_um),
        pairs=tuple(
            pair
            for lag_s in PAIRS_S
            if (pair := _choose_pair(good, parameters, area, lag_s)) is not None
        ),
    )


class _Area:
    """The pixels of a map inside the analysis area, and what a unit
    of each parameter does there.
    """

    def __init__(self, share: float) -> None:
        axis = (np.arange(MAP_PX) + 0.5) * 2 / MAP_PX - 1
        x, y = np.meshgrid(axis, -axis)
        self._inside = np.hypot(x, y) <= share
        self.basis = make_height_basis(x[self._inside], y[self._inside])
        self.gram = self.basis @ self.basis.T / self.basis.shape[1]

    def make_map(self, values: Column) -> Column:
        picture = np.full((MAP_PX, MAP_PX), np.nan)
        picture[self._inside] = values
        return picture


def _choose_pair(good: Shapes, parameters: Column, area: _Area, lag_s: float) -> CyclePair | None:
    """The pair nearest to the run's middle, and the RMS of all pairs as far apart (within half a
    cycle).
    """
    # For each cycle, the one that comes `lag_s` later, to half a cycle.
    time_s = good.time_s
    half_s = 0.5 * float(np.median(np.diff(time_s)))
    other = np.searchsorted(time_s, time_s + lag_s - half_s)
    other = np.minimum(other, time_s.size - 1)
    is_pair = np.abs(time_s[other] - time_s - lag_s) <= 1.1 * half_s
    firsts = np.flatnonzero(is_pair)
    if not firsts.size:
        return None

    # RMS over the area of the change in each pair: d^T G d with the mean products G of the basis.
    changes = parameters[other[firsts]] - parameters[firsts]
    mean_squares = np.einsum("ij,jk,ik->i", changes, area.gram, changes)
    all_rms = np.sqrt(np.maximum(mean_squares, 0.0))

    # The pair nearest to the middle, and its map with a standard deviation.
    middle_s = time_s[[0, -1]].mean()
    distance_s = np.abs(time_s[firsts] + lag_s / 2 - middle_s)
    first = int(firsts[np.argmin(distance_s)])
    second = int(other[first])
    change_um = (parameters[second] - parameters[first]) @ area.basis
    covariances = [good.covariance_near(float(time_s[k])) for k in (first, second)]
    sigma_um = None
    if covariances[0] is not None and covariances[1] is not None:
        variance = _quadratic_form(area.basis[:ZERNIKE_TERMS], covariances[0] + covariances[1])
        sigma_um = np.sqrt(np.maximum(variance, 0.0))
    return CyclePair(
        first_s=float(time_s[first]),
        lag_s=float(time_s[second] - time_s[first]),
        change_um=area.make_map(change_um),
        sigma_um=None if sigma_um is None else area.make_map(sigma_um),
        rms_um=float(np.sqrt((change_um**2).mean())),
        mean_sigma_um=float("nan") if sigma_um is None else float(sigma_um.mean()),
        all_rms_um=float(np.sqrt((all_rms**2).mean())),
        pairs=int(firsts.size),
    )


def _quadratic_form(basis: Column, covariance: Column) -> Column:
    """b' C b at each point (column of the basis)."""
    return np.asarray(np.einsum("jp,jp->p", basis, covariance @ basis))


def _fit_slope(time_s: Column, values: Column) -> FittedSlope:
    every = max(1, time_s.size // _SLOPE_VALUES)
    whole = time_s.size // every * every
    means = [part[:whole].reshape(-1, every).mean(axis=1) for part in (time_s, values)]
    return fit_slope(means[0], means[1])
