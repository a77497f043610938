"""Phases of the x and of the y fringes from frames that show both (docs/how-to/library.md)."""

import numpy as np

from membrane_ctrl.model.arrays import ArrayLike, ComplexArray


def crossed_phasors(
    frames: ArrayLike, shifts_x_rad: ArrayLike, shifts_y_rad: ArrayLike
) -> ComplexArray:
    """Phasors (2, ...) of the x and of the y fringes in frames (N, ...) that show both.

    I = A + B_x cos(phi_x + d_x) + B_y cos(phi_y + d_y), least squares. Raises ValueError if the N
    pairs of steps do not separate the two (fewer than five, or steps that go together).
    """
    stack, x, y = (np.asarray(a, float) for a in (frames, shifts_x_rad, shifts_y_rad))
    design = np.stack([np.ones_like(x), np.cos(x), -np.sin(x), np.cos(y), -np.sin(y)], axis=1)
    if len(design) < 5 or np.linalg.cond(design) > 100:
        raise ValueError(
            f"{len(design)} pairs of phase steps do not determine the phases of crossed fringes"
        )
    _, *parts = np.tensordot(np.linalg.pinv(design), stack, axes=1)
    return np.stack([parts[0] + 1j * parts[1], parts[2] + 1j * parts[3]])
