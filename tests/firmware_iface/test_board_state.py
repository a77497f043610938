"""The board's own logic in virtual time: watchdog, latches, pressure limit, refused requests."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from firmware_iface.emulators.modbus_pdu import RegisterRefusal
from firmware_iface.emulators.pump_board import (
    GAUGE_PRESSURE_LIMIT_PA,
    BoardSample,
    BoardState,
    StoredSettings,
)
from firmware_iface.register_map import list_known_maps

SAMPLE = BoardSample(1.5, 0, 600.0, 101_325.0, 20.0, 21.0, 7, 3.25)
PERIOD_S = 0.5
DELIVERED = StoredSettings()
KEY = 0x1234_5678


class Bench:
    """A board with a manual clock, claimed where it supports claims."""

    def __init__(
        self,
        version: int,
        key: int = KEY,
        stored: StoredSettings = DELIVERED,
        sample: BoardSample = SAMPLE,
    ) -> None:
        self.map = list_known_maps()[version]
        self.state = BoardState(self.map, sample, stored)
        self.now_s = 0.0
        self.claim = {"claim_id": 7, "claim_key": key, "command_key": key, "clear_key": key}

    def at(self, now_s: float, sample: BoardSample = SAMPLE) -> None:
        self.now_s = now_s
        self.state.advance(now_s, sample)

    def arm(self) -> None:
        self.put("settings", watchdog_period_s=PERIOD_S, watchdog_arm=1)

    def put(self, block: str, **values: float) -> None:
        found = self.map.block(block)
        self.state.write(found.address, found.encode(self.claim | values))

    def command(self, pump: float, heartbeat: int, vent: float = 0.0) -> None:
        self.put(
            "command", pump_command_fraction=pump, vent_command_fraction=vent, heartbeat=heartbeat
        )

    def get(self, block: str) -> dict[str, float]:
        found = self.map.block(block)
        return found.decode(self.state.read(found.address, found.count))

    def everything(self) -> dict[str, float]:
        return self.get("settings") | self.get("command") | self.get("sensors")

    def clear(self, mask: int = 0xFFFF) -> None:
        self.put("reset", clear_faults=mask)


@pytest.fixture(params=[1, 2, 3])
def bench(request: pytest.FixtureRequest) -> Bench:
    """What boards of every map do."""
    return Bench(request.param)


@pytest.fixture
def old() -> Bench:
    """A board that obeys every program."""
    return Bench(1)


def pumping(version: int = 3, stored: StoredSettings = DELIVERED) -> Bench:
    """A board that is claimed and armed, with its pump running."""
    made = Bench(version, stored=stored)
    made.arm()
    made.command(0.3, 1, vent=0.25)
    return made


@pytest.fixture(params=[2, 3])
def claimed(request: pytest.FixtureRequest) -> Bench:
    """A board with claims, its pump running."""
    return pumping(request.param)


def test_power_up_is_off_and_unarmed(bench: Bench) -> None:
    sensors = bench.get("sensors")
    assert (bench.state.pump_fraction, bench.state.vent_fraction) == (0.0, 0.0)
    assert (
        sensors["watchdog_armed"] == sensors["watchdog_tripped"] == sensors["latched_faults"] == 0
    )
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
        bench.at(tick * 0.4, replace(SAMPLE, gauge_pressure_pa=600.0 + 0.001 * tick))
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


def test_neither_reads_nor_partial_writes_nor_arming_feed(old: Bench) -> None:
    old.arm()
    old.command(0.3, 1)
    old.at(0.4)
    old.get("sensors")
    old.state.write(old.map.register("heartbeat").address, [9])
    old.state.write(old.map.register("pump_command_fraction").address, [10_000])
    old.arm()
    assert old.state.pump_fraction == 0.2  # a part of the block commands ...
    old.at(0.6)
    assert old.state.pump_fraction == 0.0  # ... but does not feed


def test_a_heartbeat_seen_in_a_partial_write_still_feeds_later(old: Bench) -> None:
    old.arm()
    old.state.write(old.map.register("heartbeat").address, [9])
    old.at(0.4)
    old.command(0.3, 9)
    old.at(0.8)
    assert old.state.pump_fraction == 0.3


def test_unarmed_it_never_trips(old: Bench) -> None:
    old.command(0.3, 1)
    old.at(1e6)
    assert old.state.pump_fraction == 0.3


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
    bench.arm()
    bench.command(0.5, 1)
    bench.at(0.1, replace(SAMPLE, gauge_pressure_pa=GAUGE_PRESSURE_LIMIT_PA))
    assert bench.state.pump_fraction == 0.5
    bench.at(0.2, replace(SAMPLE, gauge_pressure_pa=GAUGE_PRESSURE_LIMIT_PA + 0.1))
    bench.at(0.3)
    assert (bench.state.pump_fraction, bench.state.vent_fraction) == (0.0, 1.0)
    assert bench.get("sensors")["latched_faults"] == bench.map.make_fault_mask("over_pressure")
    bench.clear(bench.map.make_fault_mask("watchdog"))  # the other fault's bit clears nothing
    assert bench.state.vent_fraction == 1.0
    bench.clear()
    assert (bench.state.pump_fraction, bench.state.vent_fraction) == (0.0, 0.0)


def test_clearing_while_the_cause_lasts_latches_again(bench: Bench) -> None:
    high = replace(SAMPLE, gauge_pressure_pa=GAUGE_PRESSURE_LIMIT_PA + 1)
    bench.arm()
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
        (56, [0, 50_001, 1], 3),  # a wrong vent value keeps the pump's out as well
        (48, [49], 3),  # period too short
        (48, [10_001], 3),
        (49, [2], 3),
        (16, [0, 0], 2),  # read-only
        (59, [0], 2),  # unknown
        (58, [1, 1], 2),  # exceeds the block
        (55, [0, 0], 2),
        (0, [1], 2),
    ],
)
def test_a_refused_write_changes_nothing(
    old: Bench, address: int, words: list[int], code: int
) -> None:
    old.command(0.5, 1, vent=0.5)
    before = old.everything()
    with pytest.raises(RegisterRefusal) as refused:
        old.state.write(address, words)
    assert refused.value.code == code
    assert old.everything() == before


@pytest.mark.parametrize(
    ("address", "count"), [(11, 1), (10, 2), (15, 2), (30, 20), (67, 1), (65_535, 1), (65_535, 2)]
)
def test_unknown_addresses_cannot_be_read(bench: Bench, address: int, count: int) -> None:
    with pytest.raises(RegisterRefusal) as refused:
        bench.state.read(address, count)
    assert refused.value.code == 2


def test_a_restart_forgets_everything(bench: Bench) -> None:
    bench.arm()
    bench.command(0.5, 1, vent=0.5)
    bench.at(5.0)
    bench.state.restart()
    assert set(bench.get("command").values()) == {0.0}
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
    assert (
        0 <= device_time_s - sensors["device_time_s"] - sensors["device_time_fraction_s"] < 1.01e-4
    )
    assert sensors["sample_counter"] == 5  # wraps


def refused(code: int) -> Any:
    return pytest.raises(RegisterRefusal, match=f"exception {code}")


STRANGERS = [
    KEY ^ 1,
    KEY ^ (1 << 31),
    1,
]  # one that differs in its low word, in its high word, in both


@pytest.mark.parametrize("key", STRANGERS)
def test_a_stranger_can_do_nothing_to_a_fed_board(claimed: Bench, key: int) -> None:
    stranger = {"claim_id": 9, "claim_key": key, "command_key": key, "clear_key": key}
    before = claimed.everything()
    for block, values in (
        ("settings", {"watchdog_period_s": 10.0, "watchdog_arm": 1}),  # a second claim
        ("settings", {"watchdog_period_s": PERIOD_S, "watchdog_arm": 0}),
        ("command", {"pump_command_fraction": 1.0, "vent_command_fraction": 0.0, "heartbeat": 2}),
        ("reset", {"clear_faults": 0xFFFF}),
    ):
        with refused(6):
            claimed.put(block, **values, **stranger)
    assert claimed.everything() == before
    claimed.at(PERIOD_S + 1e-6)
    assert claimed.state.pump_fraction == 0.0  # none of it fed


def test_parts_of_a_block_are_refused_and_do_not_feed(claimed: Bench) -> None:
    command = claimed.map.block("command")
    before = claimed.everything()
    for address, words in (
        (56, [50_000]),
        (56, [50_000, 0, 2]),
        (58, [2]),
        (49, [0]),
        (48, [10_000, 1]),
        (64, [1]),
    ):
        with refused(2):
            claimed.state.write(address, words)
    assert claimed.everything() == before
    claimed.at(0.4)
    with refused(2):
        claimed.state.write(
            command.address + 1, [0, 2, *divmod(KEY, 2**16)]
        )  # all but the pump, with the right key
    claimed.at(PERIOD_S + 1e-6)
    assert claimed.state.pump_fraction == 0.0


@pytest.mark.parametrize("block", ["command", "reset"])
def test_without_a_claim_no_client_commands_or_clears(block: str) -> None:
    bench = Bench(2)
    with refused(3):
        bench.put(
            block,
            pump_command_fraction=0.5,
            vent_command_fraction=0,
            heartbeat=1,
            clear_faults=0xFFFF,
        )
    with refused(3):  # neither is there anything to disarm
        bench.put("settings", watchdog_period_s=PERIOD_S, watchdog_arm=0)
    assert bench.state.pump_fraction == 0.0


@pytest.mark.parametrize("name", ["claim_id", "claim_key", "command_key", "clear_key"])
def test_no_claim_is_zero(claimed: Bench, name: str) -> None:
    values = {
        "watchdog_period_s": 1,
        "watchdog_arm": 1,
        "pump_command_fraction": 0.5,
        "vent_command_fraction": 0,
    }
    block = {"command_key": "command", "clear_key": "reset"}.get(name, "settings")
    with refused(3):
        claimed.put(block, **values, heartbeat=2, clear_faults=1, **{name: 0})


def test_the_key_is_never_read_back(claimed: Bench) -> None:
    for name, key in (
        ("settings", "claim_key"),
        ("command", "command_key"),
        ("reset", "clear_key"),
    ):
        assert claimed.get(name)[key] == 0
    assert claimed.get("sensors")["claim_in_force"] == claimed.get("settings")["claim_id"] == 7
    assert claimed.get("sensors")["period_in_force_s"] == PERIOD_S


def test_claiming_again_with_the_same_key_does_no_harm_and_does_not_feed(claimed: Bench) -> None:
    before = claimed.everything()
    claimed.at(0.4)
    claimed.arm()  # the answer to the first one was lost
    assert claimed.everything() == before
    claimed.at(PERIOD_S + 1e-6)
    assert claimed.state.pump_fraction == 0.0


def test_a_claim_lapses_with_its_watchdog_and_the_next_one_has_a_whole_period(
    claimed: Bench,
) -> None:
    claimed.at(PERIOD_S)
    with refused(6):
        claimed.put("settings", watchdog_period_s=10.0, watchdog_arm=1, claim_id=9, claim_key=9)
    claimed.at(PERIOD_S + 1e-3)
    claimed.put("settings", watchdog_period_s=0.25, watchdog_arm=1, claim_id=9, claim_key=9)
    sensors = claimed.get("sensors")
    assert (sensors["claim_in_force"], sensors["period_in_force_s"]) == (9, 0.25)
    assert sensors["latched_faults"] == claimed.map.make_fault_mask(
        "watchdog"
    )  # the claim clears nothing
    with refused(6):  # the former holder has lost it, although the fault stays latched
        claimed.command(0.3, 2)
    claimed.at(PERIOD_S + 1e-3 + 0.25)
    assert claimed.state.held
    claimed.at(PERIOD_S + 2e-3 + 0.25)
    assert not claimed.state.held


def test_a_client_stopped_by_the_watchdog_may_continue_unless_another_claimed(
    claimed: Bench,
) -> None:
    claimed.at(1.0)
    assert not claimed.state.held
    claimed.command(0.3, 2, vent=1.0)  # to vent, for instance
    assert (claimed.state.pump_fraction, claimed.state.vent_fraction) == (0.0, 1.0)
    with refused(6):
        claimed.put("settings", watchdog_period_s=PERIOD_S, watchdog_arm=1, claim_id=9, claim_key=9)
    claimed.clear()
    claimed.command(0.3, 3)
    assert claimed.state.pump_fraction == 0.3


def test_disarming_gives_the_claim_back(claimed: Bench) -> None:
    claimed.command(0.0, 2)
    claimed.put("settings", watchdog_period_s=PERIOD_S, watchdog_arm=0)
    assert claimed.get("sensors")["claim_in_force"] == 0
    with refused(3):
        claimed.command(0.3, 3)
    claimed.put("settings", watchdog_period_s=PERIOD_S, watchdog_arm=1, claim_id=9, claim_key=9)
    assert claimed.get("sensors")["claim_in_force"] == 9


def test_anybody_may_stop_and_only_the_holder_clears_it(claimed: Bench) -> None:
    stop = claimed.map.register("stop")
    with refused(3):
        claimed.state.write(stop.address, [0])
    claimed.state.write(stop.address, [1])
    assert (claimed.state.pump_fraction, claimed.state.vent_fraction) == (0.0, 0.25)
    assert claimed.get("sensors")["latched_faults"] == claimed.map.make_fault_mask("stopped")
    assert claimed.get("stop")["stop"] == 0
    claimed.command(0.5, 2)
    assert claimed.state.pump_fraction == 0.0
    with refused(6):
        claimed.put("reset", clear_faults=0xFFFF, clear_key=9)
    claimed.clear()
    assert claimed.state.pump_fraction == 0.0  # clearing starts nothing
    claimed.command(0.5, 3)
    assert claimed.state.pump_fraction == 0.5


def test_an_unclaimed_board_can_be_stopped_and_stays_stopped() -> None:
    bench = Bench(2)
    bench.state.write(bench.map.register("stop").address, [1])
    bench.arm()
    bench.command(0.5, 1)
    assert bench.state.pump_fraction == 0.0


def test_an_old_board_has_neither_claim_nor_stop(old: Bench) -> None:
    assert {block.name for block in old.map.blocks} == {
        "identity",
        "sensors",
        "settings",
        "command",
        "reset",
    }
    assert [block.count for block in old.map.blocks] == [7, 22, 2, 3, 1]
    with refused(2):
        old.state.write(72, [1])
