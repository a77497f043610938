"""The conformance test passes the emulated board and fails each broken one for the right reason."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pytest
from counting_plant import CountingPlant, ManualClock

from firmware_iface.conformance import CheckResult, Conformance, _Check, examine
from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.emulators.modbus_pdu import ILLEGAL_VALUE, RegisterRefusal, answer_request
from firmware_iface.emulators.pump_board import BoardSample, BoardState, StoredSettings
from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.links.modbus_tcp import GuardedModbusTcp
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.register_map import list_known_maps
from firmware_iface.roles import BenchCommand, DeviceBusyError, LinkError
from tests.worlds.faulty_board import PumpBoardEmulator
from tests.worlds.faulty_devices import RtuBusEmulator

PUMP, VENT, HEARTBEAT = 56, 57, 58
DELIVERED = StoredSettings()


class NoWatchdog(BoardState):
    """Never trips."""

    def advance(self, now_s: float, sample: BoardSample) -> None:
        super().advance(now_s, sample)
        self._fed_s = now_s


class HoldsLastValue(BoardState):
    """Trips and reports it, but continues with the last command."""

    @property
    def pump_fraction(self) -> float:
        return self.last

    last = 0.0

    def write(self, address: int, words: Sequence[int]) -> None:
        super().write(address, words)
        if address == PUMP:
            self.last = words[0] / 50_000


class AcceptsOutOfRange(BoardState):
    """Accepts any value, without applying it."""

    def write(self, address: int, words: Sequence[int]) -> None:
        try:
            super().write(address, words)
        except RegisterRefusal as refusal:
            if refusal.code != ILLEGAL_VALUE:
                raise


class AnyWriteFeeds(BoardState):
    """Feeds the watchdog with every write of the pump command, whatever the heartbeat."""

    def write(self, address: int, words: Sequence[int]) -> None:
        try:
            super().write(address, words)
        finally:
            if address == PUMP:
                self._fed_s = self._now_s


class DisarmsAnyTime(BoardState):
    """Can be disarmed with the pump running."""

    def write(self, address: int, words: Sequence[int]) -> None:
        if address == 48 and words[1] == 0:
            self._settable["pump_command_fraction"] = 0.0
        super().write(address, words)


class Frozen(BoardState):
    """Shows the first sample for ever."""

    def advance(self, now_s: float, sample: BoardSample) -> None:
        super().advance(now_s, self._sample)


class ForgetsPeriod(BoardState):
    """Accepts a watchdog period but keeps its own."""

    def write(self, address: int, words: Sequence[int]) -> None:
        super().write(address, words)
        self._settable["watchdog_period_s"] = 1.0


class StartsWhenCleared(BoardState):
    """Continues with the last command as soon as the fault is cleared."""

    last = 0.0

    def write(self, address: int, words: Sequence[int]) -> None:
        super().write(address, words)
        if address == PUMP:
            self.last = words[0] / 50_000
        elif address == 64:
            self._settable["pump_command_fraction"] = self.last


class Claimless(BoardState):
    """Obeys every program."""

    def _check_claim(self, block: str, written: dict[str, float]) -> None:
        pass


class ClaimedForEver(BoardState):
    """Its claim outlives the watchdog."""

    @property
    def held(self) -> bool:
        return bool(self._claim_key)


class HalfKey(BoardState):
    """Compares only the low word of a key."""

    def _check_claim(self, block: str, written: dict[str, float]) -> None:
        low = {
            name: float(int(value) & 0xFFFF)
            for name, value in written.items()
            if name.endswith("_key")
        }
        own, self._claim_key = self._claim_key, float(int(self._claim_key) & 0xFFFF)
        try:
            super()._check_claim(block, written | low)
        finally:
            self._claim_key = own


class ShowsKey(BoardState):
    """Lets everybody read the key."""

    def _collect_values(self) -> dict[str, float]:
        return super()._collect_values() | {"command_key": self._claim_key}


class ClaimFeeds(BoardState):
    """Feeds its watchdog with every claim."""

    def _update_claim(self, written: dict[str, float]) -> None:
        super()._update_claim(written)
        self._fed_s = self._now_s


class StopsForATick(BoardState):
    """Forgets that it was stopped."""

    def _latch_fault(self, mask: int) -> None:
        super()._latch_fault(mask & ~self._stopped_mask)


class NoGaugeGuard(BoardState):
    """Pumps without a gauge."""

    @property
    def _gauge_lost(self) -> bool:
        return False


class ShortMemory(BoardState):
    """Gives the pump a whole time-out again whenever the fault is cleared."""

    def write(self, address: int, words: Sequence[int]) -> None:
        if address == 64:
            self._gauge_seen_s = self._now_s
        super().write(address, words)


class VentsWithoutGauge(BoardState):
    """Opens the vent when it loses its gauge."""

    @property
    def vent_fraction(self) -> float:
        return 1.0 if self._faults & self._gauge_lost_mask else super().vent_fraction


class NoLatch(BoardState):
    """Stops the pump while the cause lasts, without a latched fault."""

    def _protect_pump(self) -> None:
        super()._protect_pump()
        self._faults = 0


class NoInterlock(BoardState):
    """Reports its interlock inputs, and does nothing."""

    def _latch_fault(self, mask: int) -> None:
        if mask != self._interlock_mask:
            super()._latch_fault(mask)


class StopsWithoutCause(BoardState):
    """Takes every gauge for lost, once the pump runs."""

    @property
    def _gauge_lost(self) -> bool:
        return True


class OddSettings(BoardState):
    """Has a time-out that no board may have."""

    def _collect_values(self) -> dict[str, float]:
        return super()._collect_values() | {"gauge_timeout_s": 0.05}


class OtherMap(BoardState):
    """Of a later map."""

    def read(self, address: int, count: int) -> list[int]:
        self.map_version = 7
        return super().read(address, count)


class ClockedPlant(CountingPlant):
    """Its samples are stamped with the test's clock."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__()
        self._clock = clock

    def sample(self) -> BoardSample:
        return replace(super().sample(), device_time_s=self._clock())


@dataclass
class Bench:
    """An emulated board of some kind, on a clock that the conformance test's own waiting moves."""

    board: PumpBoardEmulator
    clock: ManualClock
    plant: ClockedPlant

    async def examine(self, only: str = "") -> list[CheckResult]:
        """Findings of all checks, or of identity and this check."""

        async def sleep(duration_s: float) -> None:
            self.clock.now_s += duration_s
            await asyncio.sleep(0)

        link = GuardedModbusTcp("127.0.0.1", self.board.port, 1, 5.0)
        await link.connect()
        try:
            return await _SomeChecks(link, sleep, only=only).run()
        finally:
            await link.close()


class _SomeChecks(Conformance):
    """All checks, or one besides that of the identity."""

    def __init__(
        self, link: GuardedModbusTcp, sleep: Callable[[float], Awaitable[None]], only: str
    ) -> None:
        super().__init__(link, sleep)
        self._only = only

    async def _possible_checks(self) -> tuple[list[_Check], str]:
        checks, not_run = await super()._possible_checks()
        return [check for check in checks if self._only in ("", check[0])], not_run


Serve = Callable[..., Awaitable[Bench]]


@pytest.fixture
async def serve() -> AsyncIterator[Serve]:
    benches: list[Bench] = []

    async def make(
        kind: type[BoardState], version: int = 3, stored: StoredSettings = DELIVERED
    ) -> Bench:
        clock = ManualClock()
        plant = ClockedPlant(clock)
        registers = list_known_maps()[version]
        bench = Bench(PumpBoardEmulator(plant, clock=clock, registers=registers), clock, plant)
        bench.board.state = kind(registers, plant.sample(), stored)
        benches.append(bench)
        await bench.board.start()
        return bench

    yield make
    for bench in benches:
        await bench.board.stop()


def problems(findings: list[CheckResult]) -> dict[str, str]:
    return {finding.check: finding.problem for finding in findings if finding.problem}


@pytest.mark.parametrize(("version", "checks"), [(1, 14), (2, 21), (3, 22)])
async def test_the_emulator_conforms(serve: Serve, version: int, checks: int) -> None:
    bench = await serve(BoardState, version)
    findings = await bench.examine()
    assert problems(findings) == {}
    assert len(findings) == checks
    assert bench.board.state.pump_fraction == 0.0
    assert bench.board.state.read(49, 1) == [0]  # left as it was found: watchdog off


async def test_the_emulator_conforms_over_rtu_and_in_real_time(tmp_path: Path) -> None:
    plant = CountingPlant()
    board = PumpBoardEmulator(plant)
    await board.start()
    settings = SerialSettings(115_200, parity="E")
    wire = PtyWire(
        RtuBusEmulator(settings, {1: partial(answer_request, table=board.state)}), tmp_path / "tty"
    )
    wire.plug()
    try:
        findings = await examine(f"rtu://{tmp_path}/tty?baud=115200&parity=E", timeout_s=4.0)
    finally:
        wire.unplug()
        await board.stop()
    assert problems(findings) == {}


BROKEN = [
    (NoWatchdog, "a silent host stops the pump", "holds the pump at 0.05 after a host silent"),
    (HoldsLastValue, "a silent host stops the pump", "holds the pump at 0.05 after a host silent"),
    (
        AcceptsOutOfRange,
        "values outside the limits are refused",
        "accepts watchdog_period_s = 0.049",
    ),
    (AnyWriteFeeds, "the same heartbeat does not feed", "writes that repeat one heartbeat"),
    (AnyWriteFeeds, "half a command does not feed", "writes of the pump command alone"),
    (
        DisarmsAnyTime,
        "disarming is refused while the pump is commanded",
        "be disarmed while the pump is comm",
    ),
    (Frozen, "samples advance", "sample_counter stands still"),
    (ForgetsPeriod, "settings are read back as written", "written 0.3, read back 1"),
    (StartsWhenCleared, "clearing sets the pump to 0", "starts the pump at 0.05"),
    (OtherMap, "identity", "map version is 7, this test knows 1, 2, 3"),
]
CLAIMS_BROKEN = [
    (Claimless, "another claim is refused", "accepts a second claim"),
    (
        Claimless,
        "no other program commands, clears or disarms",
        "accepts a command with another key",
    ),
    (Claimless, "without a claim nothing is commanded", "a write to command without a claim"),
    (ClaimedForEver, "the claim lapses with the watchdog", "exception 6"),
    (HalfKey, "no other program commands, clears or disarms", "accepts a command with another key"),
    (ShowsKey, "the claim and the period are shown, the key is not", "command_key can be read"),
    (ClaimFeeds, "the same claim may be made again", "claims that are made again"),
    (StopsForATick, "any program may stop the pump", "runs the pump at 0.05 after stop"),
]
GUARDS_BROKEN = [
    (
        StopsWithoutCause,
        "a gauge with a value and closed interlocks let the pump run",
        "faults 0x8 without a cause",
    ),
    (OddSettings, "identity", "gauge_timeout_s is 0.05, expected 0.1..60"),
]
NOT_RUN = "all other requirements"
WITHOUT_GAUGE = "without a gauge the pump is off after the time-out"
CLEARED_WITHOUT_GAUGE = "clearing does not run the pump without a gauge"
OPEN, CLEARED_OPEN = (
    "an open interlock keeps the pump off",
    "clearing does not run the pump with an open interlock",
)


@pytest.mark.parametrize(
    ("version", "kind", "check", "words"),
    [(3, *row) for row in BROKEN + CLAIMS_BROKEN + GUARDS_BROKEN]
    + [(2, *row) for row in CLAIMS_BROKEN]
    + [(1, *row) for row in BROKEN if row[0] is AnyWriteFeeds],
)
async def test_a_broken_board_fails_for_the_right_reason(
    serve: Serve, version: int, kind: type[BoardState], check: str, words: str
) -> None:
    bench = await serve(kind, version)
    found = problems(await bench.examine(check))
    assert words in found[check]


async def test_without_a_gauge_the_guard_is_tested_and_the_rest_is_not(serve: Serve) -> None:
    bench = await serve(BoardState)
    bench.plant.gauge_pressure_pa = math.nan
    findings = await bench.examine()
    assert [finding.check for finding in findings if not finding.problem][-2:] == [
        WITHOUT_GAUGE,
        CLEARED_WITHOUT_GAUGE,
    ]
    assert problems(findings) == {
        NOT_RUN: "not run: the fitted gauge has no value; connect it and run it again"
    }
    assert bench.board.state.pump_fraction == 0.0


async def test_with_an_open_interlock_the_interlock_is_tested_and_the_rest_is_not(
    serve: Serve,
) -> None:
    bench = await serve(BoardState, stored=StoredSettings(interlocks_fitted=0b101))
    bench.plant.interlock_inputs = 0b011
    findings = await bench.examine()
    assert [finding.check for finding in findings if not finding.problem][-2:] == [
        OPEN,
        CLEARED_OPEN,
    ]
    assert problems(findings) == {
        NOT_RUN: "not run: interlock inputs 0x4 are open; close them and run it again"
    }


@pytest.mark.parametrize(
    "stored", [StoredSettings(gauge_fitted=False), StoredSettings(interlocks_fitted=0b11)]
)
async def test_a_board_without_a_gauge_or_with_closed_interlocks_conforms(
    serve: Serve, stored: StoredSettings
) -> None:
    bench = await serve(BoardState, stored=stored)
    if not stored.gauge_fitted:
        bench.plant.gauge_pressure_pa = math.nan
    findings = await bench.examine()
    assert problems(findings) == {}
    assert len(findings) == 22


@pytest.mark.parametrize(
    ("kind", "check", "words"),
    [
        (NoGaugeGuard, WITHOUT_GAUGE, "runs the pump at 0.05 after 15 s without a gauge"),
        (
            ShortMemory,
            CLEARED_WITHOUT_GAUGE,
            "runs the pump at 0.05 after a command without a gauge",
        ),
        (VentsWithoutGauge, WITHOUT_GAUGE, "moves the vent after 15 s without a gauge"),
        (NoLatch, WITHOUT_GAUGE, "does not latch the fault `gauge_lost`"),
    ],
)
async def test_a_board_with_a_bad_guard_of_its_gauge_fails(
    serve: Serve, kind: type[BoardState], check: str, words: str
) -> None:
    bench = await serve(kind)
    bench.plant.gauge_pressure_pa = math.nan
    assert words in problems(await bench.examine())[check]


@pytest.mark.parametrize(
    ("kind", "check", "words"),
    [
        (NoInterlock, OPEN, "runs the pump at 0.05 after a command with an open interlock"),
        (NoLatch, CLEARED_OPEN, "does not latch the fault `interlock`"),
    ],
)
async def test_a_board_with_a_bad_interlock_fails(
    serve: Serve, kind: type[BoardState], check: str, words: str
) -> None:
    bench = await serve(kind, stored=StoredSettings(interlocks_fitted=1))
    bench.plant.interlock_inputs = 0xFFFE
    assert words in problems(await bench.examine())[check]


async def test_a_board_that_somebody_holds_is_left_alone(serve: Serve) -> None:
    bench = await serve(BoardState)
    holder = PumpBoard(f"tcp://127.0.0.1:{bench.board.port}", timeout_s=5.0)
    await holder.open()
    await holder.write(BenchCommand(0.5, 0.0))
    before = bench.board.state.read(48, 6)
    with pytest.raises(DeviceBusyError):
        await bench.examine()
    assert bench.board.state.pump_fraction == 0.5
    assert bench.board.state.read(48, 6) == before
    await holder.write(BenchCommand(0.0, 0.0))
    await holder.close()


async def test_a_missing_board_is_an_error_and_no_finding() -> None:
    with pytest.raises(LinkError):
        await examine("tcp://127.0.0.1:9")
