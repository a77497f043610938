"""Continuity of the phase and the Gray code, each checked by the other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.metrology.phase.fringe_orders import resolve_orders
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.region_unwrap import tear_share, unwrap_regions

ROWS, COLUMNS = np.mgrid[0:60, 0:90].astype(float)
PHASE = 0.3 * math.pi + COLUMNS * 0.15 * math.pi + 0.01 * ROWS  # 6.7 periods across
WRAPPED = np.angle(np.exp(1j * PHASE))
EVERYWHERE = np.ones(PHASE.shape, bool)


def true_bits() -> np.ndarray:
    return np.stack([gray_bit(PHASE, bit)[0] for bit in (1, 2, 3, 4)])


def test_the_orders_are_the_codes() -> None:
    found = resolve_orders(WRAPPED, true_bits(), EVERYWHERE)
    assert found.phase_rad == pytest.approx(PHASE)
    assert found.agreement == 1.0
    assert not found.torn


@pytest.mark.parametrize("bit", range(4))
@pytest.mark.parametrize("content", [0, 1])
def test_one_wrong_gray_frame_is_outvoted(bit: int, content: int) -> None:
    bits = true_bits()
    bits[bit] = bool(content)
    found = resolve_orders(WRAPPED, bits, EVERYWHERE)
    assert found.phase_rad == pytest.approx(PHASE)
    assert found.agreement < 0.95


def test_islands_vote_for_themselves_and_specks_are_dropped() -> None:
    mask = EVERYWHERE.copy()
    mask[:, 40:43] = False
    mask[:, 80:] = False
    mask[30, 85] = True
    found = resolve_orders(WRAPPED, true_bits(), mask)
    known = np.isfinite(found.phase_rad)
    assert np.array_equal(known, mask & (COLUMNS < 80))
    assert found.phase_rad[known] == pytest.approx(PHASE[known])


def test_a_torn_phase_gets_the_orders_of_the_code() -> None:
    torn = np.where(np.sin(PHASE) > 0, 0.01, math.pi - 0.01) + 0.3 * np.sin(7 * ROWS)
    wrapped = np.angle(np.exp(1j * torn))
    assert resolve_orders(wrapped, true_bits(), EVERYWHERE).torn


def test_continuity_leads_around_holes() -> None:
    mask = EVERYWHERE.copy()
    mask[5:55, 20:70] = False
    smooth, region = unwrap_regions(WRAPPED, mask)
    assert region.max() == 0
    assert np.ptp((smooth - PHASE)[mask]) < 1e-9
    assert tear_share(smooth) == 0.0


@pytest.mark.parametrize("bit", [1, 2, 3, 4])
def test_a_bit_changes_where_its_edges_are(bit: int) -> None:
    phase = np.linspace(-math.pi + 1e-3, 15 * math.pi - 1e-3, 4001)
    shown, from_edge = gray_bit(phase, bit)
    changes = np.flatnonzero(np.diff(shown.astype(int)))
    assert len(changes) == 2 ** (bit - 1)
    assert np.max(from_edge[changes]) < 0.02
    assert np.all(np.diff(shown[from_edge > 0.5].astype(int)).nonzero()[0].size == len(changes))
