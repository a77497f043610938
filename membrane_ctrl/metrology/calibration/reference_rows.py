"""Rows of the normal equations for what is known besides the fringes.

Of a film: its ring, the laser, its motion and its law. Of an artefact: its form and place.
"""

import numpy as np

from membrane_ctrl.metrology.calibration.set_state import (
    COMMON,
    FilmModel,
    References,
    SetState,
    rim_beyond,
    rim_of,
)
from membrane_ctrl.metrology.film import terms_beyond_fit
from membrane_ctrl.metrology.film.terms_beyond_fit import round_of
from membrane_ctrl.metrology.rays import (
    bench_parameters,
    bench_poses,
    forward_model,
    set_phases,
    surface_basis,
)
from membrane_ctrl.metrology.rays.artefacts import Artefact, SeenScreen
from membrane_ctrl.metrology.rays.rim_harmonics import RING, rim_harmonics
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.model.arrays import FloatArray

_FREE_MM, _LAW_MM = 1e-3, 1e-7
_HELD_MM = 1e-10  # the fringes of a full set know a wave to 1e-7
_TILT_STEP = 1e-4


def reference_rows(
    phases: set_phases.SetPhases, state: SetState, common: FloatArray, references: References
) -> FloatArray:
    """What is known of the set besides its fringes, as weighted rows [derivatives, miss].

    Of a film: ring, laser, motion and law. Of an artefact: its form.
    """
    if isinstance(phases.artefact, SeenScreen):
        return np.eye(forward_model.LOCAL, forward_model.LOCAL + COMMON + 1)  # there is no surface
    if phases.artefact is not None:
        return _artefact_rows(phases.artefact, state)
    rows = np.zeros((RING + 2, forward_model.LOCAL + COMMON + 1))
    rows[-1, forward_model.MOTION], rows[-1, -1] = 1.0, 1e-3 * phases.motion_um - state.motion_mm
    rows[-1] /= max(phases.motion_sigma_um, set_phases.STILL_UM) * 1e-3
    ring = rows[:RING]
    ring[:, :PARAMETERS] = rim_harmonics()
    ring[0, PARAMETERS] = 1.0
    ring[:, forward_model.BEYOND] = rim_beyond()
    ring[:, forward_model.LOCAL + len(bench_parameters.NAMES) : -1] = -np.eye(RING)
    ring[:, -1] = common[len(bench_parameters.NAMES) :] - rim_of(state)
    ring /= references.ring_sigma_um * 1e-3
    if np.isfinite(phases.displacement_um):
        moved_mm = (phases.displacement_um - references.reference_um) * 1e-3
        laser = rows[RING]
        laser[PARAMETERS] = 1.0
        laser[forward_model.LOCAL + bench_poses.OPTICAL] = moved_mm
        laser[-1] = -(1 + common[bench_poses.OPTICAL]) * moved_mm - state.vertex_z_mm
        laser /= references.laser_sigma_um * 1e-3
    law = film_rows(state.surface, references.film)
    return np.vstack([rows, law, wave_rows(state.surface, references.waves)])


def film_rows(surface: Surface, film: FilmModel) -> FloatArray:
    """What the film says of the round terms beyond the fit's, as weighted rows [derivatives,
    miss].
    """
    rows = _beyond_rows(surface)[terms_beyond_fit.ROUND]
    if film == "prestressed":
        excess_mm, step_mm = surface.parameters[-1], 1e-5
        here, there = (round_of(excess_mm + d, surface.sag_mm) for d in (0.0, step_mm))
        rows[:, PARAMETERS - 1] = (here - there) / step_mm
        rows[:, -1] += here
    return rows / (_FREE_MM if film == "free" else _LAW_MM)


def wave_rows(surface: Surface, free: bool) -> FloatArray:
    """The waves beyond the fit's as weighted rows [derivatives, miss]: of a film that may be
    orthotropic, or 0.
    """
    sigmas_mm = [wave.sigma_mm if free else _HELD_MM for wave in terms_beyond_fit.WAVES]
    return np.asarray(_beyond_rows(surface)[terms_beyond_fit.WAVE] / np.array(sigmas_mm)[:, None])


def _beyond_rows(surface: Surface) -> FloatArray:
    """Each term beyond the fit's is 0: rows [derivatives, miss] without weights."""
    count = terms_beyond_fit.BEYOND_TERMS
    rows = np.zeros((count, forward_model.LOCAL + COMMON + 1))
    rows[:, forward_model.BEYOND] = np.eye(count)
    rows[:, -1] = -np.array(surface.beyond_mm or [0.0] * count)
    return rows


def _artefact_rows(artefact: Artefact, state: SetState) -> FloatArray:
    """Form and place of an artefact as weighted rows; its tilt, the first two terms,
    is not known.
    """
    terms = [*range(PARAMETERS), *range(forward_model.BEYOND.start, forward_model.BEYOND.stop)]
    rows = np.zeros((len(terms), forward_model.LOCAL + COMMON + 1))
    form, (vertex, still) = rows[2:], rows[:2]
    surface, origin = state.surface, np.zeros(1)
    form[:, terms] = np.eye(len(terms))[2:]
    # the tilt at the vertex is the surface's own, and its form follows: 5 µm of coma for a
    # milliradian
    leans = (
        np.stack([part[:, 0] for part in surface_basis.evaluate_basis(origin, origin)[1:]])
        / surface.radius_mm
    )
    tilt = leans @ surface.parameters
    here = artefact.terms_mm(*tilt)
    form[:, -1] = (
        here
        - np.append(surface.parameters, surface.beyond_mm or [0.0] * terms_beyond_fit.BEYOND_TERMS)
    )[2:]
    for step, lean in zip(_TILT_STEP * np.eye(2), leans, strict=True):
        form[:, :PARAMETERS] -= np.outer(
            (artefact.terms_mm(*(tilt + step)) - here)[2:] / _TILT_STEP, lean
        )
    form[:] = np.linalg.solve(np.linalg.cholesky(artefact.covariance_mm2()[2:, 2:]), form)
    vertex[[PARAMETERS, -1]] = (
        np.array([1.0, artefact.vertex_mm - state.vertex_z_mm]) / artefact.vertex_sigma_mm
    )
    still[forward_model.MOTION] = 1.0 / (1e-3 * set_phases.STILL_UM)
    return rows
