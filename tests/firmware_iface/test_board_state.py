"""The board's own logic in virtual time: watchdog, latches, pressure limit, refused requests."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from firmware_iface.emulators.board_state import GAUGE_PRESSURE_LIMIT_PA, BoardSample, BoardState
from firmware_iface.emulators.modbus_server import RegisterRefusal
from firmware_iface.register_map import default_map

MAP = default_map()
SAMPLE = BoardSample(1.5, 0, 600.0, 101_325.0, 20.0, 21.0, 7, 3.25)
PERIOD_S = 0.5


class Bench:
    """A board with a hand on its clock."""

    def __init__(self) -> None:
        self.state = BoardState(MAP, SAMPLE)
        self.now_s = 0.0

    def at(self, now_s: float, sample: BoardSample = SAMPLE) -> None:
        self.now_s = now_s
        self.state.advance(now_s, sample)

    def arm(self) -> None:
        self.put("settings", watchdog_period_s=PERIOD_S, watchdog_arm=1)

    def put(self, block: str, **values: float) -> None:
        found = MAP.block(block)
        self.state.write(found.address, found.encode(values))

    def command(self, pump: float, heartbeat: int, vent: float = 0.0) -> None:
        self.put("command", pump_command_fraction=pump, vent_command_fraction=vent, heartbeat=heartbeat)

    def get(self, block: str) -> dict[str, float]:
        found = MAP.block(block)
        return found.decode(self.state.read(found.address, found.count))

    def clear(self, mask: int = 0xFFFF) -> None:
        self.put("reset", clear_faults=mask)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_power_up_is_off_and_unarmed(bench: Bench) -> None:
    sensors = bench.get("sensors")
    assert (bench.state.pump_fraction, bench.state.vent_fraction) == (0.0, 0.0)
    assert sensors["watchdog_armed"] == sensors["watchdog_tripped"] == sensors["latched_faults"] == 0
    assert sensors["displacement_um"] == 1.5
    assert sensors["device_time_s"] + sensors["device_time_fraction_s"] == 3.25


def test_watchdog_period_is_strict(bench: Bench) -> None:
    bench.arm()
    bench.command(0.4, 1)
    bench.at(PERIOD_S)
    assert bench.state.pump_fraction == 0.4
    bench.at(PERIOD_S + 1e-6)
    assert bench.state.pump_fraction == 0.0
    assert bench.get("sensors")["watchdog_tripped"] == 1


def test_new_heartbeats_keep_it_fed(bench: Bench) -> None:
    bench.arm()
    for tick in range(1, 200):
        bench.at(tick * 0.4)
        bench.command(0.3, tick % 2)
    assert bench.state.pump_fraction == 0.3


def test_the_same_heartbeat_does_not_feed(bench: Bench) -> None:
    bench.arm()
    bench.command(0.3, 5)
    for now_s in (0.2, 0.4):
        bench.at(now_s)
        bench.command(0.3, 5)
    bench.at(0.6)
    assert bench.state.pump_fraction == 0.0


def test_neither_reads_nor_partial_writes_nor_arming_feed(bench: Bench) -> None:
    bench.arm()
    bench.command(0.3, 1)
    bench.at(0.4)
    bench.get("sensors")
    bench.state.write(MAP.register("heartbeat").address, [9])
    bench.state.write(MAP.register("pump_command_fraction").address, [10_000])
    bench.arm()
    assert bench.state.pump_fraction == 0.2  # a part of the block commands ...
    bench.at(0.6)
    assert bench.state.pump_fraction == 0.0  # ... but does not feed


def test_a_heartbeat_seen_in_a_partial_write_still_feeds_later(bench: Bench) -> None:
    bench.arm()
    bench.state.write(MAP.register("heartbeat").address, [9])
    bench.at(0.4)
    bench.command(0.3, 9)
    bench.at(0.8)
    assert bench.state.pump_fraction == 0.3


def test_unarmed_it_never_trips(bench: Bench) -> None:
    bench.command(0.3, 1)
    bench.at(1e6)
    assert bench.state.pump_fraction == 0.3


def test_a_trip_leaves_the_vent_as_it_was(bench: Bench) -> None:
    bench.arm()
    bench.command(0.3, 1, vent=0.25)
    bench.at(1.0)
    assert (bench.state.pump_fraction, bench.state.vent_fraction) == (0.0, 0.25)


def test_after_a_trip_the_pump_stays_off_until_cleared_and_commanded_again(bench: Bench) -> None:
    bench.arm()
    bench.command(0.3, 1)
    bench.at(1.0)
    bench.command(0.3, 2)
    assert bench.state.pump_fraction == 0.0
    bench.clear()
    assert bench.state.pump_fraction == 0.0
    assert bench.get("sensors")["latched_faults"] == 0
    bench.command(0.3, 3)
    assert bench.state.pump_fraction == 0.3


def test_clearing_starts_a_new_period(bench: Bench) -> None:
    bench.arm()
    bench.at(1.0)
    bench.clear()
    bench.at(1.0 + PERIOD_S)
    assert bench.get("sensors")["watchdog_tripped"] == 0
    bench.at(1.001 + PERIOD_S)
    assert bench.get("sensors")["watchdog_tripped"] == 1


def test_over_pressure_stops_the_pump_and_opens_the_vent(bench: Bench) -> None:
    bench.command(0.5, 1)
    bench.at(0.1, replace(SAMPLE, gauge_pressure_pa=GAUGE_PRESSURE_LIMIT_PA))
    assert bench.state.pump_fraction == 0.5
    bench.at(0.2, replace(SAMPLE, gauge_pressure_pa=GAUGE_PRESSURE_LIMIT_PA + 0.1))
    bench.at(0.3)
    assert (bench.state.pump_fraction, bench.state.vent_fraction) == (0.0, 1.0)
    assert bench.get("sensors")["latched_faults"] == MAP.fault_mask("over_pressure")
    bench.clear(MAP.fault_mask("watchdog"))  # the other fault's bit clears nothing
    assert bench.state.vent_fraction == 1.0
    bench.clear()
    assert (bench.state.pump_fraction, bench.state.vent_fraction) == (0.0, 0.0)


def test_clearing_while_the_cause_lasts_latches_again(bench: Bench) -> None:
    high = replace(SAMPLE, gauge_pressure_pa=GAUGE_PRESSURE_LIMIT_PA + 1)
    bench.at(0.1, high)
    bench.clear()
    bench.at(0.2, high)
    assert bench.state.vent_fraction == 1.0


def test_disarming_is_refused_while_the_pump_is_commanded(bench: Bench) -> None:
    bench.arm()
    bench.command(0.3, 1)
    with pytest.raises(RegisterRefusal, match="exception 3"):
        bench.put("settings", watchdog_period_s=PERIOD_S, watchdog_arm=0)
    bench.command(0.0, 2)
    bench.put("settings", watchdog_period_s=PERIOD_S, watchdog_arm=0)
    bench.at(10.0)
    assert bench.get("sensors")["watchdog_tripped"] == 0


@pytest.mark.parametrize(
    ("address", "words", "code"),
    [
        (56, [50_001, 0, 1], 3),  # pump above 1
        (56, [0, 50_001, 1], 3),  # the vent's fault keeps the pump's word out as well
        (48, [49], 3),  # period too short
        (48, [10_001], 3),
        (49, [2], 3),
        (16, [0, 0], 2),  # read-only
        (59, [0], 2),  # unknown
        (58, [1, 1], 2),  # runs out of the block
        (55, [0, 0], 2),
        (0, [1], 2),
    ],
)
def test_a_refused_write_changes_nothing(bench: Bench, address: int, words: list[int], code: int) -> None:
    bench.command(0.5, 1, vent=0.5)
    before = bench.get("settings") | bench.get("command") | bench.get("sensors")
    with pytest.raises(RegisterRefusal) as refused:
        bench.state.write(address, words)
    assert refused.value.code == code
    assert bench.get("settings") | bench.get("command") | bench.get("sensors") == before


@pytest.mark.parametrize(("address", "count"), [(7, 1), (6, 2), (15, 2), (30, 20), (65, 1), (65_535, 1), (65_535, 2)])
def test_unknown_addresses_cannot_be_read(bench: Bench, address: int, count: int) -> None:
    with pytest.raises(RegisterRefusal) as refused:
        bench.state.read(address, count)
    assert refused.value.code == 2


def test_a_restart_forgets_everything(bench: Bench) -> None:
    bench.arm()
    bench.command(0.5, 1, vent=0.5)
    bench.at(5.0)
    bench.state.restart()
    assert bench.get("command") == {"pump_command_fraction": 0.0, "vent_command_fraction": 0.0, "heartbeat": 0.0}
    assert bench.get("sensors")["latched_faults"] == bench.get("sensors")["watchdog_armed"] == 0


def test_missing_values_are_read_as_such(bench: Bench) -> None:
    bench.at(0.0, replace(SAMPLE, displacement_um=math.nan, gas_temperature_c=math.nan))
    sensors = bench.get("sensors")
    assert math.isnan(sensors["displacement_um"])
    assert math.isnan(sensors["gas_temperature_c"])
    assert sensors["gauge_pressure_pa"] == 600.0


@pytest.mark.parametrize("device_time_s", [0.0, 0.99999, 1.0, 4_000_000.9999999, 12345.6789])
def test_device_time_is_never_rounded_up(bench: Bench, device_time_s: float) -> None:
    bench.at(0.0, replace(SAMPLE, device_time_s=device_time_s, sample_counter=2**32 + 5))
    sensors = bench.get("sensors")
    assert 0 <= device_time_s - sensors["device_time_s"] - sensors["device_time_fraction_s"] < 1.01e-4
    assert sensors["sample_counter"] == 5  # wraps
