"""The board in virtual time does what the board does: watchdog, restart, latches, and nothing
without a link.
"""

from __future__ import annotations

import math

import pytest

from firmware_iface.emulators.pump_board import StoredSettings
from firmware_iface.register_map import load_default_map
from firmware_iface.roles import ALL_FAULTS, BenchCommand, LinkDownError, LinkError
from membrane_ctrl.config.schema import Config, TwinConfig
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

CONFIG = Config(twin=TwinConfig(scenario="calm"))
WATCHDOG, OVER_PRESSURE = (
    load_default_map().make_fault_mask(name) for name in ("watchdog", "over_pressure")
)
GAUGE_LOST = load_default_map().make_fault_mask("gauge_lost")


@pytest.fixture
def bench() -> VirtualBench:
    made = VirtualBench(Plant(CONFIG.twin, CONFIG.pump), watchdog_s=0.5)
    made.open()
    return made


def test_without_a_write_the_pump_stops_after_the_watchdog_period(bench: VirtualBench) -> None:
    bench.advance(0.02)
    bench.write(BenchCommand(0.5, 0.0))
    for _ in range(24):
        bench.advance(0.02)
        assert bench.board.pump_fraction == pytest.approx(0.5, abs=1e-4)
    bench.advance(0.04)
    assert bench.board.pump_fraction == 0.0
    assert bench.read().watchdog_tripped
    bench.write(BenchCommand(0.5, 0.0))
    assert bench.board.pump_fraction == 0.0  # latched
    bench.clear_faults(ALL_FAULTS)
    bench.write(BenchCommand(0.5, 0.0))
    assert bench.board.pump_fraction > 0.0


def test_a_board_that_restarted_must_be_opened_again(bench: VirtualBench) -> None:
    bench.write(BenchCommand(0.5, 0.0))
    bench.power_cycle()
    assert bench.board.pump_fraction == 0.0
    with pytest.raises(LinkDownError, match="restarted"):
        bench.read()
    bench.open()
    assert bench.read().latched_faults == 0


def test_the_boards_own_pressure_limit_vents(bench: VirtualBench) -> None:
    bench.write(BenchCommand(0.5, 0.0))
    bench.wrong.gauge_offset_pa = 300.0
    bench.advance(0.02)
    assert (bench.board.pump_fraction, bench.board.vent_fraction) == (0.0, 1.0)


def test_switches_of_the_link(bench: VirtualBench) -> None:
    bench.wrong.silent = True
    with pytest.raises(LinkError, match="no answer"):
        bench.write(BenchCommand(0.4, 0.0))
    assert bench.board.pump_fraction > 0.3  # executed nevertheless
    bench.wrong.silent, bench.wrong.unreachable = False, True
    with pytest.raises(LinkDownError):
        bench.read()
    bench.wrong.unreachable = False
    with pytest.raises(LinkDownError):
        bench.read()  # does not reconnect by itself
    bench.open()
    assert math.isfinite(bench.read().displacement_um)


def test_switches_of_the_sensors(bench: VirtualBench) -> None:
    bench.advance(0.1)
    before = bench.read()
    bench.wrong.laser_stuck = True
    bench.advance(0.1)
    stuck = bench.read()
    assert stuck.displacement_um == before.displacement_um
    assert stuck.sample_counter > before.sample_counter
    bench.wrong.samples_frozen = True
    bench.advance(0.1)
    assert bench.read().sample_counter == stuck.sample_counter
    bench.wrong.samples_frozen = bench.wrong.laser_stuck = False
    bench.wrong.no_light = bench.wrong.gauge_lost = bench.wrong.barometer_lost = True
    bench.advance(0.1)
    lost = bench.read()
    assert lost.displacement_quality != 0
    assert math.isnan(lost.displacement_um)
    assert math.isnan(lost.gauge_pressure_pa)
    assert math.isnan(lost.ambient_pressure_pa)


def test_actuators_that_do_not_follow(bench: VirtualBench) -> None:
    bench.wrong.pump_stuck_fraction = 1.0
    bench.write(BenchCommand(0.0, 0.0))
    start_um = bench.plant.truth().displacement_um
    for _ in range(100):
        bench.advance(0.05)
        bench.write(BenchCommand(0.0, 0.0))
    assert bench.plant.truth().displacement_um > start_um + 10.0
    assert bench.read().pump_fraction == 0.0  # the board knows nothing of it


def test_only_the_bits_of_the_mask_are_cleared(bench: VirtualBench) -> None:
    bench.write(BenchCommand(0.5, 0.0))
    bench.wrong.gauge_offset_pa = 300.0
    bench.advance(1.0)
    assert bench.read().latched_faults == WATCHDOG | OVER_PRESSURE
    bench.wrong.gauge_offset_pa = 0.0
    bench.clear_faults(WATCHDOG)
    bench.advance(0.02)
    assert bench.read().latched_faults == OVER_PRESSURE
    assert (bench.board.pump_fraction, bench.board.vent_fraction) == (0.0, 1.0)


def test_the_heartbeat_goes_round_and_keeps_the_watchdog_fed(bench: VirtualBench) -> None:
    bench._driver._heartbeat = 0xFFFD  # after 22 minutes at 50 Hz
    for _ in range(6):
        bench.write(BenchCommand(0.5, 0.0))
        bench.advance(0.4)
        assert not bench.read().watchdog_tripped
    assert bench.board.pump_fraction == pytest.approx(0.5, abs=1e-4)


def test_a_host_that_ignores_a_lost_gauge_is_stopped_by_the_board() -> None:
    bench = VirtualBench(Plant(CONFIG.twin, CONFIG.pump))
    bench.open()
    bench.wrong.gauge_lost = True
    for _ in range(800):
        bench.write(BenchCommand(0.4, 0.0))
        bench.advance(0.02)
    reading = bench.read()
    assert (reading.pump_fraction, reading.latched_faults) == (0.0, GAUGE_LOST)
    stopped_um = bench.truth.displacement_um
    bench.clear_faults(GAUGE_LOST)
    for _ in range(800):
        bench.write(BenchCommand(0.4, 0.0))
        bench.advance(0.02)
    assert bench.read().latched_faults == GAUGE_LOST
    assert bench.truth.displacement_um < stopped_um


@pytest.mark.parametrize(("fitted", "pump"), [(0b10, 0.0), (0b01, 0.4), (0, 0.4)])
def test_an_open_circuit_is_read_and_stops_the_pump_where_it_is_fitted(
    fitted: int, pump: float
) -> None:
    bench = VirtualBench(
        Plant(CONFIG.twin, CONFIG.pump), stored=StoredSettings(interlocks_fitted=fitted)
    )
    assert bench.open().interlocks_fitted == fitted
    bench.write(BenchCommand(0.4, 0.0))
    assert bench.read().interlock_inputs == 0xFFFF
    bench.wrong.open_interlocks = 0b10
    bench.advance(0.02)
    reading = bench.read()
    assert (reading.pump_fraction, reading.interlock_inputs) == (pytest.approx(pump), 0xFFFD)
