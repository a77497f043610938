"""The unknowns of one set, and what is known besides the fringes."""

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from membrane_ctrl.metrology.film import film_form, terms_beyond_fit
from membrane_ctrl.metrology.rays import bench_parameters
from membrane_ctrl.metrology.rays.rim_harmonics import RING, rim_harmonics
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE

# The common unknowns: parameters of `NAMES`, the ring, and the film's figure in the mirror's frame
RING_PLACE = slice(len(bench_parameters.NAMES), len(bench_parameters.NAMES) + RING)
FORM_PLACE = slice(RING_PLACE.stop, RING_PLACE.stop + film_form.FORM)
COMMON = FORM_PLACE.stop
# What determines the film's round terms beyond the fit's. They are a micrometre of a 37 mm bowl,
# and a nanometre of them is 10 µm of sag, so that the film checks the geometry. "free": nothing.
# "prestressed": the law, for the slackness that the set's own excess shows. "hencky": the excess,
# of a film without pre-strain and with nu = 0.3.
FilmModel = Literal["free", "hencky", "prestressed"]
FORM_SIGMA_UM = 0.3


@dataclass(frozen=True)
class SetState:
    """Values of the unknowns of one set.

    Attributes
    ----------
    surface : Surface
        The film, or the artefact.
    vertex_z_mm : float
        Height of its vertex.
    motion_mm : float
        By how much the film was deeper in the x frames than in the y frames.
    moved_screens : tuple of (MOVED,) arrays
        Unknowns of each further place of the screen.
    seat : (float, float, float)
        Of a turned mirror: place of its axis along x and y, mm, and by how much it is turned
        further than stated, rad.
    """

    surface: Surface
    vertex_z_mm: float
    motion_mm: float = 0.0
    moved_screens: tuple[FloatArray, ...] = ()
    seat: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class References:
    """Knowledge besides the fringes.

    Attributes
    ----------
    reference_um : float
        Laser reading at which the vertex is at z = 0.
    laser_sigma_um : float
        Standard uncertainty of a set's mean reading.
    ring_sigma_um : float
        How far the ring's harmonics may differ from set to set: the clamp creeps by less than a
        micrometre in the minutes that a calibration takes.
    film : FilmModel
        What determines the film's round terms beyond the fit's.
    waves : bool
        Whether the film has waves beyond the fit's terms (`film_waves`).
    form_sag_mm : float, optional
        Sag at which the film's figure in the mirror's frame is stated; None: no mirror was turned.
    form_sigma_um : float
        How well each term of the figure turns with the mirror.
    """

    reference_um: float
    laser_sigma_um: float = 1.0
    ring_sigma_um: float = 1.0
    film: FilmModel = "free"
    waves: bool = False
    form_sag_mm: float | None = None
    form_sigma_um: float = FORM_SIGMA_UM


def rim_height_harmonics(state: SetState) -> FloatArray:
    """Harmonics (RING,) of the rim's height in world, mm."""
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
            row = order
            if order <= 0:
                row = ZERNIKE_DEGREE - order
            waves[row, column] = wave.rms_factor
    return out
