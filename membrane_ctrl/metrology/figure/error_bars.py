"""Error bars of a figure's numbers, by trials.

The fit's parameters have two covariances, from noise and from the geometry; the cells have their
own noise besides. Figures of disturbed surfaces differ from the measured one: the RMS of these
differences is 1 sigma. It holds also where a quantity is not linear, such as an RMS near zero,
which any disturbance raises.
"""

from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields

import numpy as np

from membrane_ctrl.metrology.figure.quantities import ENERGY_SHARES, Figure, FigureOf, Quantities
from membrane_ctrl.metrology.figure.surface_map import SurfaceMap
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.reconstruction import zonal_map
from membrane_ctrl.model.arrays import FloatArray

LEAST_CELLS = 4 * zernike.FRINGE_TERMS  # fewer give no figure
_TRIALS = 32  # give 1 sigma to 12 %
_TRIAL_CELLS = 96  # cells a side of a trial, at least
# Trials of the cells' own noise, on all cells: a mean over thinned cells would be too noisy. They
# give 1 sigma to 35 %.
_WHITE_TRIALS = 4
_TILE = 256  # cells a side of the noise that is drawn
_NEIGHBOURS = 0.03  # share of the rays, on either side, over which an encircled share is averaged
# Places of the encircled radii among the numbers, in the order of `ENERGY_SHARES`
_SPOT_PLACES = [
    [number.name for number in fields(Quantities)].index(f"spot_{100 * share:.0f}_mm")
    for share in ENERGY_SHARES
]


@dataclass(frozen=True)
class FigureBars:
    """1 sigma of a figure.

    Attributes
    ----------
    numbers : Quantities
        Of its numbers.
    fringe_um : (37,) array
        Of its Fringe terms.
    """

    numbers: Quantities
    fringe_um: FloatArray


class FigureTrials:
    """Error bars of one figure by trials; what they have in common is prepared once.

    Parameters
    ----------
    evaluate : FigureOf
        Evaluates figures on the grid of `seen`.
    seen : SurfaceMap
        The measured surface.
    found : Figure
        Its figure, `evaluate(seen)`.
    disc_mm : float
        Radius of the fit's Zernike disc.
    """

    def __init__(self, evaluate: FigureOf, seen: SurfaceMap, found: Figure, disc_mm: float) -> None:
        self._evaluate = evaluate
        self._seen = seen
        self._found = found

        # Trials on a thinned grid, unless few cells of a sparse map would be left.
        thin = seen.take_every(max(1, seen.axis_mm.size // _TRIAL_CELLS))
        if np.count_nonzero(np.isfinite(thin.height_mm)) < LEAST_CELLS:
            thin = seen
        self._thin = thin
        self._rough = FigureOf(thin, evaluate.aperture_mm, evaluate.wavelength_um)
        self._nominal = self._rough(thin)
        self._nominal_spot_mm = np.sort(self._nominal.spot_mm)

        # Heights and slopes (parameters, 3, n, n) by 1 mm of each parameter, and the Fringe terms
        # (parameters, 37), which are linear in the parameters.
        units = np.eye(surface.PARAMETERS)
        surfaces = [surface.Surface.from_parameters(unit, disc_mm) for unit in units]
        self._by_parameter = np.stack([unit.on_grid(thin.axis_mm) for unit in surfaces])
        terms = [self._rough.fringe.coefficients(unit[0]) for unit in self._by_parameter]
        self._terms_um = 1e3 * np.stack(terms)

    def figure_bars(self, covariance_mm2: FloatArray, cell_slope: float = 0.0) -> FigureBars:
        """Error bars of the figure.

        Parameters
        ----------
        covariance_mm2 : (parameters, parameters) array
            Covariance of the fit's parameters, in mm^2. Not finite: no error bar, all NaN.
        cell_slope : float
            1 sigma of the mean slope of a cell by white noise.

        Returns
        -------
        FigureBars
            1 sigma of each number.
        """
        if not np.isfinite(covariance_mm2).all():
            nothing = Quantities(*[np.nan] * len(fields(Quantities)))
            return FigureBars(nothing, np.full(zernike.FRINGE_TERMS, np.nan))

        # Independent modes of the parameters' errors, each of 1 sigma: the eigenvectors of the
        # covariance, scaled by the roots of its eigenvalues.
        values, vectors = np.linalg.eigh(covariance_mm2)
        root = vectors * np.sqrt(np.maximum(values, 0.0))

        # Mean squares of the changes by random sums of these modes. The seed is fixed: the same set
        # has the same error bars.
        random = np.random.default_rng(1)
        drawn_mm = random.normal(size=(_TRIALS, len(root))) @ root.T
        changes = drawn_mm @ self._by_parameter.reshape(len(root), -1)
        squares = np.zeros(len(fields(Quantities)))
        for change in changes.reshape(_TRIALS, *self._by_parameter.shape[1:]):
            disturbed = self._rough(self._thin.add_change(change), self._nominal.sphere)
            squares += self._compute_change(disturbed) ** 2 / _TRIALS

        # And by the cells' own noise, which is independent of them.
        if cell_slope > 0:
            aperture_mm = self._evaluate.aperture_mm
            found = self._found
            for change in _propagate_white_noise(self._seen, aperture_mm, cell_slope, random):
                # Only the numbers are kept: the maps of a figure are large.
                numbers = self._evaluate(self._seen.add_change(change), found.sphere).numbers
                moved = np.subtract(astuple(numbers), astuple(found.numbers))
                squares += moved**2 / _WHITE_TRIALS

        # The sums of squares of the Fringe terms over the modes.
        terms_um = root.T @ self._terms_um
        return FigureBars(Quantities(*np.sqrt(squares)), np.sqrt(np.sum(terms_um**2, axis=0)))

    def _compute_change(self, moved: Figure) -> FloatArray:
        """Change of all numbers on the thinned grid; of an encircled share, the mean over its
        neighbours, since few rays make it jump.
        """
        change = np.subtract(astuple(moved.numbers), astuple(self._nominal.numbers))
        farther_mm = np.sort(moved.spot_mm) - self._nominal_spot_mm
        for place, share in zip(_SPOT_PLACES, ENERGY_SHARES, strict=True):
            first = int((share - _NEIGHBOURS) * farther_mm.size)
            last = int((share + _NEIGHBOURS) * farther_mm.size)
            change[place] = farther_mm[first : last + 1].mean()
        return np.asarray(change)


def _propagate_white_noise(
    seen: SurfaceMap, aperture_mm: float, cell_slope: float, random: np.random.Generator
) -> Iterator[FloatArray]:
    """Yield errors of height and slopes (3, n, n) by white noise of the cells' slopes.

    The noise is integrated once on a periodic tile of cells, of which each draw takes another
    place.
    """
    step_mm = float(seen.axis_mm[1] - seen.axis_mm[0])
    slopes = random.normal(0, cell_slope, (2, _TILE, _TILE))
    spectrum_x, spectrum_y = np.fft.fft2(slopes)

    # Waves k of the tile. Slower ones than the fit's terms belong to the fit.
    k = 2 * np.pi * np.fft.fftfreq(_TILE, step_mm)
    k_x, k_y = np.meshgrid(k, k)
    square = k_x**2 + k_y**2
    is_fast = square > (np.pi * zonal_map.FIT_CYCLES / aperture_mm) ** 2

    # Least squares for the height of each wave from both slopes: -i (k slopes) / k^2.
    along_k = k_x * spectrum_x + k_y * spectrum_y
    integrated = -1j * along_k / np.where(is_fast, square, 1.0)
    height = np.fft.ifft2(np.where(is_fast, integrated, 0)).real

    # Parts of the periodic tile, as large as the map.
    tiles = np.stack([height, *slopes])
    for _ in range(_WHITE_TRIALS):
        down, right = np.arange(seen.axis_mm.size) + random.integers(_TILE, size=(2, 1))
        rows = (down % _TILE)[:, None]
        columns = right % _TILE
        yield tiles[:, rows, columns]
