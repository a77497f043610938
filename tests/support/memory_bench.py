"""Runs a test on a device and its driver in memory, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, Protocol, TypeVar

from tests.support.virtual_time import run_virtual


class DriverBench(Protocol):
    """A device with its driver, which can be opened and closed."""

    driver: Any


B = TypeVar("B", bound=DriverBench)


def run_on_bench(
    make_bench: Callable[[], B], test: Callable[[B], Coroutine[Any, Any, None]]
) -> None:
    """Open the driver of a bench, run the test, close the driver; no task may be left."""

    async def opened() -> None:
        bench = make_bench()
        await bench.driver.open()
        await test(bench)
        await bench.driver.close()
        assert asyncio.all_tasks() == {asyncio.current_task()}

    run_virtual(opened())
