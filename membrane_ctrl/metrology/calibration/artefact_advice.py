"""What a sphere in the mirror's place would determine, where lengths of the bench are ambiguous."""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.calibration import robust_weights, set_state
from membrane_ctrl.metrology.calibration.advice import WORTHWHILE_SHARE
from membrane_ctrl.metrology.calibration.figure_uncertainty import sag_um, surface_covariance
from membrane_ctrl.metrology.calibration.foreseen_sets import foreseen_equations, with_equations
from membrane_ctrl.metrology.calibration.solver import Solution
from membrane_ctrl.metrology.calibration.weak_combinations import weak_combinations
from membrane_ctrl.metrology.rays import forward_model
from membrane_ctrl.metrology.rays.artefacts import Artefact
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface

# A sphere that a telescope maker can deliver: radius of curvature by interferometer and scale,
# place by a dial gauge
_SPHERE_MM, _SPHERE_USED = 200.0, 0.95
_SPHERE_KNOWN, _FORM_MM, _VERTEX_MM = 1e-4, 5e-5, 0.05


@dataclass(frozen=True)
class ArtefactAdvice:
    """A sphere in the mirror's place, where lengths of the bench cannot be told apart."""

    together: tuple[str, ...]  # parameters that move together
    curvature_radius_mm: float
    curvature_radius_sigma_mm: float
    vertex_sigma_mm: float
    radius_mm: float  # of the sphere's edge
    sag_um: float  # 1 sigma then


def artefact_advice(solution: Solution, index: int) -> ArtefactAdvice | None:
    """What a sphere in the mirror's place would give; None if it is not worth it, or if an artefact
    stood there.

    Its set is foreseen from the bench found: rays of the film's set that meet the sphere, with
    their noise.
    """
    if solution.problem.with_artefact:
        return None
    phases, surface = solution.problem.sets[index], solution.states[index].surface
    phases = replace(phases.subset(phases.seen_with(0)), elsewhere=())
    # as deep as the film, so that the fringes fall on the same places of the screen
    curvature_mm = (surface.radius_mm**2 + surface.sag_mm**2) / (2 * surface.sag_mm)
    spread = _SPHERE_KNOWN / curvature_mm
    sphere = Artefact(
        1 / curvature_mm, spread, _FORM_MM, 0.0, _VERTEX_MM, min(_SPHERE_MM, surface.radius_mm)
    )
    terms = sphere.terms_mm()
    shape = replace(
        Surface.from_parameters(terms[:PARAMETERS], sphere.radius_mm),
        beyond_mm=tuple(terms[PARAMETERS:].tolist()),
    )
    bench = solution.bench
    points = forward_model.place_rays(bench, phases, shape, 0.0)
    x_mm, y_mm, _z = bench.geometry.pinhole_mm[:, None] + points.t_mm * points.rays
    seen = replace(phases, displacement_um=np.nan, artefact=sphere).subset(
        np.hypot(x_mm, y_mm) < _SPHERE_USED * sphere.radius_mm
    )
    if seen.sigma_mm.size < 2 * forward_model.LOCAL_EVEN:
        return None
    seen = replace(
        seen, screen_mm=seen.screen_mm - forward_model.residual_mm(bench, seen, shape, 0.0)
    )
    more = foreseen_equations(
        solution, seen, set_state.SetState(shape, 0.0), robust_weights.RobustWeights.full(seen)
    )
    then = with_equations(solution, (*solution.equations, more))
    then_um, now_um = (sag_um(surface_covariance(each, index)) for each in (then, solution))
    if not then_um < WORTHWHILE_SHARE * now_um:
        return None
    worst = max(
        weak_combinations(solution, index, surface.radius_mm),
        key=lambda each: each.figure_um,
        default=None,
    )
    together = () if worst is None else tuple(name for name, _ in worst.parts)
    return ArtefactAdvice(
        together, curvature_mm, _SPHERE_KNOWN * curvature_mm, _VERTEX_MM, sphere.radius_mm, then_um
    )
