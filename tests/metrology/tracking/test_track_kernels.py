"""The compiled loops over a frame's bins, against the same formulas in double precision, bin by
bin.
"""

import platform
import re

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.metrology.numerics.grouped_sums import sum_by_group
from membrane_ctrl.metrology.tracking.bin_cells import Cells
from membrane_ctrl.metrology.tracking.light_kernels import light_left, light_waves
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

Array = NDArray[np.float64]
COLUMNS = 70


def disc_with_holes() -> NDArray[np.intp]:
    """Bins of a round mirror with dust: cells of one bin up to sixteen."""
    rows, columns = np.mgrid[:61, :COLUMNS]
    seen = np.hypot(rows - 30.2, columns - 33.7) < 28
    seen &= np.random.default_rng(1).random(seen.shape) > 0.1
    return np.flatnonzero(seen)


def test_each_bin_counts_once_and_those_that_repeat_it_not_at_all() -> None:
    bins = disc_with_holes()
    index, counted, cells = Cells.from_bins(bins, COLUMNS)
    assert sorted(index[counted]) == list(bins)
    assert index.size == 1024 * len(cells.offset)
    assert cells.sum_cells(counted).sum() == bins.size
    assert set(np.unique(cells.sum_cells(counted))) >= {1, 16}  # else nothing is shown
    number = index // COLUMNS // 4 * COLUMNS + index % COLUMNS // 4  # of the square
    own = cells.sum_cells(number * counted) / np.maximum(cells.sum_cells(counted), 1)
    np.testing.assert_array_equal((cells.repeat_over_bins(own) - number)[counted], 0)


def test_planes_through_the_bins_of_a_cell() -> None:
    index, counted, cells = Cells.from_bins(disc_with_holes(), COLUMNS)
    row, column = index // COLUMNS, index % COLUMNS
    sloped = (3.0 + 0.2 * row - 0.1 * column).astype(np.float32)
    full = (
        cells.repeat_over_bins(cells.sum_cells(counted)) > 4
    )  # fewer may be in a row, which leaves a slope open
    np.testing.assert_allclose(
        cells.evaluate_planes(cells.fit_planes(sloped))[full], sloped[full], atol=2e-3
    )


@pytest.mark.parametrize("response", [(0.0, 0.0, 0.0, 0.0), (0.3, -0.2, 0.1, -0.05)])
def test_light_and_its_sums_are_those_of_the_formulas(response: tuple[float, ...]) -> None:
    random = np.random.default_rng(2)

    def single(*shape: int, scale: float = 1.0) -> NDArray[np.float32]:
        return (scale * random.normal(size=shape)).astype(np.float32)

    _, counted, cells = Cells.from_bins(disc_with_holes(), COLUMNS)
    bins, squares = counted.size, 64 * len(cells.offset)
    base, light = single(2, bins, scale=2), 50 + single(3, bins, scale=5)
    slow = single(3, ZERNIKE_TERMS, 3, squares)  # derivatives of both phases; terms of the maps
    changes, shifts = single(4, ZERNIKE_TERMS, scale=0.01), single(2)
    edge, gain = (counted * random.random(bins)).astype(np.float32), 1 + single(bins, scale=0.01)
    reach = np.where(random.random(bins) < 0.1, 0, 60).astype(np.float32)
    seen = 50 + single(bins, scale=40)
    bent = np.array(response, np.float32)

    x, y = (
        base
        + cells.evaluate_planes(np.einsum("k,akiq->aiq", changes[0], slow[:2]))
        + shifts[:, None].astype(float)
    )
    maps = 1 + cells.evaluate_planes(np.einsum("mk,kiq->miq", changes[1:], slow[2])).astype(float)
    v = 0.5 + 0.25 * (np.cos(x) + np.cos(y))
    beyond = sum(c * (v**k - v) for k, c in enumerate(response, 2))
    slope = sum(c * (k * v ** (k - 1) - 1) for k, c in enumerate(response, 2))
    swings = light[1:] * maps[1:]
    expected = np.stack(
        [
            -(swings[0] + swings.sum(axis=0) * slope / 2) * np.sin(x),
            -(swings[1] + swings.sum(axis=0) * slope / 2) * np.sin(y),
            light[0].astype(float),
            light[1] * (np.cos(x) + 2 * beyond),
            light[2] * (np.cos(y) + 2 * beyond),
            light[0] * maps[0]
            + swings[0] * (np.cos(x) + 2 * beyond)
            + swings[1] * (np.cos(y) + 2 * beyond),
        ]
    )
    rest = seen - gain * expected[5]
    far = np.clip((np.abs(rest) / np.maximum(reach, 1e-9) - 0.6) / 0.4, 0, 1)
    weight = np.where(reach > 0, (1 - far**2) ** 2, 0)
    assert 0.1 < np.mean(weight == 0) < 0.9
    assert 0.1 < np.mean(weight == 1) < 0.9
    pull = cells.sum_moments(edge * weight * rest * gain * expected[:5])
    by_surface = np.einsum("akiq,aiq->k", slow[:2].astype(float), pull[:2])
    by_maps = np.einsum("kiq,miq->mk", slow[2].astype(float), pull[2:])

    shown = base, light, cells.arrange_blocks(*slow), cells.offset, bent, changes, shifts
    waves, out, right = (
        np.empty((6, bins), np.float32),
        np.empty((4, bins), np.float32),
        np.empty((4, ZERNIKE_TERMS)),
    )
    light_waves(*shown, waves)
    light_left(*shown, edge, gain, seen, reach, right, out)
    np.testing.assert_allclose(waves, expected, atol=2e-3)
    np.testing.assert_allclose(out[0], rest, atol=2e-3)
    np.testing.assert_allclose(out[1], weight, atol=3e-4)
    np.testing.assert_allclose(
        out[2], weight * rest * edge * gain * expected[5], atol=2.0
    )  # of 10,000
    np.testing.assert_allclose(out[3], weight * edge * expected[5] ** 2, atol=3.0)
    sums = np.vstack([by_surface, by_maps])
    np.testing.assert_allclose(right, sums, atol=1e-4 * np.abs(sums).max())


@pytest.mark.skipif(
    platform.machine() != "x86_64", reason="the instruction's name is another one there"
)
def test_the_loop_over_bins_uses_vector_units() -> None:
    """It did not where the compiler could not tell that its arrays do not overlap, and took five
    times as long.
    """
    single, wide, blocks = numba.float32[::1], numba.float32[:, ::1], numba.float32[:, :, ::1]
    offset, sums = numba.float32[:, :, :, ::1], numba.float64[:, ::1]
    shown = wide, wide, blocks, offset, single, wide, single
    compiled = numba.njit(
        nogil=True, error_model="numpy", fastmath=light_left.targetoptions["fastmath"]
    )(light_left.py_func)
    compiled.compile((*shown, single, single, single, single, sums, wide))
    (code,) = compiled.inspect_asm().values()
    assert re.search(
        "roundps|vrndscaleps", code
    )  # of several numbers at a time; that of one ends in "ss"


def test_sums_by_number() -> None:
    random = np.random.default_rng(3)
    number, values = random.integers(0, 9, 500), random.normal(size=(2, 500))
    sums = sum_by_group(number, values, 12)
    np.testing.assert_allclose(sums, [np.bincount(number, one, 12) for one in values])
