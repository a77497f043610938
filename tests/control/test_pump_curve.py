"""Command for a flow: the straight line on the twin's pump, measured curves on foreign pumps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.interpolate import PchipInterpolator

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control.pump_curve import KICK_S, PumpCurve
from membrane_ctrl.sim.pump_model import PumpModel
from tests.worlds.foreign_plant import CURVES, ForeignPump

PUMP = PumpConfig()
DT_S = 0.02


def delivered(flows_um_per_s: list[float]) -> np.ndarray:
    """Flow of the twin's pump for the commands, µm/s, one value a tick."""
    curve, pump, out = PumpCurve(PUMP), PumpModel(PUMP, PUMP.flow_full_um_per_s, 0.005), []
    for flow in flows_um_per_s:
        command = curve.command(flow, DT_S)
        out.append(np.mean(pump.run_steps(command, 4)))
    return np.array(out)


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=60))
def test_the_command_is_within_the_pump_range(flows: list[float]) -> None:
    curve = PumpCurve(PUMP)
    for flow in flows:
        command = curve.command(flow, DT_S)
        assert command == 0.0 or PUMP.stall_fraction < command <= 1.0


@pytest.mark.parametrize("flow", [0.35, 0.6, 1.24, 5.3])
def test_the_pump_gives_the_wanted_flow(flow: float) -> None:
    assert delivered([flow] * 100)[-1] == pytest.approx(flow, rel=1e-4)


def test_small_flow_from_rest_starts_the_pump() -> None:
    """0.35 µm/s alone is a command below the start."""
    added_um = DT_S * np.sum(delivered([0.35] * 200) - 0.35)
    assert abs(added_um) < 0.1


def test_the_start_kick_is_given_once() -> None:
    curve = PumpCurve(PUMP)
    commands = [curve.command(0.35, DT_S) for _ in range(20)]
    assert commands.count(PUMP.start_fraction) == round(KICK_S / DT_S)
    assert commands[-1] < PUMP.start_fraction


def test_the_start_kick_is_repeated_after_a_stop() -> None:
    curve = PumpCurve(PUMP)
    for _ in range(20):
        curve.command(0.35, DT_S)
    curve.command(0.0, DT_S)
    assert curve.command(0.35, DT_S) == PUMP.start_fraction


@pytest.mark.parametrize(("share", "runs"), [(0.49, False), (0.51, True)])
def test_a_flow_in_the_gap_goes_to_the_nearer_end(share: float, runs: bool) -> None:
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


POINTS = np.linspace(0.05, 1.0, 11)


def measured(shape: str, play: float = 0.0) -> PumpConfig:
    """A curve of the second world as somebody with a flow meter would enter it."""
    rising = [7.0 * CURVES[shape](max(0.0, d - play)) / CURVES[shape](1.0) for d in POINTS]
    falling = [7.0 * CURVES[shape](min(1.0, d + play)) / CURVES[shape](1.0) for d in POINTS]
    return PumpConfig(
        start_fraction=0.0,
        stall_fraction=0.0,
        curve_fraction=tuple(POINTS),
        curve_um_per_s=tuple(rising),
        curve_falling_um_per_s=tuple(falling) if play else (),
    )


def test_a_measured_curve_is_scipys_cubic() -> None:
    """Unevenly spaced, with a flat part in the middle and at the end."""
    commands, flows = (0.1, 0.2, 0.5, 0.6, 0.8, 1.0), (0.0, 2.0, 2.0, 5.0, 6.0, 6.0)
    curve, reference = (
        PumpCurve(PumpConfig(curve_fraction=commands, curve_um_per_s=flows)),
        PchipInterpolator,
    )
    at = np.linspace(0.1, 1.0, 500)
    off = [curve.flow(d) for d in at] - reference(commands, flows)(at)
    assert np.abs(off).max() < 0.005 * flows[-1]


@pytest.mark.parametrize("shape", ["quadratic", "root", "s-shaped", "dead zone"])
def test_a_pump_with_a_curved_characteristic_gives_the_wanted_flow(shape: str) -> None:
    curve, pump = PumpCurve(measured(shape)), ForeignPump(shape, 7.0)
    for flow in np.linspace(
        2.3 if shape == "root" else 0.3, 6.9, 40
    ):  # a root is steep at its foot
        command = curve.command(flow, DT_S)
        assert curve.flow(command) == pytest.approx(flow, abs=1e-6)
        assert pump.settled(command) == pytest.approx(flow, abs=0.03 * 7.0)


@given(st.lists(st.floats(0.2, 6.5), min_size=2, max_size=30))
def test_a_pump_with_hysteresis_gives_the_wanted_flow(flows: list[float]) -> None:
    """Up and down in any order; one branch alone would be wrong by 0.04 of the command,
    0.3 µm/s.
    """
    curve, pump = (
        PumpCurve(measured("hysteretic", play=0.04)),
        ForeignPump("hysteretic", 7.0, play=0.04, lag_s=1e-3),
    )
    for flow in flows:
        command = curve.command(flow, DT_S)
        for _ in range(40):
            given = pump.step(command)
        assert curve.flow(command) == pytest.approx(flow, abs=1e-6)
        assert given == pytest.approx(flow, abs=0.01 * 7.0)


@pytest.mark.parametrize("wanted", [0.0, 0.3])
def test_a_falling_branch_that_ends_in_the_middle_can_be_stopped(wanted: float) -> None:
    """The pump ran on at its first command, where the branch gives 1.3 µm/s: the mirror rose by 62
    µm.
    """
    table = {"curve_fraction": (0.086, 0.12, 1.0), "curve_um_per_s": (0.001, 1.8, 6.3)}
    pump = {"start_fraction": 0.0, "stall_fraction": 0.0, "curve_falling_um_per_s": (1.3, 2.0, 6.3)}
    curve = PumpCurve(PumpConfig.model_validate(table | pump))
    for _ in range(20):
        curve.command(2.0, DT_S)
    assert curve.least_flow_um_per_s == pytest.approx(1.3)
    assert [curve.command(wanted, DT_S) for _ in range(3)] == [0.0] * 3


def test_nothing_is_commanded_beyond_the_last_point() -> None:
    curve = PumpCurve(PumpConfig(curve_fraction=(0.2, 0.7), curve_um_per_s=(0.5, 4.0)))
    assert curve.command(99.0, DT_S) == 0.7
    assert curve.flow(1.0) == 4.0
    assert curve.flow(0.19) == 0.0


NAN = float("nan")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            {"curve_fraction": (0.1, 0.3, 0.2), "curve_um_per_s": (0, 1, 2)},
            "curve_fraction must rise",
        ),
        (
            {"curve_fraction": (0.1, 0.2, 0.3), "curve_um_per_s": (0, 2, 1)},
            "curve_um_per_s must not fall",
        ),
        ({"curve_fraction": (0.1,), "curve_um_per_s": (1,)}, "at least two commands"),
        ({"curve_fraction": (0.1, 0.2)}, "2 commands, curve_um_per_s 0 flows"),
        ({"curve_um_per_s": (1, 2)}, "0 commands"),
        ({"curve_fraction": (0.1, NAN), "curve_um_per_s": (1, 2)}, "curve_fraction"),
        ({"curve_fraction": (0.1, 1.2), "curve_um_per_s": (1, 2)}, "curve_fraction"),
        ({"curve_fraction": (0.1, 0.2), "curve_um_per_s": (1, "x")}, "curve_um_per_s"),
        ({"curve_fraction": (0.1, 0.2), "curve_um_per_s": (0, 0)}, "flow_full_um_per_s"),
        (
            {"curve_fraction": (0.1, 0.2), "curve_um_per_s": (1, 2), "flow_full_um_per_s": 3},
            "last flow of the curve",
        ),
        (
            {
                "curve_fraction": (0.1, 0.2),
                "curve_um_per_s": (1, 2),
                "curve_falling_um_per_s": (0.5, 2),
            },
            "curve_falling_um_per_s must not be below",
        ),
    ],
)
def test_an_invalid_curve_is_refused(table: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        PumpConfig.model_validate(table)


def test_a_curve_survives_its_own_dump() -> None:
    pump = measured("quadratic")
    assert PumpConfig.model_validate(pump.model_dump()) == pump
    assert pump.flow_full_um_per_s == pytest.approx(7.0)
