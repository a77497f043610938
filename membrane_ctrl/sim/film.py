"""The two films: sag and volume under pressure, and their creep.

Under a gauge pressure p a Hencky film's sag and volume both go with (J p)^(1/3), J the compliance
of the material (1/E). So with root = p^(1/3) each is one coefficient times root, and creep is a
slow change of that coefficient.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.hencky import solve_hencky

RADIUS_MM = 500.0
NOMINAL_PRESSURE_PA = 600.0
MODULUS_PA = 4.1e9  # PET, one day after loading
SETTLED_S = 86_400.0
CREEP_START_S = 60.0  # t0 of the creep law (assumed): the time a fill takes to become a load


@dataclass(frozen=True, slots=True)
class Film:
    """One round film."""

    thickness_um: float
    creep_per_decade: float  # m of the creep law J = J0 (1 + m log10(1 + t/t0))
    # Young's modulus of the film `SETTLED_S` after loading: tabulated figures hold for the settled
    # film
    modulus_pa: float = MODULUS_PA

    def sag_mm_per_root_pa(self, age_s: float | FloatArray) -> FloatArray:
        """Sag over the cube root of the pressure: w = c a (p a / (E t))^(1/3); age is time under
        load.
        """
        settled = (
            solve_hencky().sag
            * RADIUS_MM
            * (RADIUS_MM / (self.modulus_pa * self.thickness_um * 1e-3)) ** (1 / 3)
        )
        return np.asarray(
            settled * np.cbrt(self._creep_strain(age_s) / self._creep_strain(SETTLED_S))
        )

    def volume_m3_per_root_pa(self, age_s: float | FloatArray) -> FloatArray:
        """Volume under the film over the cube root of the pressure, V = 0.5214 pi a^2 w, at an age,
        or at each of an array (n,).
        """
        return (
            solve_hencky().volume * math.pi * RADIUS_MM**2 * 1e-9 * self.sag_mm_per_root_pa(age_s)
        )

    def _creep_strain(self, age_s: float | FloatArray) -> FloatArray:
        return np.asarray(
            1 + self.creep_per_decade * np.log10(1 + np.asarray(age_s) / CREEP_START_S)
        )


MIRROR_FILM = Film(thickness_um=50.0, creep_per_decade=0.005)
BACK_FILM = Film(thickness_um=10.0, creep_per_decade=0.02)
NOMINAL_SAG_MM = float(MIRROR_FILM.sag_mm_per_root_pa(SETTLED_S)) * NOMINAL_PRESSURE_PA ** (1 / 3)
