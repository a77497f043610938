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

_UNSEEN_UM = 1000.0  # of the film's motion without a laser, before the fringes are asked
_PATCHES = 12  # a side, of the picture: coarser than fringes
_SIGMAS = 4.0  # of the fringes' answer: the film moved
_STEP_MM = 0.01


@dataclass(frozen=True)
class UnseenMotion:
    """Film displacement from the x frames to the y frames, as the fringes show it."""

    moved_um: float
    sigma_um: float
    noise_um: float  # the part of `sigma_um` that another set of the bench does not share

    @property
    def sure(self) -> bool:
        """Whether the film moved."""
        return abs(self.moved_um) > _SIGMAS * self.sigma_um

    @property
    def shared_um(self) -> float:
        """The part of `sigma_um` that the bench's geometry makes."""
        return math.sqrt(max(self.sigma_um**2 - self.noise_um**2, 0.0))


def estimate_unseen_motion(bench: TrialBench, spread: GeometrySpread) -> UnseenMotion:
    """Ask the fringes whether the film moved between the x and the y frames.

    Slopes in x of one bowl and slopes in y of another do not integrate to a surface. Least squares
    over the parameters, all inputs of the geometry with their prior, and the motion: what they
    cannot explain, it does.
    """
    nominal = bench.geometry()
    base = trial_bench.predicted_mm(bench, nominal, bench.surface)
    steps = _STEP_MM * np.eye(PARAMETERS)
    surfaces = [
        Surface.from_parameters(bench.surface.parameters + s, bench.surface.radius_mm)
        for s in steps
    ]
    fitted = np.stack(
        [(trial_bench.predicted_mm(bench, nominal, s) - base).ravel() for s in surfaces], axis=1
    )
    explained = [
        trial_bench.predicted_mm(bench, bench.geometry((name,), [sigma]), bench.surface) - base
        for name, sigma in zip(spread.names, spread.sigmas, strict=True)
    ]
    explained.append(trial_bench.moves_mm(bench) * np.array([[-0.5], [0.5]]) * _UNSEEN_UM)
    inputs = np.stack([moved.ravel() for moved in explained], axis=1)
    inputs = inputs - fitted @ np.linalg.lstsq(fitted, inputs, rcond=None)[0]
    left = bench.residual_mm.ravel()
    answer, gram = np.zeros(inputs.shape[1]), inputs.T @ inputs
    for _ in range(3):  # the scatter is what the inputs do not explain
        variance = float(np.mean((left - inputs @ answer) ** 2))
        covariance = np.linalg.inv(gram / variance + np.eye(inputs.shape[1]))
        answer = covariance @ (inputs.T @ left) / variance
    noise = float((covariance @ (gram / variance) @ covariance)[-1, -1])
    # uneven light and a bent response leave residuals that neighbours share: sums over patches
    # scatter by more
    shares = (covariance[-1] @ inputs.T / variance * (left - inputs @ answer)).reshape(2, -1)
    patch = np.ravel_multi_index(
        [
            np.int64((_PATCHES - 1e-6) * (p - p.min()) / np.ptp(p))
            for p in (bench.row_px, bench.column_px)
        ],
        (_PATCHES, _PATCHES),
    )
    patches = sum(float(np.sum(np.bincount(patch, share) ** 2)) for share in shares)
    more = max(patches - noise, 0.0)
    moved_um, *sigmas = answer[-1], math.sqrt(covariance[-1, -1] + more), math.sqrt(noise + more)
    return UnseenMotion(*(_UNSEEN_UM * float(value) for value in (moved_um, *sigmas)))
