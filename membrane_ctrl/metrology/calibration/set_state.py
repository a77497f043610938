"""The unknowns of one set, and what is known besides the fringes."""

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from membrane_ctrl.metrology.film import terms_beyond_fit
from membrane_ctrl.metrology.rays import bench_parameters
from membrane_ctrl.metrology.rays.rim_harmonics import RING, rim_harmonics
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE

COMMON = len(bench_parameters.NAMES) + RING  # parameters of `NAMES`, then the ring
# What the round terms beyond the fit's are. They are a micrometre of a 37 mm bowl, and a nanometre
# of them is 10 µm of sag, so that the film checks the geometry. "free": unknown. "prestressed": by
# the law, for whatever slackness the set's own excess shows. "hencky": by the excess of a film
# without pre-strain and with nu = 0.3.
FilmModel = Literal["free", "hencky", "prestressed"]


@dataclass(frozen=True)
class SetState:
    """Values of a set's own unknowns."""

    surface: Surface
    vertex_z_mm: float  # height of its vertex
    motion_mm: float = 0.0  # by how much the film was deeper in the x frames than in the y frames
    elsewhere: tuple[FloatArray, ...] = ()  # (MOVED,) of each screen elsewhere


@dataclass(frozen=True)
class References:
    """Knowledge besides the fringes."""

    reference_um: float  # laser reading at which the vertex is at z = 0
    laser_sigma_um: float = 1.0  # of a set's mean reading
    # the clamp creeps by less than a micrometre in the minutes that a calibration takes
    ring_sigma_um: float = 1.0  # how far the ring's harmonics may differ from set to set
    film: FilmModel = "free"  # what the film's round terms beyond the fit's are
    waves: bool = False  # whether the film has waves beyond the fit's terms (`film_waves`)


def rim_of(state: SetState) -> FloatArray:
    """Harmonics (RING,) of the rim's height in world."""
    out = rim_harmonics() @ state.surface.parameters
    out[0] += state.vertex_z_mm
    if state.surface.beyond_mm:
        out += rim_beyond() @ state.surface.beyond_mm
    return np.asarray(out)


@cache
def rim_beyond() -> FloatArray:
    """Matrix (RING, BEYOND_TERMS) from the terms beyond the fit's to the harmonics of the rim's
    height.
    """
    out = np.zeros((RING, terms_beyond_fit.BEYOND_TERMS))
    out[0, terms_beyond_fit.ROUND] = terms_beyond_fit.round_series().sum(axis=1)
    waves = out[:, terms_beyond_fit.WAVE]
    for column, wave in enumerate(terms_beyond_fit.WAVES):
        order = wave.azimuthal_order
        if abs(order) <= ZERNIKE_DEGREE:
            row = order if order > 0 else ZERNIKE_DEGREE - order
            waves[row, column] = wave.rms_factor
    return out
