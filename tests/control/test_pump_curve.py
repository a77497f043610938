"""Command for a flow, against the twin's pump as the reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control.gas import KICK_S, PumpCurve
from membrane_ctrl.sim.plant import PumpModel

PUMP = PumpConfig()
DT_S = 0.02


def delivered(flows_um_per_s: list[float]) -> np.ndarray:
    """Flow of the twin's pump for the commands, um/s, one value a tick."""
    curve, pump, out = PumpCurve(PUMP), PumpModel(PUMP, PUMP.flow_full_um_per_s, 0.005), []
    for flow in flows_um_per_s:
        command = curve.command(flow, DT_S)
        out.append(np.mean([pump.step(command) for _ in range(4)]))
    return np.array(out)


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=60))
def test_command_is_one_the_pump_can_take(flows: list[float]) -> None:
    curve = PumpCurve(PUMP)
    for flow in flows:
        command = curve.command(flow, DT_S)
        assert command == 0.0 or PUMP.stall_fraction < command <= 1.0


@pytest.mark.parametrize("flow", [0.35, 0.6, 1.24, 5.3])
def test_pump_gives_what_was_wanted(flow: float) -> None:
    assert delivered([flow] * 100)[-1] == pytest.approx(flow, rel=1e-4)


def test_small_flow_from_rest_starts_the_pump() -> None:
    """0.35 um/s alone is a command below the start."""
    added_um = DT_S * np.sum(delivered([0.35] * 200) - 0.35)
    assert abs(added_um) < 0.1


def test_kick_comes_once() -> None:
    curve = PumpCurve(PUMP)
    commands = [curve.command(0.35, DT_S) for _ in range(20)]
    assert commands.count(PUMP.start_fraction) == round(KICK_S / DT_S)
    assert commands[-1] < PUMP.start_fraction


def test_kick_again_after_a_stop() -> None:
    curve = PumpCurve(PUMP)
    for _ in range(20):
        curve.command(0.35, DT_S)
    curve.command(0.0, DT_S)
    assert curve.command(0.35, DT_S) == PUMP.start_fraction


@pytest.mark.parametrize(("share", "runs"), [(0.49, False), (0.51, True)])
def test_gap_goes_to_the_nearer_end(share: float, runs: bool) -> None:
    curve = PumpCurve(PUMP)
    for _ in range(20):
        curve.command(1.0, DT_S)
    command = curve.command(share * curve.least_flow_um_per_s, DT_S)
    assert (command > 0) == runs
    assert curve.flow(command) == pytest.approx(curve.least_flow_um_per_s if runs else 0.0)


def test_flow_inverts_command() -> None:
    curve = PumpCurve(PUMP)
    for _ in range(20):
        curve.command(2.0, DT_S)
    assert curve.flow(curve.command(2.0, DT_S)) == pytest.approx(2.0)
    assert curve.flow(0.0) == 0.0
