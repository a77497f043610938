"""Motion of the film between the x and the y frames, estimated from the fringes alone.

Slopes in x of one bowl and slopes in y of another do not integrate to a surface.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.uncertainty import trial_bench
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import FloatArray, IntArray

_PRIOR_UM = 1000.0  # 1 sigma of the film's motion without a laser, before the fringes are used
_PATCHES = 12  # across the mirror: patches are coarser than fringes
_SURE_SIGMAS = 4.0  # beyond this the film moved
_STEP_MM = 0.01  # of a parameter, for the derivatives
_TINY = 1e-300  # instead of a division by zero
_ROUNDS = 3  # of least squares, each with the scatter that the former one leaves


@dataclass(frozen=True)
class UnseenMotion:
    """Film displacement from the x frames to the y frames, as the fringes show it.

    Attributes
    ----------
    moved_um : float
        The displacement.
    sigma_um : float
        Its standard uncertainty.
    noise_um : float
        The part of `sigma_um` that follows from the noise of the pixels.
    patches_um : (patches,) array
        What the residuals of each patch of the mirror add to the displacement. The patches are
        those of the mirror, whatever was seen: two sets of a bench have the same ones.
    """

    moved_um: float
    sigma_um: float
    noise_um: float
    patches_um: FloatArray

    @property
    def is_significant(self) -> bool:
        """Whether the film moved beyond the uncertainty."""
        return abs(self.moved_um) > _SURE_SIGMAS * self.sigma_um

    @property
    def noise_share(self) -> float:
        """Share of the patches' sum of squares that the noise of the pixels explains."""
        return min(self.noise_um**2 / max(float(np.sum(self.patches_um**2)), _TINY), 1.0)

    @property
    def shared_um(self) -> float:
        """The part of `sigma_um` that follows from the bench's geometry."""
        of_patches_um2 = (1 - self.noise_share) * float(np.sum(self.patches_um**2))
        return math.sqrt(max(self.sigma_um**2 - self.noise_um**2 - of_patches_um2, 0.0))


def estimate_unseen_motion(
    bench: TrialBench, spread: GeometrySpread, noise_mm2: FloatArray
) -> UnseenMotion:
    """Estimate the film's motion between the x and the y frames from the fringes.

    Least squares for the surface's parameters, all inputs of the geometry with their prior, and the
    motion: what the others cannot explain is the motion. Section 3 of
    docs/explanation/uncertainty.md.

    Parameters
    ----------
    bench : TrialBench
        n points of the set, with their residuals.
    spread : GeometrySpread
        Covariance of the geometry.
    noise_mm2 : (2,) array
        Variance of a screen point, along x and y, from the noise of the pixels.

    Returns
    -------
    UnseenMotion
    """
    # What moves the screen points: the motion last, each by 1 sigma of its prior. The surface is
    # free: only what it does not represent of the inputs counts.
    of_surface = _surface_columns(bench)
    inputs = _input_columns(bench, spread)
    inputs = inputs - of_surface @ np.linalg.lstsq(of_surface, inputs, rcond=None)[0]

    # Least squares in units of the priors; the scatter is what the inputs do not explain.
    left = bench.residual_mm.ravel()
    answer = np.zeros(inputs.shape[1])
    gram = inputs.T @ inputs
    for _ in range(_ROUNDS):
        variance = float(np.mean((left - inputs @ answer) ** 2))
        covariance = np.linalg.inv(gram / variance + np.eye(inputs.shape[1]))
        answer = covariance @ (inputs.T @ left) / variance
    scatter = float((covariance @ (gram / variance) @ covariance)[-1, -1])

    # Uneven light and a response that is not straight leave residuals that neighbours share: what
    # patches contribute to the motion scatters by more than that of independent points.
    weights = (covariance[-1] @ inputs.T / variance).reshape(2, -1)
    parts = weights * (left - inputs @ answer).reshape(2, -1)
    patch = _assign_patches(bench)
    of_patches = np.concatenate([np.bincount(patch, part, _PATCHES**2) for part in parts])
    beyond_scatter = max(float(np.sum(of_patches**2)) - scatter, 0.0)
    noise = float(noise_mm2 @ np.sum(weights**2, axis=1))
    return UnseenMotion(
        moved_um=_PRIOR_UM * float(answer[-1]),
        sigma_um=_PRIOR_UM * float(math.sqrt(covariance[-1, -1] + beyond_scatter)),
        noise_um=_PRIOR_UM * math.sqrt(noise),
        patches_um=_PRIOR_UM * of_patches,
    )


def _surface_columns(bench: TrialBench) -> FloatArray:
    """Changes (2 n, parameters) of the screen points by a step of each parameter of the surface."""
    nominal = bench.geometry()
    base_mm = trial_bench.predicted_mm(bench, nominal, bench.surface)
    columns = []
    for step_mm in _STEP_MM * np.eye(PARAMETERS):
        parameters = bench.surface.parameters + step_mm
        surface = Surface.from_parameters(parameters, bench.surface.radius_mm)
        predicted_mm = trial_bench.predicted_mm(bench, nominal, surface)
        columns.append((predicted_mm - base_mm).ravel())
    return np.stack(columns, axis=1)


def _input_columns(bench: TrialBench, spread: GeometrySpread) -> FloatArray:
    """Changes (2 n, inputs + 1) of the screen points by 1 sigma of each input of the geometry, and
    by `_PRIOR_UM` of motion from x to y.
    """
    base_mm = trial_bench.predicted_mm(bench, bench.geometry(), bench.surface)
    changes = [
        trial_bench.predicted_mm(bench, bench.geometry((name,), [sigma]), bench.surface) - base_mm
        for name, sigma in zip(spread.names, spread.sigmas, strict=True)
    ]
    # Half of it before the mean place of both axes, half after it.
    from_x_to_y_um = _PRIOR_UM * np.array([[-0.5], [0.5]])
    changes.append(trial_bench.moves_mm(bench) * from_x_to_y_um)
    return np.stack([moved_mm.ravel() for moved_mm in changes], axis=1)


def _assign_patches(bench: TrialBench) -> IntArray:
    """Number (n,) of the patch of the mirror that each point is in."""
    geometry = bench.geometry().geometry
    rays = geometry.rays(bench.column_px, bench.row_px)
    on_film_mm = geometry.pinhole_mm[:, None] + bench.t_mm * rays
    reach_mm = bench.optics.mirror.analysis_radius_mm
    in_patches = (on_film_mm[:2] / reach_mm + 1) / 2 * _PATCHES
    column, row = np.clip(in_patches.astype(int), 0, _PATCHES - 1)
    return np.asarray(row * _PATCHES + column)
