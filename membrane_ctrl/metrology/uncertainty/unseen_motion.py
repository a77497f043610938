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
from membrane_ctrl.model.arrays import IntArray

_PRIOR_UM = 1000.0  # 1 sigma of the film's motion without a laser, before the fringes are used
_PATCHES = 12  # along a side of the picture: patches are coarser than fringes
_SURE_SIGMAS = 4.0  # beyond this the film moved
_STEP_MM = 0.01  # of a parameter, for the derivatives
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
        The part of `sigma_um` that another set of the bench does not share.
    """

    moved_um: float
    sigma_um: float
    noise_um: float

    @property
    def is_significant(self) -> bool:
        """Whether the film moved beyond the uncertainty."""
        return abs(self.moved_um) > _SURE_SIGMAS * self.sigma_um

    @property
    def shared_um(self) -> float:
        """The part of `sigma_um` that follows from the bench's geometry."""
        return math.sqrt(max(self.sigma_um**2 - self.noise_um**2, 0.0))


def estimate_unseen_motion(bench: TrialBench, spread: GeometrySpread) -> UnseenMotion:
    """Estimate the film's motion between the x and the y frames from the fringes.

    Least squares for the surface's parameters, all inputs of the geometry with their prior, and the
    motion: what the others cannot explain is the motion.

    Parameters
    ----------
    bench : TrialBench
        n points of the set, with their residuals.
    spread : GeometrySpread
        Covariance of the geometry.

    Returns
    -------
    UnseenMotion
    """
    nominal = bench.geometry()
    radius_mm = bench.surface.radius_mm
    base_mm = trial_bench.predicted_mm(bench, nominal, bench.surface)

    # Changes of the screen points (2 n, columns): by the surface's parameters,
    of_surface = []
    for step_mm in _STEP_MM * np.eye(PARAMETERS):
        surface = Surface.from_parameters(bench.surface.parameters + step_mm, radius_mm)
        predicted_mm = trial_bench.predicted_mm(bench, nominal, surface)
        of_surface.append((predicted_mm - base_mm).ravel())
    fitted = np.stack(of_surface, axis=1)

    # by 1 sigma of each input of the geometry, and by the motion.
    explained = [
        trial_bench.predicted_mm(bench, bench.geometry((name,), [sigma]), bench.surface) - base_mm
        for name, sigma in zip(spread.names, spread.sigmas, strict=True)
    ]
    explained.append(trial_bench.moves_mm(bench) * np.array([[-0.5], [0.5]]) * _PRIOR_UM)
    inputs = np.stack([moved_mm.ravel() for moved_mm in explained], axis=1)

    # The surface is free: only what it does not represent of the inputs counts.
    inputs = inputs - fitted @ np.linalg.lstsq(fitted, inputs, rcond=None)[0]

    # Least squares in units of the priors; the scatter is what the inputs do not explain.
    left = bench.residual_mm.ravel()
    answer = np.zeros(inputs.shape[1])
    gram = inputs.T @ inputs
    for _ in range(_ROUNDS):
        variance = float(np.mean((left - inputs @ answer) ** 2))
        covariance = np.linalg.inv(gram / variance + np.eye(inputs.shape[1]))
        answer = covariance @ (inputs.T @ left) / variance
    noise = float((covariance @ (gram / variance) @ covariance)[-1, -1])

    # Uneven light and a response that is not straight leave residuals that neighbours share: what
    # patches contribute to the motion scatters by more than that of independent points.
    shares = (covariance[-1] @ inputs.T / variance * (left - inputs @ answer)).reshape(2, -1)
    patch = _assign_patches(bench)
    of_patches = sum(float(np.sum(np.bincount(patch, share) ** 2)) for share in shares)
    beyond_noise = max(of_patches - noise, 0.0)
    return UnseenMotion(
        moved_um=_PRIOR_UM * float(answer[-1]),
        sigma_um=_PRIOR_UM * float(math.sqrt(covariance[-1, -1] + beyond_noise)),
        noise_um=_PRIOR_UM * float(math.sqrt(noise + beyond_noise)),
    )


def _assign_patches(bench: TrialBench) -> IntArray:
    """Number (n,) of the patch of the picture that each point is in."""
    rows_and_columns = [
        np.int64((_PATCHES - 1e-6) * (place_px - place_px.min()) / np.ptp(place_px))
        for place_px in (bench.row_px, bench.column_px)
    ]
    return np.asarray(np.ravel_multi_index(rows_and_columns, (_PATCHES, _PATCHES)))
