"""The metrologist's figure of a height map: best sphere, what deviates from it, and the light at
its focus.

A deviation is counted along the best sphere's normal, positive on the side of its centre for a
concave mirror.

Definitions: ISO 10110-5 and ISO 14999-4 for irregularity, its rotationally invariant part and the
rest; C. Evans, Opt. Eng. 48, 043605 (2009) for PVr. They are applied to the surface, not to a
wavefront.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.figure import best_sphere, star_image
from membrane_ctrl.metrology.figure.surface_map import SurfaceMap
from membrane_ctrl.metrology.numerics import grid_fit, zernike
from membrane_ctrl.metrology.numerics.vectors import vector_lengths
from membrane_ctrl.model.arrays import BoolArray, FloatArray

_FRINGE = [zernike.fringe_set_orders(j) for j in range(1, zernike.FRINGE_TERMS + 1)]
_PVR_TERMS = 36  # by definition, whatever the fit's own number
_RINGS = 96  # knots of the rotationally invariant part: 5 mm on a 1 m mirror
_SEPARABLE = 1e-10  # eigenvalue over the largest, below which knots are without cells
ENERGY_SHARES = (0.5, 0.8, 0.95)  # of the encircled energy
WAVELENGTH_UM = 1000.0  # of the Strehl ratio, unless one is given


@dataclass(frozen=True)
class Quantities:
    """Numbers of a figure; NaN where the surface has none. docs/reference/figure.md defines
    them."""

    radius_of_curvature_mm: float
    focal_length_mm: float  # half of it
    sphere_sag_mm: float
    tilt_x_urad: float
    tilt_y_urad: float
    irregularity_pv_um: float
    irregularity_rms_um: float
    pvr_um: float
    rotational_pv_um: float
    asymmetry_rms_um: float
    slope_rms_urad: float
    best_focus_mm: float
    spot_rms_mm: float
    spot_50_mm: float
    spot_80_mm: float
    spot_95_mm: float
    star_path_rms_um: float
    strehl: float


@dataclass(frozen=True)
class Figure:
    """Numbers of a figure, and the maps that they are computed from.

    Attributes
    ----------
    numbers : Quantities
    sphere : best_sphere.Sphere
    deviation_um : (n, n) array
        Deviation from the best sphere, along its normal; NaN where not measured.
    rotational_um : (n, n) array
        Rotationally invariant part of the deviation.
    smooth_um : (n, n) array
        Fit of 36 Fringe terms to the deviation, everywhere.
    fringe_um : (37,) array
        Fringe terms of the height, peak 1 on the rim of the aperture.
    spot_mm : (rays,) array
        Distance of the reflected rays from their middle in the best focus.
    """

    numbers: Quantities
    sphere: best_sphere.Sphere
    deviation_um: FloatArray
    rotational_um: FloatArray
    smooth_um: FloatArray
    fringe_um: FloatArray
    spot_mm: FloatArray


class FigureOf:
    """Evaluates figures on one grid: the fits are prepared once for the cells that were measured.

    Parameters
    ----------
    seen : SurfaceMap
        A surface with at least `LEAST_CELLS`; any other has the same grid and the same measured
        cells.
    aperture_mm : float
        Radius of the aperture, by which the Fringe terms are counted.
    wavelength_um : float
        Of the Strehl ratio.
    """

    def __init__(
        self, seen: SurfaceMap, aperture_mm: float, wavelength_um: float = WAVELENGTH_UM
    ) -> None:
        self.aperture_mm = aperture_mm
        self.wavelength_um = wavelength_um
        self._mask = np.isfinite(seen.height_mm)
        axis = seen.axis_mm / aperture_mm
        self.fringe = grid_fit.GridFit(axis, self._mask, _FRINGE)
        self._pvr = grid_fit.GridFit(axis, self._mask, _FRINGE[:_PVR_TERMS])
        rows, columns = np.nonzero(self._mask)
        r = np.hypot(seen.axis_mm[rows], seen.axis_mm[columns])
        self._rings = _Rings(r, max(2, min(_RINGS, len(axis) // 4)))

    def __call__(self, seen: SurfaceMap, near: best_sphere.Sphere | None = None) -> Figure:
        """Evaluate the figure of a surface.

        Parameters
        ----------
        seen : SurfaceMap
            On the grid, and with the measured cells, of the first one.
        near : Sphere, optional
            The best sphere of a surface that is nearly the same: saves half of the time.

        Returns
        -------
        Figure
        """
        mask = self._mask
        points = seen.points()

        # Deviation from the best sphere, and normals of the surface against those of the sphere.
        sphere = best_sphere.best_sphere(points, near)
        deviation_mm, sphere_normals = sphere.deviation(points)
        deviation_um = 1e3 * (deviation_mm - deviation_mm.mean())
        normals = np.stack([-seen.slope_x[mask], -seen.slope_y[mask], np.ones(points.shape[1])])
        normals /= vector_lengths(normals)
        sphere_normals -= normals
        angle_rms = _compute_rms(vector_lengths(sphere_normals))
        del sphere_normals

        # The spot, and the image of a star.
        focus_mm, spot_mm = _compute_spot(sphere, points, normals)
        del normals
        spot_50_mm, spot_80_mm, spot_95_mm = np.quantile(spot_mm, ENERGY_SHARES)
        strehl, path_rms_um = star_image.find_strehl(points, self.wavelength_um)
        del points

        # Rotationally invariant and smooth part of the deviation.
        rotational_um = self._rings.round_part(deviation_um)
        deviation_map_um = _place_values(deviation_um, mask)
        smooth_map_um = self._pvr.values(self._pvr.coefficients(deviation_map_um))
        smooth_um = smooth_map_um[mask]

        # All numbers; a flat has no radius.
        radius_mm = np.nan
        if sphere.curvature_per_mm != 0:
            radius_mm = 1 / sphere.curvature_per_mm
        numbers = Quantities(
            radius_of_curvature_mm=radius_mm,
            focal_length_mm=radius_mm / 2,
            sphere_sag_mm=sphere.sag_mm(self.aperture_mm),
            tilt_x_urad=1e6 * sphere.tilt_x,
            tilt_y_urad=1e6 * sphere.tilt_y,
            irregularity_pv_um=float(np.ptp(deviation_um)),
            irregularity_rms_um=_compute_rms(deviation_um),
            pvr_um=float(np.ptp(smooth_um)) + 3 * _compute_rms(deviation_um - smooth_um),
            rotational_pv_um=float(np.ptp(rotational_um)),
            asymmetry_rms_um=_compute_rms(deviation_um - rotational_um),
            slope_rms_urad=1e6 * angle_rms,
            best_focus_mm=focus_mm,
            spot_rms_mm=_compute_rms(spot_mm),
            spot_50_mm=float(spot_50_mm),
            spot_80_mm=float(spot_80_mm),
            spot_95_mm=float(spot_95_mm),
            star_path_rms_um=path_rms_um,
            strehl=strehl,
        )
        return Figure(
            numbers=numbers,
            sphere=sphere,
            deviation_um=deviation_map_um,
            rotational_um=_place_values(rotational_um, mask),
            smooth_um=smooth_map_um,
            fringe_um=1e3 * self.fringe.coefficients(seen.height_mm),
            spot_mm=spot_mm,
        )


def _place_values(values: FloatArray, mask: BoolArray) -> FloatArray:
    """A map with values (cells,) in the cells of the mask, NaN elsewhere."""
    out = np.full(mask.shape, np.nan)
    out[mask] = values
    return out


def _compute_rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


class _Rings:
    """Rotationally invariant part of values at radii (cells,): the piecewise linear function of r
    that fits best.
    """

    def __init__(self, r: FloatArray, knots: int) -> None:
        self._knots = knots
        # Each cell lies between two knots: its share goes to the upper one, the rest to the lower.
        place = r / max(float(r.max()), 1e-12) * (knots - 1)
        self._low = np.minimum(place.astype(np.int64), knots - 2)
        self._share = place - self._low
        # The normal matrix of the least squares is tridiagonal.
        by_lower = self._sum_by_knot((1 - self._share) ** 2)
        by_upper = self._sum_by_knot(self._share**2)
        diagonal = by_lower + np.append(0.0, by_upper[:-1])
        beside = self._sum_by_knot(self._share * (1 - self._share))[:-1]
        above_diagonal = np.diag(beside, 1)
        below_diagonal = np.diag(beside, -1)
        normal = np.diag(diagonal) + above_diagonal + below_diagonal
        self._solver = np.linalg.pinv(normal, rcond=_SEPARABLE, hermitian=True)

    def _sum_by_knot(self, values: FloatArray) -> FloatArray:
        """Sum of values by their lower knot, (knots,)."""
        return np.bincount(self._low, values, self._knots).astype(np.float64)

    def round_part(self, values: FloatArray) -> FloatArray:
        """That part of values (cells,) at the same cells."""
        right = self._sum_by_knot((1 - self._share) * values)
        right[1:] += self._sum_by_knot(self._share * values)[:-1]
        knots = self._solver @ right
        from_lower = (1 - self._share) * knots[self._low]
        from_upper = self._share * knots[self._low + 1]
        return np.asarray(from_lower + from_upper)


def _compute_spot(
    sphere: best_sphere.Sphere, points_mm: FloatArray, normals: FloatArray
) -> tuple[float, FloatArray]:
    """Best focus above the origin in mm, and the distances (n,) of the rays from their middle
    there.

    Rays come along the sphere's normal at the vertex, one for each cell, and are reflected by
    `normals` (3, n). Across that axis a ray is at A + B f in the plane at f; the best focus makes
    the sum of squares least.
    """
    # Two directions across the axis.
    axis = sphere.normal
    aside = np.cross([0.0, 1.0, 0.0], axis)
    aside /= np.linalg.norm(aside)
    across = np.stack([aside, np.cross(axis, aside)])

    # A reflected ray is 2 (n axis) n - axis: its place A and its rate B of change along the axis.
    along = axis @ normals
    rate = (across @ normals) * (2 * along / (2 * along * along - 1))
    start = across @ points_mm - rate * (axis @ points_mm)

    # Both from the middle of the rays; the least sum of squares |A + B f|^2 is at f = -A B / B B.
    rate -= rate.mean(axis=1, keepdims=True)
    start -= start.mean(axis=1, keepdims=True)
    square_of_rate = max(np.sum(rate * rate), 1e-300)
    focus_mm = -float(np.sum(start * rate) / square_of_rate)
    spot_x, spot_y = start + rate * focus_mm
    return focus_mm, np.hypot(spot_x, spot_y)
