"""Gray code to absolute phase: the K1/K2 rule, and why both are needed."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.metrology.phase import gray_code, screen_scale

S = np.linspace(0, 8, 4001)[:-1] + 1e-4  # place on the pattern in periods, from its low edge


def _gray(s: np.ndarray) -> np.ndarray:
    v2 = np.clip(np.floor(2 * s), 0, 15).astype(int)
    code = v2 ^ (v2 >> 1)
    return np.stack([(code >> bit) & 1 for bit in (3, 2, 1, 0)]) * 180.0 + 20


def _wrapped(s: np.ndarray) -> np.ndarray:
    return np.angle(np.exp(1j * (2 * np.pi * s - np.pi)))


WHITE, BLACK = np.full(S.shape, 200.0), np.full(S.shape, 20.0)


def test_orders() -> None:
    k1, k2 = gray_code.gray_orders(_gray(S), WHITE, BLACK)
    assert np.array_equal(k1, np.floor(S))
    assert np.array_equal(k2, np.floor((np.floor(2 * S) + 1) / 2))


@pytest.mark.parametrize("shift", [-0.24, -0.1, 0.0, 0.1, 0.24])
def test_orders_misplaced_by_less_than_a_quarter_period_do_no_harm(shift: float) -> None:
    """Noise and blur move a Gray edge against the phase jump: K1 alone would be wrong by a period
    there.
    """
    inner = (S > 0.3) & (S < 7.7)
    k1, k2 = gray_code.gray_orders(_gray(S + shift), WHITE, BLACK)
    absolute = gray_code.absolute_phase(_wrapped(S), k1, k2)
    assert absolute[inner] == pytest.approx((2 * np.pi * S - np.pi)[inner], abs=1e-9)
    if shift:
        naive = _wrapped(S) + 2 * np.pi * k1
        assert np.abs(naive - (2 * np.pi * S - np.pi))[inner].max() > 6


@pytest.mark.parametrize("periods", [3, 4, 8])
def test_screen_distance_is_zero_in_the_middle(periods: int) -> None:
    pattern = PatternConfig(periods=periods, period_mm=50.0)
    phase = 2 * np.pi * np.array([0.0, periods / 2, periods]) - np.pi
    assert screen_scale.screen_mm(phase, pattern) == pytest.approx(
        [-25.0 * periods, 0, 25.0 * periods]
    )
    assert screen_scale.inside_pattern(
        phase * 1.0 + np.array([-0.1, 0, 0.1]), pattern
    ).tolist() == [
        False,
        True,
        False,
    ]
