"""Terms of a film's figure that no cause explains, and the covariance of a law's misfit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.metrology.film.film_figure import FilmFigure
from membrane_ctrl.metrology.film.film_law import Bowl, FilmLaw
from membrane_ctrl.metrology.film.misfit_average import GROWTHS, misfit_covariances
from membrane_ctrl.metrology.film.ring_waves import azimuthal_terms, unexplained_term_mm
from membrane_ctrl.metrology.rays.surface import PARAMETERS

Array = NDArray[np.float64]
RADIUS_MM = 500.0
TERM_MM = 0.02
NOISE_MM = 0.006
SETS = 3


def figure(sag_mm: float, parameters_mm: Array, noise_mm: float = 0.0) -> FilmFigure:
    noise_mm2 = noise_mm**2 * np.eye(PARAMETERS)
    geometry_mm = np.zeros((PARAMETERS, 0))
    return FilmFigure("", parameters_mm, noise_mm2, geometry_mm, math.nan, sag_mm)


def bowls(sag_mm: float) -> Bowl:
    return FilmLaw(0.0, 0.3, 1.0, RADIUS_MM).with_sag(np.full((SETS, 1), sag_mm))


@pytest.mark.parametrize("noise_mm", [0.0, NOISE_MM])
def test_terms_without_a_cause_are_their_rms_over_all_free_terms(noise_mm: float) -> None:
    """Six and seven waves have four terms; four and five have eight, of which a ring takes four."""
    parameters_mm = np.zeros(PARAMETERS)
    for order in (6, 7):
        for terms in azimuthal_terms(order):
            parameters_mm[terms] = TERM_MM
    figures = [figure(37.0, parameters_mm, noise_mm) for _ in range(SETS)]
    found_mm = unexplained_term_mm(figures, bowls(37.0), 0.95)
    assert found_mm == pytest.approx(math.sqrt((4 * TERM_MM**2 - 12 * noise_mm**2) / 8))


def test_a_misfit_is_the_same_in_sets_of_one_sag() -> None:
    figures = [figure(37.0, np.zeros(PARAMETERS)) for _ in range(SETS)]
    found = misfit_covariances(figures)
    assert found == pytest.approx(np.ones((GROWTHS.size, SETS, SETS)))
