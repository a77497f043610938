"""Gas beside the gauge: together they contradict optics that are frozen."""

from __future__ import annotations

import math

import pytest

from membrane_ctrl.control.gas_balance import GasBalance, GasBalanceState

DT_S = 0.1
LEAK_UM_PER_S = 1.2


def balanced(flow_um_per_s: float, duration_s: float, leak_um_per_s: float = 5.0) -> GasBalance:
    """After a lost laser, with this flow and whatever the loop then takes for the leak."""
    balance = GasBalance(GasBalanceState())
    balance.step(flow_um_per_s, LEAK_UM_PER_S, False, DT_S)
    for _ in range(round(duration_s / DT_S)):
        balance.step(flow_um_per_s, leak_um_per_s, True, DT_S)
    return balance


@pytest.mark.parametrize("flow_um_per_s", [0.0, 5.3])
def test_gas_and_gauge_together_contradict_the_optics(flow_um_per_s: float) -> None:
    seconds = 14.0 / abs(flow_um_per_s - LEAK_UM_PER_S)
    balance = balanced(flow_um_per_s, seconds)
    assert "of gas and the gauge" in balance.explain_contradiction(0.5)
    assert balance.explain_contradiction(0.3) == ""
    assert balanced(flow_um_per_s, seconds / 2).explain_contradiction(0.5) == ""


def test_an_error_of_the_leak_is_forgotten() -> None:
    assert balanced(LEAK_UM_PER_S + 0.15, 3600.0).explain_contradiction(1.0) == ""


def test_with_the_laser_nothing_is_counted() -> None:
    balance = balanced(5.3, 20.0)
    balance.step(5.3, LEAK_UM_PER_S, False, DT_S)
    assert balance.explain_contradiction(1.0) == ""


def test_a_tick_without_a_flow_counts_nothing() -> None:
    balance = balanced(5.3, 20.0)
    before_um = balance.memory.excess_um
    balance.step(math.nan, math.nan, True, DT_S)
    assert balance.memory.excess_um == before_um
