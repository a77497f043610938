"""The number of Zernike terms, and what follows from it."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.film import hencky_bowl, terms_beyond_fit
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays import kernels
from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.model.shape_estimate import ESTIMATE_BYTES_MAX, pack_estimate
from membrane_ctrl.model.zernike_terms import (
    COVARIANCE_UPPER_SIZE,
    NOLL_INDICES,
    ZERNIKE_DEGREE,
    ZERNIKE_TERMS,
    degree_of,
    zernike_columns,
    zernike_labels,
)
from tests.worlds.synthetic_shape import shape_at


@pytest.mark.parametrize(
    ("terms", "degree"), [(21, 5), (28, 6), (36, 7), (45, 8), (55, 9), (66, 10)]
)
def test_a_complete_number_of_terms_has_a_degree(terms: int, degree: int) -> None:
    assert degree_of(terms) == degree


@pytest.mark.parametrize("terms", [-1, 0, 1, 15, 20, 22, 35, 37, 65, 67, 78])
def test_other_numbers_are_refused(terms: int) -> None:
    with pytest.raises(
        ValueError, match=f"^{terms} Zernike terms .* possible: 21, 28, 36, 45, 55, 66$"
    ):
        degree_of(terms)


def test_the_last_term_completes_the_order() -> None:
    assert zernike.noll_orders(ZERNIKE_TERMS)[0] == ZERNIKE_DEGREE
    assert zernike.noll_orders(ZERNIKE_TERMS + 1)[0] == ZERNIKE_DEGREE + 1


def test_labels_and_columns_name_each_term_once() -> None:
    assert [label.lower() + "_um" for label in zernike_labels()] == zernike_columns()
    assert len(set(zernike_columns())) == ZERNIKE_TERMS
    assert zernike_labels(first=4)[0] == "Z4"
    assert zernike_labels()[-1] == f"Z{ZERNIKE_TERMS}"


def test_an_estimate_fits_into_its_message() -> None:
    assert np.triu_indices(ZERNIKE_TERMS)[0].size == COVARIANCE_UPPER_SIZE
    assert len(pack_estimate(shape_at(1.0))) < ESTIMATE_BYTES_MAX


def test_round_terms_are_those_without_azimuthal_order() -> None:
    assert list(hencky_bowl.ROUND_NOLL) == [
        j for j in NOLL_INDICES if zernike.noll_orders(j)[1] == 0
    ]
    assert terms_beyond_fit.ROUND_DEGREES[0] == hencky_bowl.EXCESS_DEGREE + 1
    assert terms_beyond_fit.ROUND_DEGREES[-1] < hencky_bowl.EXCESS_TERMS


def test_the_excess_replaces_piston() -> None:
    assert len(NOLL_INDICES[1:]) + 1 == PARAMETERS


def test_kernels_have_the_degree() -> None:
    assert 2 * kernels.SLOPE_MONOMIALS == ZERNIKE_DEGREE * (ZERNIKE_DEGREE + 1)
    assert kernels.PRODUCT_DEGREE == 2 * (ZERNIKE_DEGREE - 1)


def test_a_kernel_compiled_for_another_number_of_terms_is_not_used() -> None:
    file = kernels.intersect_surface._cache._cache_file
    assert file._source_stamp[-1] == ZERNIKE_TERMS
