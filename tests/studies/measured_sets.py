"""Sets of a misstated bench, measured as `measure` does, and the truth of what it measures."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.config.optics import (
    OpticsConfig,
)
from membrane_ctrl.geometry.spread_file import geometry_spread
from membrane_ctrl.metrology.figure.pixel_figure import FullResult, measure_pixels, reconstruct_full
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.rays.rim_outline import find_outline
from membrane_ctrl.metrology.rays.surface import parameter_to_coeffs, sag_gradient
from membrane_ctrl.metrology.uncertainty.height_map import height_matrix
from membrane_ctrl.metrology.uncertainty.set_budget import SetBudget, assemble_budget
from membrane_ctrl.model.shape_estimate import judge_quality
from membrane_ctrl.sim.optics.film_shape import FilmShape
from tests.worlds.misstated_bench import (
    FloatArray,
)

TERMS = range(3, 11)  # Noll 4..11


def measured(stack: FrameStack, stated: OpticsConfig) -> tuple[FullResult, SetBudget, str]:
    """As `measure` does. Raises RejectedSetError."""
    return measured_checked(check_set(stack, stated), stated)


def measured_checked(checked: Checked, stated: OpticsConfig) -> tuple[FullResult, SetBudget, str]:
    """As `measure` does with a set that has passed its checks."""
    full = reconstruct_full(stated, checked, measure_pixels(stated, checked))
    used = [k for axis in checked.view.used for k in axis]
    light = checked.binned.means[used].mean(axis=0).astype(float)
    outline = find_outline(
        light, checked.tracer.geometry, 500.0, checked.tracer.vertex_z_mm + full.surface.sag_mm
    )
    examined = assemble_budget(
        stated, checked, full, geometry_spread(stated, None)[0], 0.5, outline
    )
    verdict = judge_quality(full.quality)[0]
    if verdict == "ok" and (checked.flags or examined.doubts):
        verdict = "degraded"
    return full, examined, verdict


def quantities(points_mm: FloatArray) -> FloatArray:
    """Rows (n, 36): sag, Noll 4..11, height at points (2, n), of the surface's parameters."""
    return np.vstack(
        [sag_gradient(), parameter_to_coeffs()[list(TERMS)], height_matrix(*points_mm, 500.0)]
    )


def truth_of(film: FilmShape, displacement_um: float, points_mm: FloatArray) -> FloatArray:
    """The quantities (n,) in mm of the true film; its terms by least squares over the disc."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-500, 500, 61)] * 2))
    inside = np.hypot(x, y) <= 500
    x, y = x[inside], y[inside]
    rows, height = height_matrix(x, y, 500.0), film.height_mm(x, y, displacement_um)
    terms = (parameter_to_coeffs() @ np.linalg.lstsq(rows, height, rcond=None)[0])[list(TERMS)]
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    rim = film.height_mm(500 * np.cos(angle), 500 * np.sin(angle), displacement_um)
    vertex = film.height_mm(np.zeros(1), np.zeros(1), displacement_um)
    return np.concatenate(
        [[rim.mean() - vertex[0]], terms, film.height_mm(*points_mm, displacement_um) - vertex]
    )
