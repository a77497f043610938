"""The metrologist's figure of a height map: best sphere, what deviates from it, and the light at
its focus.

A deviation is counted along the best sphere's normal, positive on the side of its centre for a
concave mirror.

Definitions: ISO 10110-5 and ISO 14999-4 for irregularity, its rotationally invariant part and the
rest; C. Evans, Opt. Eng. 48, 043605 (2009) for PVr. They are applied to the surface, not to a
wavefront.
"""

from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields

import numpy as np

from membrane_ctrl.metrology.figure import best_sphere
from membrane_ctrl.metrology.numerics import grid_fit, zernike
from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.reconstruction import zonal_map
from membrane_ctrl.model.arrays import FloatArray

_FRINGE = [zernike.fringe(j) for j in range(1, zernike.FRINGE_TERMS + 1)]
_PVR_TERMS = 36  # by definition, whatever the fit's own number
LEAST_CELLS = 4 * zernike.FRINGE_TERMS  # fewer give no figure
_RINGS = 96  # knots of the rotationally invariant part: 5 mm on a 1 m mirror
_SHARES = (0.5, 0.8, 0.95)  # of the encircled energy


@dataclass(frozen=True)
class SurfaceMap:
    """A surface on a square grid."""

    axis_mm: FloatArray  # (n,): middle of the cells, along x and along y alike
    height_mm: FloatArray  # (n, n): rows along y; NaN where not measured
    slope_x: FloatArray  # (n, n): read where there is a height
    slope_y: FloatArray  # (n, n)

    def part(self, stride: int) -> "SurfaceMap":
        """Every `stride`-th cell along both axes."""
        every = slice(None, None, stride)
        return SurfaceMap(self.axis_mm[every], *(a[every, every] for a in astuple(self)[1:]))

    def plus(self, change: FloatArray) -> "SurfaceMap":
        """With another height and slopes (3, n, n) added."""
        now = self.height_mm + change[0], self.slope_x + change[1], self.slope_y + change[2]
        return SurfaceMap(self.axis_mm, *now)

    def points(self) -> FloatArray:
        """Rows (3, cells) x, y, z of the measured cells in mm."""
        seen = np.isfinite(self.height_mm)
        rows, columns = np.nonzero(seen)
        return np.stack([self.axis_mm[columns], self.axis_mm[rows], self.height_mm[seen]])


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


@dataclass(frozen=True)
class Figure:
    """A figure: its numbers, and what they were taken from."""

    numbers: Quantities
    sphere: best_sphere.Sphere
    deviation_um: (
        FloatArray  # (n, n): from the best sphere, along its normal; NaN where not measured
    )
    rotational_um: FloatArray  # (n, n): its rotationally invariant part
    smooth_um: FloatArray  # (n, n): its fit of 36 Fringe terms, everywhere
    fringe_um: FloatArray  # (37,): Fringe terms of the height, peak 1 on the rim of the aperture
    spot_mm: (
        FloatArray  # (rays,): distance of the reflected rays from their middle in the best focus
    )


class FigureOf:
    """Evaluates figures on one grid: the fits are prepared once for the cells that were measured.

    Parameters
    ----------
    seen : SurfaceMap
        A surface with at least `LEAST_CELLS`; any other has the same grid and the same measured
        cells.
    aperture_mm : float
        Radius of the aperture, by which the Fringe terms are counted.
    """

    def __init__(self, seen: SurfaceMap, aperture_mm: float) -> None:
        self.aperture_mm = aperture_mm
        self._mask = np.isfinite(seen.height_mm)
        axis = seen.axis_mm / aperture_mm
        self.fringe = grid_fit.GridFit(axis, self._mask, _FRINGE)
        self._pvr = grid_fit.GridFit(axis, self._mask, _FRINGE[:_PVR_TERMS])
        rows, columns = np.nonzero(self._mask)
        r = np.hypot(seen.axis_mm[rows], seen.axis_mm[columns])
        self._rings = _Rings(r, max(2, min(_RINGS, len(axis) // 4)))

    def __call__(self, seen: SurfaceMap) -> Figure:
        """The figure of a surface."""
        mask, points = self._mask, seen.points()
        sphere = best_sphere.best_sphere(points)
        deviation, normals = sphere.deviation(points)
        deviation = 1e3 * (deviation - deviation.mean())
        rotational = self._rings.invariant(deviation)
        whole, round_part = np.full(mask.shape, np.nan), np.full(mask.shape, np.nan)
        whole[mask], round_part[mask] = deviation, rotational
        fit = self._pvr.values(self._pvr.coefficients(whole))
        smooth = fit[mask]
        slopes = np.stack([seen.slope_x[mask], seen.slope_y[mask]])
        found = np.stack([*-slopes, np.ones(slopes.shape[1])])
        found /= np.linalg.norm(found, axis=0)
        angle = np.linalg.norm(found - normals, axis=0)
        focus_mm, spot = _spot(sphere, points, found)
        c = sphere.curvature_per_mm
        radius_mm = 1 / c if c != 0 else np.nan
        numbers = Quantities(
            radius_mm,
            radius_mm / 2,
            sphere.sag_mm(self.aperture_mm),
            1e6 * sphere.tilt_x,
            1e6 * sphere.tilt_y,
            float(np.ptp(deviation)),
            _rms(deviation),
            float(np.ptp(smooth)) + 3 * _rms(deviation - smooth),
            float(np.ptp(rotational)),
            _rms(deviation - rotational),
            1e6 * _rms(angle),
            focus_mm,
            _rms(spot),
            *(float(value) for value in np.quantile(spot, _SHARES)),
        )
        fringe_um = 1e3 * self.fringe.coefficients(seen.height_mm)
        return Figure(numbers, sphere, whole, round_part, fit, fringe_um, spot)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


class _Rings:
    """Rotationally invariant part of values at radii (cells,): the piecewise linear function of r
    that fits best.
    """

    def __init__(self, r: FloatArray, knots: int) -> None:
        self._knots = knots
        place = r / max(float(r.max()), 1e-12) * (knots - 1)
        self._low = np.minimum(place.astype(np.int64), knots - 2)
        self._share = place - self._low
        a, b = self._sums((1 - self._share) ** 2), self._sums(self._share**2)
        cross = self._sums(self._share * (1 - self._share))[:-1]
        self._gram = np.diag(a + np.append(0.0, b[:-1])) + np.diag(cross, 1) + np.diag(cross, -1)

    def _sums(self, values: FloatArray) -> FloatArray:
        """Sum of values by their lower knot, (knots,)."""
        return np.bincount(self._low, values, self._knots).astype(np.float64)

    def invariant(self, values: FloatArray) -> FloatArray:
        """That part at the same cells."""
        right = self._sums((1 - self._share) * values)
        right[1:] += self._sums(self._share * values)[:-1]
        knots = np.linalg.lstsq(self._gram, right, rcond=1e-10)[0]
        return np.asarray((1 - self._share) * knots[self._low] + self._share * knots[self._low + 1])


def _spot(
    sphere: best_sphere.Sphere, points_mm: FloatArray, normals: FloatArray
) -> tuple[float, FloatArray]:
    """Best focus above the origin in mm, and the distances (n,) of the rays from their middle
    there.

    Rays come along the sphere's normal at the vertex, one for each cell, and are reflected by
    `normals` (3, n). Across that axis a ray is at A + B f in the plane at f; the best focus makes
    the sum of squares least.
    """
    axis = sphere.normal
    aside = np.cross([0.0, 1.0, 0.0], axis)
    aside /= np.linalg.norm(aside)
    across = np.stack([aside, np.cross(axis, aside)])
    along = axis @ normals  # a ray is 2 along n - axis
    rate = (across @ normals) * (2 * along / (2 * along * along - 1))
    start = across @ points_mm - rate * (axis @ points_mm)
    rate -= rate.mean(axis=1, keepdims=True)
    start -= start.mean(axis=1, keepdims=True)
    focus_mm = -float(np.sum(start * rate) / max(np.sum(rate * rate), 1e-300))
    return focus_mm, np.hypot(*(start + rate * focus_mm))


# Error bars. The fit's parameters have two covariances, from noise and from the geometry; the cells
# have their own noise besides. Figures of disturbed surfaces differ from the measured one: the RMS
# of these differences is 1 sigma. It holds also where a quantity is not linear, such as an RMS near
# zero,
# which any disturbance
# raises.

_TRIALS = 32  # 1 sigma to 12 %
_TRIAL_CELLS = 96  # a side, at least
_WHITE_TRIALS = 4  # on every cell: a mean over thinned cells would be too noisy; to 35 %
_TILE = 256  # cells
_EDGE = 0.03  # of the rays, on either side


@dataclass(frozen=True)
class FigureBars:
    """1 sigma of a figure's numbers and Fringe terms."""

    numbers: Quantities
    fringe_um: FloatArray  # (37,)


def figure_bars(
    evaluate: FigureOf,
    seen: SurfaceMap,
    found: Figure,
    disc_mm: float,
    covariance_mm2: FloatArray,
    cell_slope: float = 0.0,
) -> FigureBars:
    """1 sigma of a figure `found` = `evaluate(seen)`.

    Parameters
    ----------
    disc_mm : float
        Radius of the fit's Zernike disc.
    covariance_mm2 : (parameters, parameters) array
        Covariance of the fit's parameters, in mm^2. Not finite: no error bar, all NaN.
    cell_slope : float
        1 sigma of the mean slope of a cell by white noise.
    """
    thin = seen.part(max(1, seen.axis_mm.size // _TRIAL_CELLS))
    if (
        np.count_nonzero(np.isfinite(thin.height_mm)) < LEAST_CELLS
    ):  # a map with few cells, here and there
        thin = seen
    if not np.isfinite(covariance_mm2).all():
        nothing = Quantities(*[np.nan] * len(fields(Quantities)))
        return FigureBars(nothing, np.full(zernike.FRINGE_TERMS, np.nan))
    rough = FigureOf(thin, evaluate.aperture_mm)
    random = np.random.default_rng(1)  # the same set has the same error bars
    values, vectors = np.linalg.eigh(covariance_mm2)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    modes = np.stack(
        [surface.Surface.from_parameters(k, disc_mm).on_grid(thin.axis_mm) for k in root.T]
    )
    nominal = rough(thin)
    squares = np.zeros(len(fields(Quantities)))
    for _ in range(_TRIALS):
        change = np.tensordot(random.normal(size=len(root)), modes, axes=1)
        squares += _change(nominal, rough(thin.plus(change))) ** 2 / _TRIALS
    for change in _white(seen, evaluate.aperture_mm, cell_slope, random) if cell_slope > 0 else ():
        moved = np.array(astuple(evaluate(seen.plus(change)).numbers))
        squares += (moved - astuple(found.numbers)) ** 2 / _WHITE_TRIALS
    terms = np.stack([1e3 * rough.fringe.coefficients(mode[0]) for mode in modes])
    return FigureBars(Quantities(*np.sqrt(squares)), np.sqrt(np.sum(terms**2, axis=0)))


def _change(nominal: Figure, moved: Figure) -> FloatArray:
    """Change of all numbers; of an encircled share, the mean over its neighbours, since few rays
    make it jump.
    """
    change = np.subtract(astuple(moved.numbers), astuple(nominal.numbers))
    farther = np.sort(moved.spot_mm) - np.sort(nominal.spot_mm)
    for place, share in zip(range(-len(_SHARES), 0), _SHARES, strict=True):
        change[place] = farther[
            int((share - _EDGE) * farther.size) : int((share + _EDGE) * farther.size) + 1
        ].mean()
    return np.asarray(change)


def _white(
    seen: SurfaceMap, aperture_mm: float, cell_slope: float, random: np.random.Generator
) -> Iterator[FloatArray]:
    """What white noise of the cells' slopes does to height and slopes, (3, n, n).

    Integrated once on a periodic tile of cells, of which each draw takes another place.
    """
    step = float(seen.axis_mm[1] - seen.axis_mm[0])
    k = 2 * np.pi * np.fft.fftfreq(_TILE, step)
    k_x, k_y = np.meshgrid(k, k)
    square = k_x**2 + k_y**2
    slopes = random.normal(0, cell_slope, (2, _TILE, _TILE))
    spectrum = np.fft.fft2(slopes)
    fast = square > (np.pi * zonal_map.FIT_CYCLES / aperture_mm) ** 2
    height = np.where(
        fast, -1j * (k_x * spectrum[0] + k_y * spectrum[1]) / np.where(fast, square, 1.0), 0
    )
    tiles = np.stack([np.fft.ifft2(height).real, *slopes])
    for _ in range(_WHITE_TRIALS):
        down, right = np.arange(seen.axis_mm.size) + random.integers(_TILE, size=(2, 1))
        yield tiles[:, (down % _TILE)[:, None], right % _TILE]


@dataclass(frozen=True)
class PowerSpectrum:
    """Power spectral density of a deviation, mean over the directions; its sum over the plane is
    the mean square.
    """

    frequency_per_mm: FloatArray  # (m,)
    density_um2_mm2: FloatArray  # (m,)
    sigma_um2_mm2: FloatArray  # (m,): 1 sigma as an estimate of a random surface's density


def power_spectrum(found: Figure, axis_mm: FloatArray, aperture_mm: float) -> PowerSpectrum:
    """Spectrum of the deviation from the best sphere under a radial Hann window.

    Cells without a measurement are filled by the fit of the terms.
    """
    x, y = np.meshgrid(axis_mm, axis_mm)
    r, step = np.hypot(x, y), float(axis_mm[1] - axis_mm[0])
    window = np.where(r < aperture_mm, np.cos(np.pi / 2 * np.minimum(r / aperture_mm, 1)) ** 2, 0.0)
    values = np.where(np.isfinite(found.deviation_um), found.deviation_um, found.smooth_um)
    values = window * (values - np.sum(window * values) / np.sum(window))
    density = np.abs(np.fft.rfft2(values)) ** 2 * step**2 / np.sum(window**2)
    f = np.hypot(
        *np.meshgrid(np.fft.rfftfreq(axis_mm.size, step), np.fft.fftfreq(axis_mm.size, step))
    )
    width = 1 / (2 * aperture_mm)
    ring = np.round(f / width).astype(np.int64).ravel()
    count = np.bincount(ring)
    known = np.flatnonzero((count > 0) & (np.arange(count.size) * width < 0.5 / step))[1:]
    mean = (np.bincount(ring, density.ravel()) / np.maximum(count, 1))[known]
    # neighbours in the plane share what the window smears: fewer are independent
    independent = np.sum(window**2) ** 2 / (window.size * np.sum(window**4))
    sigma = mean / np.sqrt(np.maximum(count[known] * independent, 1.0))
    return PowerSpectrum(width * known.astype(np.float64), mean, sigma)
