"""The pump only adds, sticks, stalls and responds late; the plant around it fills in two hours."""

from __future__ import annotations

import math

import pytest

from membrane_ctrl.config.schema import PumpConfig, TwinConfig
from membrane_ctrl.sim.plant import STEP_S, Plant
from membrane_ctrl.sim.pump_model import PumpModel

FULL_ML_PER_S = 6.0


@pytest.fixture
def pump() -> PumpModel:
    return PumpModel(PumpConfig(), FULL_ML_PER_S, STEP_S)


def settle(pump: PumpModel, command: float) -> float:
    return pump.run_steps(command, 1000)[-1]


def test_flow_against_command_once_running(pump: PumpModel) -> None:
    for command in (1.0, 0.6, 0.3, 0.16):
        assert settle(pump, command) == pytest.approx(FULL_ML_PER_S * (command - 0.1) / 0.9)


def test_sticks_until_the_start_command(pump: PumpModel) -> None:
    assert settle(pump, 0.219) == 0.0
    assert settle(pump, 0.22) == pytest.approx(FULL_ML_PER_S * 0.12 / 0.9)
    assert settle(pump, 0.15) == pytest.approx(FULL_ML_PER_S * 0.05 / 0.9)


def test_stalls_and_needs_the_start_command_again(pump: PumpModel) -> None:
    settle(pump, 0.5)
    assert settle(pump, 0.149) == pytest.approx(0.0, abs=1e-6)
    assert settle(pump, 0.21) == pytest.approx(0.0, abs=1e-6)
    assert settle(pump, 0.25) == pytest.approx(1.0)


def test_never_takes_gas_away() -> None:
    pump = PumpModel(
        PumpConfig(dead_fraction=0.3), FULL_ML_PER_S, STEP_S
    )  # dead above stall and start
    assert settle(pump, 0.25) == 0.0
    settle(pump, 1.0)
    assert all(flow >= 0 for flow in pump.run_steps(0.2, 2000))


def test_answers_after_transport_and_lag(pump: PumpModel) -> None:
    flows = pump.run_steps(1.0, 200)
    dead = round(TwinConfig().pump_delay_s / STEP_S)
    assert flows[:dead] == [0.0] * dead
    assert flows[dead] > 0
    at_one_lag = flows[dead + round(TwinConfig().pump_lag_s / STEP_S) - 1]
    assert at_one_lag == pytest.approx(FULL_ML_PER_S * (1 - math.exp(-1)), rel=1e-9)


def test_hold_is_where_the_pump_stays(pump: PumpModel) -> None:
    command = pump.settle_at_flow(1.4)
    assert pump.run_steps(command, 100) == pytest.approx([1.4] * 100)


@pytest.mark.parametrize("flow_ml_per_s", [0.2, 7.0])
def test_hold_of_a_flow_it_cannot_keep_leaves_it_off(pump: PumpModel, flow_ml_per_s: float) -> None:
    assert pump.settle_at_flow(flow_ml_per_s) == 0.0
    assert pump.run_steps(0.2, 1) == [0.0]


def test_refuses_a_pump_that_never_delivers() -> None:
    with pytest.raises(ValueError, match="dead_fraction"):
        PumpModel(PumpConfig(dead_fraction=1.0), FULL_ML_PER_S, STEP_S)


def test_a_fresh_plant_is_just_held() -> None:
    plant = Plant(TwinConfig(scenario="calm"), PumpConfig())
    before = plant.truth()
    assert before.displacement_um == pytest.approx(-25.0, abs=1e-6)
    assert before.pump_um_per_s == pytest.approx(before.leak_um_per_s)
    plant.advance(10.0)
    assert plant.truth().displacement_um == pytest.approx(-25.0, abs=0.01)
    assert plant._pump_fraction == pytest.approx(0.1 + 0.9 * 1.234 / 5.3, abs=0.001)


def test_full_flow_lifts_the_centre_by_the_configured_speed() -> None:
    plant = Plant(
        TwinConfig(scenario="calm", leak_time_constant_s=1e8), PumpConfig(flow_full_um_per_s=4.0)
    )
    plant.actuate(1.0, 0.0)
    plant.advance(5.0)
    assert plant.truth().pump_um_per_s == pytest.approx(4.0, rel=2e-3)


@pytest.mark.campaign
def test_filling_from_flat_takes_two_hours() -> None:
    plant = Plant(
        TwinConfig(scenario="calm", from_flat=True, leak_time_constant_s=1e8), PumpConfig()
    )
    assert plant.truth().sag_mm == 0.0
    assert plant.truth().displacement_um == pytest.approx(-37_094, abs=1)
    plant.actuate(1.0, 0.0)
    hours = 0.0
    while plant.truth().displacement_um < 0 and hours < 4:
        plant.advance(60.0)
        hours += 1 / 60
    assert hours == pytest.approx(2.0, abs=0.15)
    assert plant.truth().gauge_pressure_pa == pytest.approx(600, rel=0.03)


@pytest.mark.parametrize("command", [(-0.1, 0.0), (1.1, 0.0), (0.0, 2.0), (float("nan"), 0.0)])
def test_refuses_a_command_that_is_no_fraction(command: tuple[float, float]) -> None:
    plant = Plant(TwinConfig(scenario="calm"), PumpConfig())
    with pytest.raises(ValueError, match="fractions"):
        plant.actuate(*command)


@pytest.mark.parametrize("shape", ["quadratic", "root", "s-shaped", "saturating", "pwm"])
def test_shapes_of_the_twins_pump(shape: str) -> None:
    """Each has the full flow of the straight line at its end, and another one in the middle."""
    pump = PumpModel(
        PumpConfig(), FULL_ML_PER_S, STEP_S, TwinConfig.model_validate({"pump_shape": shape})
    )
    flows = [settle(pump, command) for command in (0.3, 0.5, 0.7, 0.9, 1.0)]
    assert flows == sorted(flows)
    assert flows[-1] == pytest.approx(FULL_ML_PER_S)
    straight = FULL_ML_PER_S * 0.4 / 0.9
    assert (
        flows[1] == pytest.approx(straight, abs=0.01)
        if shape == "pwm"
        else abs(flows[1] - straight) > 0.05
    )


def test_a_hysteretic_twin_gives_more_on_the_way_down() -> None:
    pump = PumpModel(PumpConfig(), FULL_ML_PER_S, STEP_S, TwinConfig(pump_shape="hysteretic"))
    up = settle(pump, 0.5)
    settle(pump, 0.9)
    assert settle(pump, 0.5) - up == pytest.approx(0.08 * FULL_ML_PER_S / 0.9, rel=0.02)


def test_the_twin_follows_a_measured_curve() -> None:
    config = PumpConfig(curve_fraction=(0.2, 0.5, 1.0), curve_um_per_s=(0.0, 1.0, 4.0))
    pump = PumpModel(config, 4.0, STEP_S)
    assert [settle(pump, command) for command in (0.5, 1.0)] == pytest.approx([1.0, 4.0], rel=1e-3)
    assert pump.settle_at_flow(1.0) == pytest.approx(0.5, abs=1e-3)


def test_steps_in_one_call_are_steps_one_by_one() -> None:
    together = PumpModel(PumpConfig(), FULL_ML_PER_S, STEP_S)
    single = PumpModel(PumpConfig(), FULL_ML_PER_S, STEP_S)
    for command in (0.3, 0.18, 0.1, 0.18, 1.0):
        one_by_one = [single.run_steps(command, 1)[0] for _ in range(40)]
        assert together.run_steps(command, 40) == one_by_one
