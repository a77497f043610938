"""Phases of the x and of the y fringes from frames that show both (docs/how-to/library.md)."""

import numpy as np

from membrane_ctrl.model.arrays import ArrayLike, ComplexArray

_UNKNOWNS = 5  # mean, and cosine and sine of each axis
_LARGEST_CONDITION = 100  # a larger one multiplies the noise of the phases a hundredfold


def crossed_phasors(
    frames: ArrayLike, shifts_x_rad: ArrayLike, shifts_y_rad: ArrayLike
) -> ComplexArray:
    """Phasors of the x and of the y fringes in frames that show both.

    Least squares for I = A + B_x cos(phi_x + d_x) + B_y cos(phi_y + d_y).

    Parameters
    ----------
    frames : (N, ...) array
        Intensities.
    shifts_x_rad, shifts_y_rad : (N,) arrays
        Phase steps d_x and d_y of each frame.

    Returns
    -------
    (2, ...) complex array
        Of x and y: the angle is the phase, the length the amplitude.

    Raises
    ------
    ValueError
        The N pairs of steps do not separate the two: fewer than five, or steps that go together.
    """
    stack = np.asarray(frames, float)
    x = np.asarray(shifts_x_rad, float)
    y = np.asarray(shifts_y_rad, float)

    # I = A + C_x cos d_x - S_x sin d_x + C_y cos d_y - S_y sin d_y, linear in five unknowns.
    columns = [np.ones_like(x), np.cos(x), -np.sin(x), np.cos(y), -np.sin(y)]
    design = np.stack(columns, axis=1)
    if len(design) < _UNKNOWNS or np.linalg.cond(design) > _LARGEST_CONDITION:
        raise ValueError(
            f"{len(design)} pairs of phase steps do not determine the phases of crossed fringes"
        )

    # Least squares for all pixels at once; C + i S is B e^(i phi).
    solved = np.tensordot(np.linalg.pinv(design), stack, axes=1)
    _mean, x_cos, x_sin, y_cos, y_sin = solved
    return np.stack([x_cos + 1j * x_sin, y_cos + 1j * y_sin])
