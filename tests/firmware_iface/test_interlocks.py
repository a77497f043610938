"""Circuits read in the background: an answer counts only while it is young, whatever the source
does.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from firmware_iface import roles
from firmware_iface.interlocks import CircuitMemory, CircuitPoller, InterlockBench, PolledSource
from tests.support.virtual_time import run_virtual

AGE_MAX_S, PERIOD_S = 0.5, 0.1


class FakeSource:
    """Circuits that a test opens; `error`, `hangs` and `took_s` spoil the answers."""

    def __init__(self, *closed: bool) -> None:
        self.closed = list(closed)
        self.error: Exception | None = None
        self.hangs = False
        self.took_s = 0.0
        self.opened = self.closings = 0

    async def open(self) -> roles.DeviceIdentity:
        await self._answer()
        self.opened += 1
        return roles.DeviceIdentity("fake", "", "")

    async def closed_circuits(self) -> tuple[bool, ...]:
        await self._answer()
        found = tuple(self.closed)
        await asyncio.sleep(self.took_s)
        return found

    async def close(self) -> None:
        self.closings += 1

    def describe(self) -> dict[str, str]:
        return {"port": "fake"}

    async def _answer(self) -> None:
        if self.hangs:
            await asyncio.sleep(1e6)
        if self.error is not None:
            raise self.error


class FakeBench:
    """A bench that answers at once."""

    def __init__(self, interlock_inputs: int = 0) -> None:
        self.interlock_inputs = interlock_inputs
        self.calls: list[str] = []
        self.error: roles.LinkError | None = None

    async def open(self) -> roles.BenchIdentity:
        self.calls.append("open")
        if self.error is not None:
            raise self.error
        return roles.BenchIdentity("fake", 3, "", 0.5)

    async def read(self) -> roles.BenchReading:
        return roles.BenchReading(
            0.0,
            0,
            600.0,
            1e5,
            20.0,
            20.0,
            0.0,
            math.nan,
            1,
            1.0,
            False,
            0,
            interlock_inputs=self.interlock_inputs,
        )

    async def write(self, command: roles.BenchCommand) -> None:
        self.calls.append("write")

    async def clear_faults(self, mask: int) -> None:
        self.calls.append(f"clear {mask}")

    def dead_guards(self) -> tuple[str, ...]:
        return ("inner",)

    def link_state(self) -> roles.LinkState:
        return roles.NO_LINK_STATE

    async def close(self) -> None:
        self.calls.append("close")


def polled(source: FakeSource, *bits: int) -> PolledSource:
    return PolledSource(source, bits, PERIOD_S, AGE_MAX_S, first_s=0.3)


def in_virtual_time(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    run_virtual(test())


async def open_mask(bench: InterlockBench) -> int:
    return (await bench.read()).interlocks_open


def made(
    source: FakeSource, *bits: int, inner: FakeBench | None = None, **inputs: int
) -> InterlockBench:
    board_inputs = {int(bit.removeprefix("bit")): place for bit, place in inputs.items()}
    clock = asyncio.get_running_loop().time
    return InterlockBench(inner or FakeBench(), board_inputs, [polled(source, *bits)], clock)


def test_circuits_are_open_before_the_first_answer_and_after_the_last_one_is_old() -> None:
    memory = CircuitMemory(2, AGE_MAX_S)
    assert memory.open_circuits(0.0) == [True, True]
    memory.take([True, False], 10.0)
    assert memory.open_circuits(10.0 + AGE_MAX_S) == [False, True]
    assert memory.open_circuits(10.0 + AGE_MAX_S + 1e-6) == [True, True]
    assert memory.open_circuits(9.9) == [True, True]  # an answer from the future is none


@pytest.mark.parametrize("answer", [[True], [True, True, True]])
def test_an_answer_on_other_circuits_is_none(answer: list[bool]) -> None:
    memory = CircuitMemory(2, AGE_MAX_S)
    with pytest.raises(roles.LinkError, match="expected 2"):
        memory.take(answer, 0.0)
    assert memory.open_circuits(0.0) == [True, True]


def test_only_true_is_a_closed_circuit() -> None:
    memory = CircuitMemory(3, AGE_MAX_S)
    memory.take([1, math.nan, None], 0.0)  # type: ignore[list-item]
    assert memory.open_circuits(0.0) == [True, True, True]


def test_each_circuit_has_its_bit() -> None:
    async def test() -> None:
        source = FakeSource(True, False, True)
        bench = made(source, 4, 0, 2)
        await bench.open()
        assert await open_mask(bench) == 0b00001
        source.closed = [False, True, False]
        await asyncio.sleep(2 * PERIOD_S)
        assert await open_mask(bench) == 0b10100
        await bench.close()

    in_virtual_time(test)


def test_the_boards_inputs_and_polled_circuits_are_in_one_mask() -> None:
    async def test() -> None:
        inner = FakeBench(interlock_inputs=0b1000)  # only input 3 is closed
        bench = made(FakeSource(False), 1, inner=inner, bit0=3, bit2=5)
        await bench.open()
        assert await open_mask(bench) == 0b110
        inner.interlock_inputs = 0b101000
        assert await open_mask(bench) == 0b010
        await bench.close()

    in_virtual_time(test)


@pytest.mark.parametrize(
    "error",
    [roles.LinkError("no answer"), roles.LinkDownError("gone"), TypeError("a driver's mistake")],
)
def test_a_lost_signal_is_open_once_its_last_answer_is_old_and_closed_when_it_is_back(
    error: Exception,
) -> None:
    async def test() -> None:
        source = FakeSource(True)
        bench = made(source, 0)
        await bench.open()
        source.error = error
        await asyncio.sleep(AGE_MAX_S - PERIOD_S)
        assert await open_mask(bench) == 0
        await asyncio.sleep(2 * PERIOD_S)
        assert await open_mask(bench) == 1
        source.error = None
        await asyncio.sleep(2 * PERIOD_S)
        assert await open_mask(bench) == 0
        assert source.opened == (2 if isinstance(error, roles.LinkDownError) else 1)
        await bench.close()

    in_virtual_time(test)


def test_a_source_that_hangs_is_open_and_no_reading_waits_for_it() -> None:
    async def test() -> None:
        source = FakeSource(True)
        bench = made(source, 0)
        await bench.open()
        source.hangs = True
        await asyncio.sleep(AGE_MAX_S + 2 * PERIOD_S)
        begin_s = asyncio.get_running_loop().time()
        assert await open_mask(bench) == 1
        assert asyncio.get_running_loop().time() == begin_s
        await bench.close()

    in_virtual_time(test)


def test_an_answer_that_takes_longer_than_its_age_never_counts() -> None:
    """The age begins with the request: what the answer shows may be as old as that."""

    async def test() -> None:
        source = FakeSource(True)
        source.took_s = AGE_MAX_S + 0.05
        bench = made(source, 0)
        await bench.open()
        for _ in range(40):
            await asyncio.sleep(0.05)
            assert await open_mask(bench) == 1
        await bench.close()

    in_virtual_time(test)


def test_a_source_that_is_absent_does_not_keep_the_bench_from_opening() -> None:
    async def test() -> None:
        source = FakeSource(True)
        source.error = roles.LinkDownError("not plugged in")
        inner = FakeBench()
        bench = made(source, 0, inner=inner)
        await bench.open()
        assert inner.calls == ["open"]
        assert await open_mask(bench) == 1
        source.error = None
        await asyncio.sleep(2 * PERIOD_S)
        assert await open_mask(bench) == 0
        await bench.close()
        assert source.closings == 1
        assert inner.calls[-1] == "close"

    in_virtual_time(test)


def test_a_source_that_hangs_delays_the_opening_by_its_limit_only_and_before_the_watchdog_runs() -> (  # noqa: E501
    None
):
    async def test() -> None:
        source = FakeSource(True)
        source.hangs = True
        inner = FakeBench()
        bench = made(source, 0, inner=inner)
        opening = asyncio.create_task(bench.open())
        await asyncio.sleep(0.25)
        assert inner.calls == []
        await asyncio.sleep(0.1)
        assert opening.done()
        assert inner.calls == ["open"]
        await bench.close()

    in_virtual_time(test)


def test_a_reopened_bench_continues_to_read_its_sources() -> None:
    async def test() -> None:
        source = FakeSource(True)
        inner = FakeBench()
        bench = made(source, 0, inner=inner)
        inner.error = roles.LinkDownError("no board")
        with pytest.raises(roles.LinkDownError):
            await bench.open()
        inner.error = None
        await bench.open()
        assert source.opened == 1
        assert await open_mask(bench) == 0
        await bench.close()

    in_virtual_time(test)


def test_a_reader_that_has_ended_is_a_dead_guard() -> None:
    async def test() -> None:
        bench = made(FakeSource(True), 0)
        await bench.open()
        assert bench.dead_guards() == ("inner",)
        (poller,) = bench._pollers
        assert poller._task is not None
        poller._task.cancel()
        await asyncio.sleep(0)
        assert bench.dead_guards() == ("inner", "interlock reader of fake")
        await asyncio.sleep(AGE_MAX_S + 0.01)
        assert await open_mask(bench) == 1
        await bench.close()

    in_virtual_time(test)


def test_the_rest_of_the_bench_is_the_inner_one() -> None:
    async def test() -> None:
        inner = FakeBench()
        bench = made(FakeSource(True), 0, inner=inner)
        await bench.write(roles.BenchCommand(0.1, 0.0))
        await bench.clear_faults(5)
        assert inner.calls == ["write", "clear 5"]

    in_virtual_time(test)


def test_the_failure_is_named_rather_than_the_pause_after_it() -> None:
    async def test() -> None:
        source = FakeSource(True)
        source.error = roles.LinkDownError("no connection; is the device on?")
        poller = CircuitPoller(polled(source, 0), asyncio.get_running_loop().time)
        await poller.start()
        source.error = roles.LinkWaitsError("next attempt in 0.4 s")
        await asyncio.sleep(2 * PERIOD_S)
        assert poller.problem == "no connection; is the device on?"
        source.error = None
        await asyncio.sleep(2 * PERIOD_S)
        assert poller.problem == ""
        await poller.stop()

    in_virtual_time(test)
