"""Rows of the normal equations for a mirror that was turned about its axis.

The film's figure turns with the mirror, what the bench adds does not. Common unknowns are the
turning terms of the film in the mirror's frame (`film_form`) as a function of the sag. A set's own
unknowns are where its mirror's axis is, and by how much more than stated the mirror is turned.
"""

import numpy as np

from membrane_ctrl.metrology.calibration.set_state import (
    COMMON,
    FORM_PLACE,
    References,
    SetState,
)
from membrane_ctrl.metrology.film import film_form
from membrane_ctrl.metrology.rays.forward_model import LOCAL, SEAT
from membrane_ctrl.metrology.rays.height_projection import height_projection
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.rays.turned_mirror import TurnedMirror
from membrane_ctrl.model.arrays import FloatArray, IntArray

# What does not turn: an upright film hangs by its weight, and its gas is lighter or heavier than
# air. Half a micrometre of coma each
_HANGS_UM = 1.0
_SEATED = 1e-6  # mm and rad, of a mirror that was not turned


def seat_rows(turned: TurnedMirror | None, state: SetState) -> FloatArray:
    """Rows of what is known of the seat.

    Parameters
    ----------
    turned : TurnedMirror or None
        How the set's mirror was turned; None: it was not, and its seat is exact.
    state : SetState
        The set's own unknowns.

    Returns
    -------
    (3, LOCAL + COMMON + 1) array
        Weighted rows [derivatives, miss] of x, y and angle.
    """
    # Each number is 0 within its sigma: (step) = -(present value).
    rows = np.zeros((3, LOCAL + COMMON + 1))
    rows[:, SEAT] = np.eye(3)
    rows[:, -1] = -np.array(state.seat)
    sigmas = np.full(3, _SEATED)
    if turned is not None:
        angle_rad = np.radians(turned.angle_sigma_deg)
        sigmas = np.array([turned.seat_sigma_mm, turned.seat_sigma_mm, angle_rad])
    return np.asarray(rows / sigmas[:, None])


def form_rows(
    turned: TurnedMirror | None, state: SetState, common: FloatArray, references: References
) -> FloatArray:
    """The figure of a set is the film's, turned and shifted: weighted rows [derivatives, miss].

    The equation of each turning term is q = T(angle) form(sag) - (shift) grad q: the film's form in
    the mirror's frame, turned by the mirror's angle, and seen from an axis that is shifted.

    Parameters
    ----------
    turned : TurnedMirror or None
        How the set's mirror was turned; None: it was not.
    state : SetState
        The set's own unknowns.
    common : (COMMON,) array
        Unknowns of all sets.
    references : References
        What is known of the form.

    Returns
    -------
    (terms, LOCAL + COMMON + 1) array
        No rows without a turned mirror among the sets, or where the figure does not turn.
    """
    if references.form_sag_mm is None or (turned is not None and not turned.figure_turns):
        return np.zeros((0, LOCAL + COMMON + 1))

    # The film's form at this sag, in the mirror's frame.
    terms = np.array(film_form.TURNING)
    powers = film_form.depth_powers(state.surface.sag_mm - references.form_sag_mm)
    form = powers @ common[FORM_PLACE].reshape(film_form.POWERS, terms.size)

    # The mirror's angle and the shift of its axis.
    x_mm, y_mm, angle_rad = state.seat
    if turned is not None:
        angle_rad += np.radians(turned.angle_deg)
    turn = film_form.turn_matrix(angle_rad)
    by_angle = film_form.turn_derivative(angle_rad) @ form
    by_shift = shift_derivatives(state.surface, terms)

    # q - T form + (shift) grad q = 0, by the surface, the seat and the form.
    rows = np.zeros((terms.size, LOCAL + COMMON + 1))
    rows[np.arange(terms.size), terms] = 1.0
    rows[:, SEAT] = np.column_stack([by_shift, -by_angle])
    rows[:, LOCAL:][:, FORM_PLACE] = -np.kron(powers, turn)
    expected = turn @ form - by_shift @ (x_mm, y_mm)
    rows[:, -1] = expected - state.surface.parameters[terms]
    return np.asarray(rows / form_sigmas_mm(references)[:, None])


def form_sigmas_mm(references: References) -> FloatArray:
    """How well each turning term (terms,) turns with the mirror."""
    hangs_um = np.where(np.array(film_form.TURNING_ORDERS) == 1, _HANGS_UM, 0.0)
    return np.asarray(1e-3 * np.hypot(references.form_sigma_um, hangs_um))


def shift_derivatives(surface: Surface, places: IntArray) -> FloatArray:
    """Change of a surface's terms when it is shifted: its slopes, as terms.

    Parameters
    ----------
    surface : Surface
    places : (n,) int array
        Numbers of the terms among the parameters and the terms beyond the fit's.

    Returns
    -------
    (n, 2) array
        For a shift along x and along y, mm per mm.
    """
    x, y, project = height_projection()
    slopes = surface.slopes(x * surface.radius_mm, y * surface.radius_mm)
    return np.stack([project[places] @ slope for slope in slopes], axis=1)
