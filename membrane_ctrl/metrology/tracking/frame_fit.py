"""The fit of one frame: Gauss-Newton on the light of its bins, for the surface and for what
changes smoothly.

With J the derivatives of the bins' light by the parameters of the surface and of the maps of level
and swings, W weights, 0 for outliers and fading where the bins end, and r the residual, a step is
(J^T W J)^-1 J^T W r. The matrix is kept from step to step and from frame to frame: where J^T W r
vanishes is the solution, whatever matrix led there. It is recomputed where steps shrink too
slowly. J of a bin is fringes times what changes slowly over the mirror (derivatives of the phases,
Noll terms): the latter is a plane over a cell of bins, so that products take a fifth of the time.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product

import numpy as np

from membrane_ctrl.metrology.frame_checks.backlight_bands import Bands, fitted_waves
from membrane_ctrl.metrology.numerics import matrix_inverse
from membrane_ctrl.metrology.numerics.grouped_sums import sum_by_group
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface, height_probe
from membrane_ctrl.metrology.tracking.crossed_scene import CrossedScene
from membrane_ctrl.metrology.tracking.light_kernels import light_left, light_waves
from membrane_ctrl.model.arrays import AnyArray, FloatArray, Singles
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

# Last change of height at the rim, of which a seventh is left: 0.4 nm there, 0.04 nm of the terms.
TOLERANCE_MM = 3e-6
_MAX_STEPS = 10
_MAX_MATRICES = 2  # new ones for a frame: one that needs more is lost
# Largest last change of a frame that is not lost: at the rim, where it is ten times that of the
# terms. Steps shrink slowly where the weights of many bins change with them.
_SETTLED_MM = 1e-5
_ALL_ADU = np.float32(1e6)  # reach that includes all bins
_ASTRAY_MM = 2.0  # steps beyond this are too far from linear
# Change at the rim up to which phases follow their derivatives from the last exact trace: they are
# 0.3 nm off at most.
_LINEAR_MM = 1e-3
_SLOW = 0.3  # a step that is longer than this share of the last one requires a new matrix
_UNKNOWNS = PARAMETERS + 3 * ZERNIKE_TERMS
# First unknown of each wave: phi_x, phi_y (both the surface's), A, B_x and B_y.
_STARTS = 0, 0, PARAMETERS, PARAMETERS + ZERNIKE_TERMS, PARAMETERS + 2 * ZERNIKE_TERMS
# Squares along the mirror's diameter whose errors count as independent: 2.3 fringes each. In
# smaller ones slow changes of light leave more than they do in all.
_BLOCKS = 14
# Overlapping squares: mean of the sum of squares of the four shares of a bin, along x and y.
_OVERLAP = 0.75
_EVERY = 3  # residuals between those of which the median is taken
_SIGMA_OVER_MAD = 1.4826  # of normal numbers

Shifts = tuple[float, float]  # phase steps of x and y


@dataclass(frozen=True)
class FrameFit:
    """Solution of one frame.

    Attributes
    ----------
    surface : Surface
        The surface.
    light : (3, terms) array
        Relative change of level and swings against the scene's, as Noll terms.
    residual_adu : (n,) array
        Light less the model's.
    weights : (n,) array
        1, falling to 0 for outliers.
    converged : bool
        Whether the last step was small.
    bands : (2 k,) array
        Relative amplitudes of the rows' waves.
    """

    surface: Surface
    light: FloatArray
    residual_adu: Singles
    weights: Singles
    converged: bool
    bands: FloatArray = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def scale_adu(self) -> float:
        """Robust sigma of the residual."""
        return _SIGMA_OVER_MAD * float(np.median(np.abs(self.residual_adu[::_EVERY])))


class FrameFitter:
    """Fits frame after frame of a scene.

    Parameters
    ----------
    scene : CrossedScene
        What the reference shows of the bins.
    bands : Bands
        Bands of the backlight.
    jacobian : (2, parameters, 3, N) array, optional
        Planes of the phases' derivatives, if they are known of the same bins and surface.
    """

    def __init__(self, scene: CrossedScene, bands: Bands, jacobian: Singles | None = None) -> None:
        self.scene = scene
        self.bands = bands

        # What varies slowly over the mirror, as planes over cells of bins: derivatives of both
        # phases by the surface, and the Noll terms of the maps of light.
        self._cells = scene.cells
        if jacobian is None:
            jacobian = self._cells.fit_planes(scene.jacobian(scene.surface))
        self.jacobian = jacobian
        self._basis = self._cells.fit_planes(scene.basis)
        self._slow = self._cells.arrange_blocks(*self.jacobian, self._basis)

        # Light of the bins, and their phases at the surface of the last exact trace.
        self.light_adu = scene.light_adu.astype(np.float32)
        self._traced = scene.surface
        self._base = _reduce_phase(scene.phase_rad(scene.surface))
        self._response = scene.response.astype(np.float32)

        # (J^T W J)^-1, kept from frame to frame, and memory of the last evaluation: residual,
        # weights and the sums for bands of each bin; J^T W r of the surface and of three maps.
        self._inverse: FloatArray | None = None
        self._out = np.empty((4, scene.index.size), np.float32)
        self._pull = np.empty((4, PARAMETERS))

    def fit(
        self, seen_adu: Singles, shifts_rad: Shifts, start: FrameFit, reach_adu: Singles
    ) -> FrameFit:
        """Fit a frame from the last solution.

        Parameters
        ----------
        seen_adu : (n,) array
            Means of the frame over the bins.
        shifts_rad : (float, float)
            Phase steps of x and y.
        start : FrameFit
            The last solution.
        reach_adu : (n,) array
            Residual from which a bin has no weight; 0 leaves it out.

        Returns
        -------
        FrameFit
        """
        if self._inverse is not None and len(self._inverse) != self._count_unknowns():
            self._inverse = None
        inherited = self._inverse is not None
        found = self._descend(seen_adu, shifts_rad, start, reach_adu, patient=False)
        if not found.converged and inherited:  # perhaps the matrix is of another frame
            self._inverse = None
            found = self._descend(seen_adu, shifts_rad, start, reach_adu, patient=True)
        if not found.converged:
            self._inverse = None
        return found

    def prepare(self, shifts_rad: Shifts, start: FrameFit) -> None:
        """Make the matrix of the least squares before a frame needs it.

        Parameters
        ----------
        shifts_rad : (float, float)
            Phase steps of x and y of the frames to come.
        start : FrameFit
            Where their fits will begin.
        """
        self._inverse = self._invert_matrix(shifts_rad, start.surface, start.light, start.weights)

    def _descend(
        self, seen_adu: Singles, shifts_rad: Shifts, start: FrameFit, reach: Singles, patient: bool
    ) -> FrameFit:
        """Take steps until they vanish, lead astray or need too many matrices.

        With `patient`, small steps may need more of them.
        """
        shape = start.surface
        light = start.light.copy()
        change = math.inf
        matrices = 0
        # Each frame has bands of other amplitudes: without a first estimate, many bins would be
        # outliers.
        bands = np.zeros(len(self.bands.waves))
        if bands.size:
            self._evaluate(seen_adu, shifts_rad, shape, light, bands, _ALL_ADU * (reach > 0))
            bands = fitted_waves(self.bands.waves, self.sum_over_rows())
        for _ in range(_MAX_STEPS):
            self._evaluate(seen_adu, shifts_rad, shape, light, bands, reach)
            if self._inverse is None:
                self._inverse = self._invert_matrix(shifts_rad, shape, light, self._out[1])
                matrices += 1
                change = math.inf  # the first step is not compared with one of another matrix
            if self._inverse is None:
                break

            # One Gauss-Newton step of all unknowns.
            delta = self._inverse @ self._right_side()
            last_change = change
            shape = Surface.from_parameters(shape.parameters + delta[:PARAMETERS], shape.radius_mm)
            light += delta[PARAMETERS:_UNKNOWNS].reshape(3, ZERNIKE_TERMS)
            bands = bands + delta[_UNKNOWNS:]
            change = float(np.max(np.abs(height_probe() @ delta[:PARAMETERS])))
            if not TOLERANCE_MM < change < _ASTRAY_MM:
                break
            is_slow = change > _SLOW * last_change
            may_renew = matrices < _MAX_MATRICES or (patient and change < _LINEAR_MM)
            if is_slow and may_renew:
                self._inverse = None
        residual, weights = self._out[:2].copy()
        return FrameFit(shape, light, residual, weights, change <= _SETTLED_MM, bands)

    def _evaluate(
        self,
        seen: Singles,
        shifts_rad: Shifts,
        shape: Surface,
        light: FloatArray,
        bands: FloatArray,
        reach: Singles,
    ) -> None:
        """Compute residual, weights and the right side at a surface, maps of light and bands."""
        light_left(
            *self._light_arguments(shifts_rad, shape, light),
            self.scene.edge,
            self.bands.gain_of_bins(bands),
            seen,
            reach,
            self._pull,
            self._out,
        )

    def sum_over_rows(self) -> FloatArray:
        """Sums (2, R) of the last evaluation over the picture's rows, for `Bands`."""
        return self.bands.sum_over_rows(self._out[2:])

    def _light_arguments(
        self, shifts_rad: Shifts, shape: Surface, light: FloatArray
    ) -> tuple[AnyArray, ...]:
        """The arguments from which the kernels compute a frame's light."""
        moved_mm = shape.parameters - self._traced.parameters
        if np.max(np.abs(height_probe() @ moved_mm)) > _LINEAR_MM:
            # Too far from the last exact trace for derivatives: trace again.
            self._traced = shape
            moved_mm = np.zeros(PARAMETERS)
            self._base = _reduce_phase(self.scene.phase_rad(shape))
        changes = np.vstack([moved_mm, light]).astype(np.float32)
        shifts = np.array(shifts_rad, np.float32)
        return (
            self._base,
            self.light_adu,
            self._slow,
            self._cells.offset,
            self._response,
            changes,
            shifts,
        )

    def _right_side(self) -> FloatArray:
        """J^T W r of the last evaluation: (parameters + 3 terms + 2 bands,)."""
        of_bands = np.zeros(0)
        if len(self.bands.waves):
            of_bands = self.bands.waves @ self.sum_over_rows()[0]
        return np.concatenate([self._pull.ravel(), of_bands])

    def _compute_light_waves(
        self, shifts_rad: Shifts, shape: Surface, light: FloatArray
    ) -> Singles:
        """Rows (6, n): dI by phi_x, phi_y, relative changes of A, B_x and B_y, and of all light."""
        waves = np.empty((6, self.scene.index.size), np.float32)
        light_waves(*self._light_arguments(shifts_rad, shape, light), waves)
        return waves

    def _invert_matrix(
        self, shifts_rad: Shifts, shape: Surface, light: FloatArray, weights: Singles
    ) -> FloatArray | None:
        """(J^T W J)^-1; None if the bins do not determine the unknowns."""
        *waves, shown = self._compute_light_waves(shifts_rad, shape, light)
        bands = shown * self.bands.waves[:, self.bands.row]
        weights = weights * self.scene.edge
        # What changes slowly counts with its mean over each cell: the matrix need not be exact.
        slow_planes = (*self.jacobian, self._basis, self._basis, self._basis)
        slow = [planes[:, 0] for planes in slow_planes]
        count = _UNKNOWNS + len(bands)
        matrix = np.zeros((count, count))

        # Unknowns of the waves by each other.
        for i, j in product(range(len(slow)), repeat=2):
            rows = slice(_STARTS[i], _STARTS[i] + PARAMETERS)
            columns = slice(_STARTS[j], _STARTS[j] + PARAMETERS)
            both = self._cells.sum_cells(waves[i] * waves[j] * weights)
            matrix[rows, columns] += (slow[i] * both) @ slow[j].T

        # Those of the bands by them, and by each other.
        for start, planes, wave in zip(_STARTS, slow, waves, strict=True):
            both = self._cells.sum_cells(bands * wave * weights)
            matrix[start : start + PARAMETERS, _UNKNOWNS:] += planes @ both.T
        matrix[_UNKNOWNS:, :_UNKNOWNS] = matrix[:_UNKNOWNS, _UNKNOWNS:].T
        matrix[_UNKNOWNS:, _UNKNOWNS:] = (bands * weights) @ bands.T

        # Inverted with a unit diagonal.
        scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
        matrix *= np.outer(scale, scale)
        if not matrix_inverse.invert_in_place(matrix):
            return None
        return np.asarray(matrix * np.outer(scale, scale))

    def covariance_mm2(self, fit: FrameFit, shifts_rad: Shifts, noise_adu: float) -> FloatArray:
        """Covariance of the surface's parameters, from what the fit leaves, or from the noise where
        that is larger.

        Errors of neighbouring bins are correlated, because light changes slowly over the mirror:
        what a square of bins contributes to the solution counts as one error, and the squares as
        independent. The maps of light are fitted with the surface, so that their errors are
        included.

        Parameters
        ----------
        fit : FrameFit
            A solution of this scene.
        shifts_rad : (float, float)
            Phase steps of its frame.
        noise_adu : float
            Noise of a bin.

        Returns
        -------
        (parameters, parameters) array
            In mm^2; NaN if the bins do not determine the unknowns.
        """
        is_usable = self._inverse is not None and len(self._inverse) == self._count_unknowns()
        if not is_usable:
            self._inverse = self._invert_matrix(shifts_rad, fit.surface, fit.light, fit.weights)
        if self._inverse is None:
            return np.full((PARAMETERS, PARAMETERS), math.nan)

        # Effect of each bin's residual on the parameters: the inverse times what changes slowly,
        # times the fringes. Bands are left out: they change the errors by a thousandth.
        gain = self._inverse[:PARAMETERS].astype(np.float32)
        slow_planes = (*self.jacobian, self._basis, self._basis, self._basis)
        effects = []
        for first, planes in zip(_STARTS, slow_planes, strict=True):
            effects.append(np.tensordot(gain[:, first : first + PARAMETERS], planes, 1))
        slow = np.stack(effects, axis=1)
        waves = self._compute_light_waves(shifts_rad, fit.surface, fit.light)[:5]
        weighted_residual = self.scene.edge * fit.weights * fit.residual_adu
        sums = self.average_in_squares(slow, waves * weighted_residual)

        # Scatter of the squares' effects, enlarged for the fitted degrees of freedom.
        used = int(np.count_nonzero(np.any(sums != 0, axis=0)))
        scatter = sums @ sums.T * (used / max(used - PARAMETERS, 1))

        # Not less than the noise of the pixels.
        of_noise = noise_adu**2 * np.diag(gain[:, :PARAMETERS])
        noise_over_scatter = of_noise / np.diag(scatter)
        factor = np.sqrt(np.maximum(1.0, noise_over_scatter))
        return np.asarray(scatter * np.outer(factor, factor))

    def _count_unknowns(self) -> int:
        """Unknowns of a fit with the present bands."""
        return _UNKNOWNS + len(self.bands.waves)

    def phase_errors(self, fit: FrameFit, shifts_rad: Shifts) -> tuple[Singles, Singles]:
        """Errors of the phases that a frame's residual shows, and their weights.

        Parameters
        ----------
        fit : FrameFit
            A solution of this scene.
        shifts_rad : (float, float)
            Phase steps of its frame.

        Returns
        -------
        errors : (2, n) array
            Residual times the light's derivatives by the phases of x and y, weighted as in the fit.
        weights : (2, n) array
            Squares of these derivatives, with the same weights.
        """
        waves = self._compute_light_waves(shifts_rad, fit.surface, fit.light)[:2]
        weights = self.scene.edge * fit.weights
        return waves * (weights * fit.residual_adu), waves**2 * weights

    def explain_residual(self, fit: FrameFit, shifts_rad: Shifts) -> tuple[FloatArray, FloatArray]:
        """Compare a frame's residual with changes of its light and of its phases.

        Parameters
        ----------
        fit : FrameFit
            A solution of this scene.
        shifts_rad : (float, float)
            Phase steps of its frame.

        Returns
        -------
        products : (3, N) array
            Sums over the bins of a cell of the residual times the light, and times the light's
            derivatives by the phases of x and of y, weighted as in the fit.
        powers : (3, N) array
            Sums of the squares of these three, with the same weights.
        """
        by_x, by_y, *_, shown = self._compute_light_waves(shifts_rad, fit.surface, fit.light)
        waves = np.stack([shown, by_x, by_y])
        weighted = waves * (self.scene.edge * fit.weights)
        products = self._cells.sum_cells(weighted * fit.residual_adu)
        powers = self._cells.sum_cells(weighted * waves)
        return products.astype(float), powers.astype(float)

    def average_in_squares(self, slow: Singles, values: AnyArray) -> FloatArray:
        """Sums over squares of the mirror whose errors count as independent.

        Squares of 2.3 fringes fade into their neighbours: what cancels over whole fringes cancels
        in each. Their sums are as large as those of squares that do not overlap.

        Parameters
        ----------
        slow : (rows, k, 3, N) array
            Planes over the cells, by which the values are multiplied.
        values : (k, n) array
            Values of the bins.

        Returns
        -------
        (rows, squares) array
        """
        # Place of the bins in units of a square; each is shared by the four nearest squares.
        place = (self.scene.position_mm / self.scene.surface.radius_mm + 1) / 2 * _BLOCKS

        # The lower left of them, and how much belongs to the upper and right ones.
        low = np.floor(self._cells.fit_planes(place)[:, 0]).astype(int)
        distance = np.clip(place - self._cells.repeat_over_bins(low), 0, 1)
        upper = np.sin(np.pi / 2 * distance) ** 2
        (left, right), (below, above) = np.stack([1 - upper, upper], axis=1)
        side = _BLOCKS + 2
        low_square = low[1] * side + low[0]
        shares_of_squares = (
            (left * below, 0),
            (right * below, 1),
            (left * above, side),
            (right * above, side + 1),
        )

        # Sums of the pulls on the surface's terms, over each square.
        total = np.zeros((len(slow), side**2))
        for share, offset in shares_of_squares:
            pull = np.einsum("pkiq,kiq->pq", slow, self._cells.sum_moments(share * values))
            total += sum_by_group(low_square + offset, pull, side**2)
        return np.asarray(total / _OVERLAP)

    def period_um(self) -> FloatArray:
        """Change (2, parameters) of the parameters, µm, that looks most like one period along x,
        and one along y, all over the mirror.
        """
        # Least squares for a change of 2 pi of the phases of one axis, and none of the other.
        means = self.jacobian[:, :, 0].astype(float)
        matrix = sum(j @ j.T for j in means)
        changes_um = []
        for j in means:
            of_one_period = 2 * math.pi * j.sum(axis=1)
            changes_um.append(1e3 * np.linalg.solve(matrix, of_one_period))
        return np.stack(changes_um)


def _reduce_phase(phase_rad: FloatArray) -> Singles:
    """Phases within one turn, where single precision is worth 1e-7 rad."""
    return np.asarray(np.remainder(phase_rad, 2 * math.pi), np.float32)
