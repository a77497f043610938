"""Rows of the normal equations for what is known besides the fringes.

Of a film: its ring, the laser, its motion and its law. Of an artefact: its form and place.
"""

import numpy as np

from membrane_ctrl.metrology.calibration.set_state import (
    COMMON,
    RING_PLACE,
    FilmModel,
    References,
    SetState,
    rim_beyond,
    rim_height_harmonics,
)
from membrane_ctrl.metrology.calibration.turned_rows import (
    form_rows,
    seat_rows,
    shift_derivatives,
)
from membrane_ctrl.metrology.film import terms_beyond_fit
from membrane_ctrl.metrology.film.terms_beyond_fit import film_round_terms_mm
from membrane_ctrl.metrology.rays import (
    bench_poses,
    forward_model,
    moved_screen,
    set_phases,
    surface_basis,
)
from membrane_ctrl.metrology.rays.artefacts import Artefact, SeenScreen
from membrane_ctrl.metrology.rays.rim_harmonics import RING, rim_harmonics
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.model.arrays import FloatArray

# 1 sigma of the film's round terms: free, and by the law.
_FREE_MM = 1e-3
_LAW_MM = 1e-7
# 1 sigma of a wave that is held at 0: the fringes of a full set determine it to 1e-7.
_HELD_MM = 1e-10
# A film shifted by 1 mm has 7 nm of one wave beyond the fit's; a coarse picture is 2 nm off there.
_SHIFTED_MM = 5e-6
_EXCESS_STEP_MM = 1e-5  # for the derivative of the law
_TILT_STEP = 1e-4  # for the derivative of an artefact's form


def reference_rows(
    phases: set_phases.SetPhases, state: SetState, common: FloatArray, references: References
) -> FloatArray:
    """Equations for what is known of a set besides its fringes.

    Of a film: ring, laser, motion and law. Of an artefact: its form.

    Parameters
    ----------
    phases : SetPhases
        The set.
    state : SetState
        Values of its own unknowns.
    common : (COMMON,) array
        Values of the common unknowns.
    references : References
        What is known.

    Returns
    -------
    (rows, LOCAL + COMMON + 1) array
        Derivatives by the unknowns, and the known value less the present one as last column; each
        row is divided by its standard uncertainty.
    """
    if isinstance(phases.artefact, SeenScreen):
        # There is no surface: its unknowns are held.
        return np.eye(forward_model.LOCAL, forward_model.LOCAL + COMMON + 1)
    if phases.artefact is not None:
        return np.vstack([_artefact_rows(phases.artefact, state), seat_rows(None, state)])
    rows = np.zeros((RING + 2, forward_model.LOCAL + COMMON + 1))

    # The motion from the x to the y frames.
    motion = rows[-1]
    motion[forward_model.MOTION] = 1.0
    motion[-1] = 1e-3 * phases.motion_um - state.motion_mm
    motion /= max(phases.motion_sigma_um, moved_screen.STILL_UM) * 1e-3

    # The ring: the harmonics of the rim's height are those of all sets.
    ring = rows[:RING]
    ring[:, :PARAMETERS] = rim_harmonics()
    ring[0, PARAMETERS] = 1.0
    ring[:, forward_model.BEYOND] = rim_beyond()
    rows[:RING, forward_model.LOCAL :][:, RING_PLACE] = -np.eye(RING)
    ring[:, -1] = common[RING_PLACE] - rim_height_harmonics(state)
    ring /= references.ring_sigma_um * 1e-3
    if phases.turned is not None:
        # It stands elsewhere, and its waves are part of the figure that turns.
        ring[:] = 0.0

    # The laser: the vertex is at -(1 + scale) (d - reference).
    if np.isfinite(phases.displacement_um):
        moved_mm = (phases.displacement_um - references.reference_um) * 1e-3
        laser = rows[RING]
        laser[PARAMETERS] = 1.0
        laser[forward_model.LOCAL + bench_poses.OPTICAL] = moved_mm
        laser[-1] = -(1 + common[bench_poses.OPTICAL]) * moved_mm - state.vertex_z_mm
        laser /= references.laser_sigma_um * 1e-3
    law = film_rows(state.surface, references.film)
    waves = wave_rows(phases, state, references.waves)
    seat = seat_rows(phases.turned, state)
    return np.vstack([rows, law, waves, seat, form_rows(phases.turned, state, common, references)])


def film_rows(surface: Surface, film: FilmModel) -> FloatArray:
    """Equations of the round terms beyond the fit's by the film's law, as `reference_rows`.

    Parameters
    ----------
    surface : Surface
        The film at its present unknowns.
    film : FilmModel
        What determines these terms.

    Returns
    -------
    (ROUND_DEGREES, LOCAL + COMMON + 1) array
    """
    rows = _beyond_rows(surface)[terms_beyond_fit.ROUND]
    if film == "prestressed":
        # The law gives them for the surface's own excess.
        excess_mm = surface.parameters[-1]
        here = film_round_terms_mm(excess_mm, surface.sag_mm)
        there = film_round_terms_mm(excess_mm + _EXCESS_STEP_MM, surface.sag_mm)
        rows[:, PARAMETERS - 1] = (here - there) / _EXCESS_STEP_MM
        rows[:, -1] += here
    sigma_mm = _LAW_MM
    if film == "free":
        sigma_mm = _FREE_MM
    return rows / sigma_mm


def wave_rows(phases: set_phases.SetPhases, state: SetState, free: bool) -> FloatArray:
    """Equations of the waves beyond the fit's, as `reference_rows`.

    Parameters
    ----------
    phases, state
        The set, and values of its unknowns.
    free : bool
        Whether the film may be orthotropic or its ring uneven; else it has only the waves of a
        round film whose axis is not the bench's.

    Returns
    -------
    (waves, LOCAL + COMMON + 1) array
    """
    # Sizes of the waves; a shifted film has some of azimuthal order 1.
    waves = terms_beyond_fit.WAVES
    sigmas_mm = np.full(len(waves), _HELD_MM)
    if free:
        sigmas_mm = np.array([wave.sigma_mm for wave in waves])
    if phases.turned is not None:
        once = np.array([abs(wave.azimuthal_order) == 1 for wave in waves])
        sigmas_mm = np.hypot(sigmas_mm, np.where(once, _SHIFTED_MM, 0.0))

    # Each wave is what the shift of the film makes of it.
    rows = _beyond_rows(state.surface)[terms_beyond_fit.WAVE]
    places = PARAMETERS + np.arange(terms_beyond_fit.BEYOND_TERMS)[terms_beyond_fit.WAVE]
    by_shift = shift_derivatives(state.surface, places)
    rows[:, forward_model.SEAT.start : forward_model.SEAT.start + 2] = by_shift
    rows[:, -1] -= by_shift @ state.seat[:2]
    return np.asarray(rows / sigmas_mm[:, None])


def _beyond_rows(surface: Surface) -> FloatArray:
    """Equations that each term beyond the fit's is 0, as `reference_rows`, not yet divided."""
    count = terms_beyond_fit.BEYOND_TERMS
    rows = np.zeros((count, forward_model.LOCAL + COMMON + 1))
    rows[:, forward_model.BEYOND] = np.eye(count)
    rows[:, -1] = -np.array(surface.beyond_mm or [0.0] * count)
    return rows


def _artefact_rows(artefact: Artefact, state: SetState) -> FloatArray:
    """Equations of an artefact's form and place, as `reference_rows`.

    Its tilt, the first two terms, is not known.
    """
    terms = [*range(PARAMETERS), *range(forward_model.BEYOND.start, forward_model.BEYOND.stop)]
    rows = np.zeros((len(terms), forward_model.LOCAL + COMMON + 1))
    vertex = rows[0]
    motion = rows[1]
    form = rows[2:]
    surface = state.surface

    # The tilt at the vertex is the surface's own, and the form follows: 5 µm of coma for a
    # milliradian.
    origin = np.zeros(1)
    _, by_x, by_y = surface_basis.evaluate_basis(origin, origin)
    tilt_by_parameters = np.stack([by_x[:, 0], by_y[:, 0]]) / surface.radius_mm
    tilt = tilt_by_parameters @ surface.parameters
    expected_mm = artefact.terms_mm(*tilt)
    beyond_mm = surface.beyond_mm or [0.0] * terms_beyond_fit.BEYOND_TERMS
    present_mm = np.append(surface.parameters, beyond_mm)

    # The form: each term is the expected one, which changes with the tilt (by differences), and all
    # are weighted by the root of their covariance.
    form[:, terms] = np.eye(len(terms))[2:]
    form[:, -1] = (expected_mm - present_mm)[2:]
    for step, by_parameters in zip(_TILT_STEP * np.eye(2), tilt_by_parameters, strict=True):
        change_mm = artefact.terms_mm(*(tilt + step)) - expected_mm
        form[:, :PARAMETERS] -= np.outer(change_mm[2:] / _TILT_STEP, by_parameters)
    root = np.linalg.cholesky(artefact.covariance_mm2()[2:, 2:])
    form[:] = np.linalg.solve(root, form)

    # Its vertex, as stated; and it does not move.
    vertex[PARAMETERS] = 1.0 / artefact.vertex_sigma_mm
    vertex[-1] = (artefact.vertex_mm - state.vertex_z_mm) / artefact.vertex_sigma_mm
    motion[forward_model.MOTION] = 1.0 / (1e-3 * moved_screen.STILL_UM)
    return rows
