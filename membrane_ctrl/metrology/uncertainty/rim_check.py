"""The rim in the picture against the geometry's prediction: does the stated uncertainty explain
it?
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.rays.geometry import project_points
from membrane_ctrl.metrology.rays.rim_outline import Outline
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import FloatArray

# 1 sigma of place and relative size of a real ring, which is round to about 1 mm. A good pose
# leaves 0.4 mm and 0.0007 (simulated, a fifth of the sensor's pixels).
_RING_SIGMA_MM = 1.0
_RING_SIZE_SIGMA = 0.0017
# Misfit that is usual. Beyond it the geometry's sigmas are widened until the misfit is usual.
_USUAL_SIGMAS = 2.0
# Correlations between the inputs are left out, so sigmas are somewhat too large: beyond this a
# sound bench is rarer than 1 in 10,000.
_CONTRADICTING_SIGMAS = 4.0


@dataclass(frozen=True)
class RimMisfit:
    """How far the rim in the picture is from the geometry's prediction.

    Attributes
    ----------
    offset_mm : float
        Distance of the two centres on the mirror.
    size_ratio : float
        Radius seen over radius predicted.
    sigmas : float
        The larger of the two misfits, in standard deviations that the geometry's stated
        uncertainty and the ring's roundness give it.
    """

    offset_mm: float
    size_ratio: float
    sigmas: float

    @property
    def widening(self) -> float:
        """Factor by which the geometry's sigmas are too small for this rim; at least 1."""
        return max(1.0, self.sigmas / _USUAL_SIGMAS)

    @property
    def contradicts(self) -> bool:
        """Whether no stated uncertainty explains the misfit."""
        return self.sigmas > _CONTRADICTING_SIGMAS

    def describe(self) -> str:
        """The misfit in words."""
        return (
            f"the rim is {self.offset_mm:.1f} mm off the prediction and {self.size_ratio:.4f} of "
            f"its size, {self.sigmas:.1f} sigma of the stated geometry"
        )


def measure_rim_misfit(bench: TrialBench, spread: GeometrySpread, outline: Outline) -> RimMisfit:
    """Compare the rim in the picture with the geometry's prediction.

    Parameters
    ----------
    bench : TrialBench
        The set's bench and surface.
    spread : GeometrySpread
        Covariance of the geometry.
    outline : Outline
        The rim as it is seen.
    """
    # The rim on the mirror.
    theta = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    radius_mm = bench.surface.radius_mm
    rim_z_mm = np.full(theta.size, bench.vertex_z_mm + bench.surface.sag_mm)
    rim_mm = np.stack([radius_mm * np.cos(theta), radius_mm * np.sin(theta), rim_z_mm])

    def predict_px(names: tuple[str, ...], change: FloatArray) -> FloatArray:
        """Column and row of the rim's middle, and its mean radius, in pixels."""
        points_px = project_points(bench.geometry(names, change).geometry, rim_mm)
        middle_px = points_px.mean(axis=1)
        mean_radius_px = np.mean(np.hypot(*(points_px - middle_px[:, None])))
        return np.append(middle_px, mean_radius_px)

    # Where the geometry puts it, and by how much each of its numbers moves that.
    nominal_px = predict_px((), np.zeros(0))
    changes_px = [
        predict_px((name,), np.array([sigma])) - nominal_px
        for name, sigma in zip(spread.names, spread.sigmas, strict=True)
    ]
    # 1 sigma of the prediction. Correlations are left out: with them the rim is better known than
    # its parts, and the limit would be too strict.
    sigmas_px = np.zeros(3)
    if changes_px:
        sigmas_px = np.sqrt(np.sum(np.square(changes_px), axis=0))
    place_sigma_mm = float(np.hypot(sigmas_px[0], sigmas_px[1])) * radius_mm / nominal_px[2]
    size_sigma = float(sigmas_px[2] / nominal_px[2])

    # Both misfits in units of the prediction's sigma and that of the ring.
    place_misfit = abs(outline.offset_mm) / math.hypot(place_sigma_mm, _RING_SIGMA_MM)
    size_misfit = abs(outline.size_ratio - 1) / math.hypot(size_sigma, _RING_SIZE_SIGMA)
    return RimMisfit(outline.offset_mm, outline.size_ratio, max(place_misfit, size_misfit))
