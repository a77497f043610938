"""Terms of the figure by which the twin's climate changes it."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.climate import compute_profile_change_per_ppm

ROUND_TERMS = (1, 4, 11, 22)  # Noll indices of `compute_figure_change_per_ppm`


@cache
def compute_figure_change_per_ppm() -> FloatArray:
    """Change of the figure at equal sag for an excess strain of 1e-6: its `ROUND_TERMS` in µm.

    Heights are upward and the vertex is held.
    """
    nodes, weights = np.polynomial.legendre.leggauss(40)
    v = (nodes + 1) / 2
    change_um = np.polynomial.polynomial.polyval(v, compute_profile_change_per_ppm())
    terms = [
        math.sqrt(2 * k + 1)
        * float(np.sum(weights / 2 * change_um * np.polynomial.legendre.Legendre.basis(k)(nodes)))
        for k in range(4)
    ]
    return np.array(terms)
