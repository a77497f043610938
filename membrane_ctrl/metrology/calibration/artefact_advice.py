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
# place by a dial gauge.
_SPHERE_MM = 200.0  # radius of its edge
_SPHERE_USED = 0.95  # share of that radius that is used
_CURVATURE_SIGMA = 1e-4  # relative
_FORM_SIGMA_MM = 5e-5
_VERTEX_SIGMA_MM = 0.05


@dataclass(frozen=True)
class ArtefactAdvice:
    """A sphere in the mirror's place, where lengths of the bench are ambiguous.

    Attributes
    ----------
    together : tuple of str
        Parameters that are ambiguous together.
    curvature_radius_mm, curvature_radius_sigma_mm : float
        Radius of curvature of the sphere, and its standard uncertainty.
    vertex_sigma_mm : float
        Standard uncertainty of the height of its vertex.
    radius_mm : float
        Radius of its edge.
    sag_um : float
        1 sigma of the film's sag with a set of it.
    """

    together: tuple[str, ...]
    curvature_radius_mm: float
    curvature_radius_sigma_mm: float
    vertex_sigma_mm: float
    radius_mm: float
    sag_um: float


def advise_sphere(solution: Solution, index: int) -> ArtefactAdvice | None:
    """The sphere that would reduce the sag's sigma most.

    Its set is foreseen from the calibrated bench: rays of the film's set that meet the sphere, with
    their noise.

    Parameters
    ----------
    solution : Solution
        The calibration.
    index : int
        Number of the set whose sag is considered.

    Returns
    -------
    ArtefactAdvice or None
        None if it is not worth it, or if there is a set of an artefact.
    """
    if solution.problem.with_artefact:
        return None
    phases = solution.problem.sets[index]
    phases = replace(phases.subset(phases.select_screen(0)), moved_screens=())
    surface = solution.states[index].surface

    # As deep as the film, so that the fringes fall on the same places of the screen.
    curvature_mm = (surface.radius_mm**2 + surface.sag_mm**2) / (2 * surface.sag_mm)
    sphere = Artefact(
        1 / curvature_mm,
        _CURVATURE_SIGMA / curvature_mm,
        _FORM_SIGMA_MM,
        0.0,
        _VERTEX_SIGMA_MM,
        min(_SPHERE_MM, surface.radius_mm),
    )
    terms_mm = sphere.terms_mm()
    shape = replace(
        Surface.from_parameters(terms_mm[:PARAMETERS], sphere.radius_mm),
        beyond_mm=tuple(terms_mm[PARAMETERS:].tolist()),
    )

    # Bins that meet the sphere, without residuals.
    bench = solution.bench
    points = forward_model.place_rays(bench, phases, shape, 0.0)
    x_mm, y_mm, _z = bench.geometry.pinhole_mm[:, None] + points.t_mm * points.rays
    on_sphere = np.hypot(x_mm, y_mm) < _SPHERE_USED * sphere.radius_mm
    seen = replace(phases, displacement_um=np.nan, artefact=sphere).subset(on_sphere)
    if seen.sigma_mm.size < 2 * forward_model.LOCAL_EVEN:
        return None
    residual_mm = forward_model.residual_mm(bench, seen, shape, 0.0)
    seen = replace(seen, screen_mm=seen.screen_mm - residual_mm)

    # The solution with that set in addition.
    state = set_state.SetState(shape, 0.0)
    weights = robust_weights.RobustWeights.unweighted(seen)
    more = foreseen_equations(solution, seen, state, weights)
    then = with_equations(solution, (*solution.equations, more))
    then_um = sag_um(surface_covariance(then, index))
    present_um = sag_um(surface_covariance(solution, index))
    if not then_um < WORTHWHILE_SHARE * present_um:
        return None

    # The parameters that it determines: those of the worst ambiguity.
    combinations = weak_combinations(solution, index, surface.radius_mm)
    worst = max(combinations, key=lambda combination: combination.figure_um, default=None)
    together: tuple[str, ...] = ()
    if worst is not None:
        together = tuple(name for name, _ in worst.parts)
    return ArtefactAdvice(
        together=together,
        curvature_radius_mm=curvature_mm,
        curvature_radius_sigma_mm=_CURVATURE_SIGMA * curvature_mm,
        vertex_sigma_mm=_VERTEX_SIGMA_MM,
        radius_mm=sphere.radius_mm,
        sag_um=then_um,
    )
