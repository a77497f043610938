"""A pump that is commanded off: read-back off, running on, or inflow that only the mirror shows."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from firmware_iface.roles import BenchReading
from membrane_ctrl.config.schema import Config, LoopConfig, TwinConfig
from membrane_ctrl.controller.standstill import Standstill
from membrane_ctrl.sim.plant import Plant

CONFIG = Config()
DT_S = 0.1
STILL = BenchReading(0.0, 0, 600.0, 101325.0, 23.0, 23.0, 0.0, 0.0, 1, 0.0, False, 0)


class Watched:
    """A pump commanded off, and the readings."""

    def __init__(self) -> None:
        self.stand = Standstill(CONFIG.loop, CONFIG.states)
        self.now_s = 0.0

    def look(
        self, reading: BenchReading | None = STILL, commanded: float = 0.0, link_up: bool = True
    ) -> Standstill:
        self.now_s += DT_S
        self.stand.observe_reading(self.now_s, reading, (commanded, commanded), link_up)
        return self.stand

    def rises(self, um_per_s: float, pa_per_s: float, seconds: float = 30.0, **wrong: float) -> str:
        start = STILL
        for tick in range(round(seconds / DT_S)):
            t_s = tick * DT_S
            reading = replace(
                start, displacement_um=um_per_s * t_s, gauge_pressure_pa=600.0 + pa_per_s * t_s
            )
            if self.look(replace(reading, **wrong)).inflow:  # type: ignore[arg-type]  # numbers all of them
                return self.stand.inflow
        return ""


@pytest.mark.parametrize("readback", [0.03, 1.0, math.nan, math.inf])
def test_a_pump_without_a_read_back_of_zero_in_time_counts_as_running(readback: float) -> None:
    watched = Watched()
    on = replace(STILL, pump_fraction=readback)
    for _ in range(30):
        assert not watched.look(on).runs_on
    for _ in range(3):
        watched.look(on)
    assert watched.stand.runs_on
    assert not watched.stand.seen_off
    assert watched.look().seen_off
    assert not watched.stand.runs_on


def test_one_read_back_of_zero_restarts_the_time() -> None:
    watched = Watched()
    for tick in range(100):
        assert not watched.look(replace(STILL, pump_fraction=1.0 if tick % 25 else 0.0)).runs_on


def test_commands_lost_with_the_link_do_not_count_against_the_pump() -> None:
    """A lost answer proves nothing; a lost link means that the command has not arrived."""
    on = replace(STILL, pump_fraction=1.0)
    lost, cut = Watched(), Watched()
    for _ in range(20):
        lost.look(on)
        cut.look(on)
    lost.look(None)
    cut.look(None, link_up=False)
    for _ in range(15):
        lost.look(on)
        cut.look(on)
    assert lost.stand.runs_on
    assert not cut.stand.runs_on


def test_a_command_to_run_ends_the_watch() -> None:
    watched = Watched()
    on = replace(STILL, pump_fraction=1.0)
    for _ in range(50):
        watched.look(on)
    assert not watched.look(on, commanded=0.5).runs_on
    assert not watched.stand.seen_off
    assert not watched.look(on).runs_on


def test_the_last_of_two_commands_must_be_off_as_well() -> None:
    stand = Standstill(CONFIG.loop, CONFIG.states)
    stand.observe_reading(0.1, STILL, (0.0, 0.5), True)
    assert not stand.seen_off
    stand.observe_reading(0.2, STILL, (0.0, 0.0), True)
    assert stand.seen_off
    stand.observe_reading(0.3, None, (0.0, 0.0), True)
    assert not stand.seen_off
    assert stand.silent_s == pytest.approx(0.1)


def test_a_rising_mirror_reveals_a_pump_with_a_wrong_read_back() -> None:
    watched = Watched()
    seen = watched.rises(2.0, 0.13)
    assert seen.startswith("+40 µm")
    assert watched.now_s < 22.0
    assert not Watched().rises(1.4, 0.09)  # below the limit: 28 µm in 20 s


def test_a_rise_must_show_in_laser_and_gauge_or_in_the_only_one_available() -> None:
    assert not Watched().rises(4.0, 0.0)
    assert not Watched().rises(0.0, 0.3)
    assert Watched().rises(4.0, 0.0, gauge_pressure_pa=math.nan)
    assert Watched().rises(0.0, 0.3, displacement_quality=1)
    assert not Watched().rises(4.0, 0.3, displacement_quality=1, gauge_pressure_pa=math.nan)


def test_warming_air_and_falling_pressure_are_not_mistaken_for_inflow() -> None:
    """1 K of warmer air lifts the mirror by 123 µm, 100 Pa less of ambient pressure by 36 µm."""
    for change in ({"air_temperature_c": 24.0}, {"ambient_pressure_pa": 101225.0}):
        watched = Watched()
        for _ in range(10):
            watched.look()
        assert not watched.rises(
            3.0 if "air_temperature_c" in change else 2.0, 0.15, 22.0, **change
        )


def test_rest_is_detected_after_two_seconds_but_not_while_the_mirror_rises() -> None:
    watched = Watched()
    rests = [watched.look().at_rest for _ in range(40)]
    assert rests.index(True) == pytest.approx(25, abs=2)
    rising = Watched()
    assert not any(
        rising.look(replace(STILL, displacement_um=4.0 * DT_S * tick)).at_rest for tick in range(40)
    )
    blind = Watched()
    assert any(blind.look(replace(STILL, displacement_quality=1)).at_rest for _ in range(40))


def test_weather_on_leakless_films_is_not_mistaken_for_inflow() -> None:
    twin = TwinConfig(scenario="gusty", seed=3, leak_time_constant_s=1e7)
    plant = Plant(twin, CONFIG.pump)
    plant.actuate(0.0, 0.0)
    loop = LoopConfig(feedforward_temperature=False)
    stand, rests = Standstill(loop, CONFIG.states), 0
    for tick in range(round(1200.0 / 0.2)):
        plant.advance(0.2)
        sample = plant.sample()
        reading = replace(
            STILL,
            displacement_um=sample.displacement_um,
            gauge_pressure_pa=sample.gauge_pressure_pa,
            ambient_pressure_pa=sample.ambient_pressure_pa,
            air_temperature_c=sample.air_temperature_c,
        )
        stand.observe_reading(0.2 * tick, reading, (0.0, 0.0), True)
        assert not stand.inflow
        rests += stand.at_rest
    assert rests > 5900
