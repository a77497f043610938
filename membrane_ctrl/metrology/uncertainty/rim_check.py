"""The rim in the picture against the geometry's prediction, and by how much its sigmas are too
small.
"""

import math

import numpy as np

from membrane_ctrl.metrology.rays.geometry import project_points
from membrane_ctrl.metrology.rays.rim_outline import Outline
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import FloatArray

# A good pose leaves 0.4 mm and 0.0007 (simulated, a fifth of the sensor's pixels); rings are round
# to about 1 mm.
_RIM_OFF_MM, _RIM_SIZE = 3.0, 0.005


def rim_failed(outline: Outline) -> bool:
    """Whether the rim is too far from where the camera's pose puts it."""
    return abs(outline.offset_mm) > _RIM_OFF_MM or abs(outline.size_ratio - 1) > _RIM_SIZE


def rim_widening(bench: TrialBench, spread: GeometrySpread, outline: Outline | None) -> float:
    """By how much the geometry's sigmas are too small for the rim that was seen; at least 1.

    Twice what they allow is nothing to wonder at.
    """
    if outline is None:
        return 1.0
    theta, radius_mm = np.linspace(0, 2 * np.pi, 60, endpoint=False), bench.surface.radius_mm
    rim_z_mm = np.full(theta.size, bench.vertex_z_mm + bench.surface.sag_mm)
    rim = np.stack([radius_mm * np.cos(theta), radius_mm * np.sin(theta), rim_z_mm])

    def seen(names: tuple[str, ...], change: FloatArray) -> FloatArray:
        points = project_points(bench.geometry(names, change).geometry, rim)
        middle = points.mean(axis=1)
        return np.append(middle, np.mean(np.hypot(*(points - middle[:, None]))))

    nominal = seen((), np.zeros(0))
    off = [
        seen((n,), np.array([s])) - nominal
        for n, s in zip(spread.names, spread.sigmas, strict=True)
    ]
    # correlations are left out: they make the rim better known than its parts, and the scale then
    # too small
    sigmas = np.sqrt(np.sum(np.square(off), axis=0)) if off else np.zeros(3)
    place_mm = float(np.hypot(sigmas[0], sigmas[1])) * radius_mm / nominal[2]
    far = max(
        abs(outline.offset_mm) / math.hypot(place_mm, _RIM_OFF_MM / 3),
        abs(outline.size_ratio - 1) / math.hypot(float(sigmas[2] / nominal[2]), _RIM_SIZE / 3),
    )
    return max(1.0, far / 2)
