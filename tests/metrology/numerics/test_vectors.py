"""Lengths of many vectors, and the blocks in which they are worked on."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.numerics.vectors import column_blocks, vector_lengths


def test_lengths_are_those_of_numpy_and_leave_the_vectors() -> None:
    vectors = np.random.default_rng(1).normal(size=(3, 1000))
    before = vectors.copy()
    assert np.allclose(vector_lengths(vectors), np.linalg.norm(vectors, axis=0), rtol=1e-14)
    assert np.array_equal(vectors, before)


@pytest.mark.parametrize("count", [0, 1, 16_384, 50_000])
def test_blocks_cover_each_column_once(count: int) -> None:
    seen = np.zeros(count, int)
    for block in column_blocks(count):
        seen[block] += 1
    assert (seen == 1).all()
