"""Holds of the twin in slowed time, for a machine that has no room for so many in real time.

`python -m tests.worlds.slowed_holds FOLDER SLOWNESS NAME...` runs one of each name on one event
loop whose seconds last SLOWNESS seconds: supervisor, controller, plant with its board, control port
and rings are the product's; there is no link, no child process and no recording. It prints `ready`;
a line `end NAME` ends a hold, `begin NAME` begins it again, and the end of its standard input ends
all. Then `ticks.npy` of each run's folder holds its ticks: UNIX time, lateness in ms of slowed
time, ticks missed so far.
"""

from __future__ import annotations

import asyncio
import contextlib
import selectors
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import numpy as np

from membrane_ctrl.config.port import PortConfig
from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port.server import Port, RunHooks
from membrane_ctrl.control_port.sockets import listeners_for
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.hold.supervisor import Supervisor, Wiring
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualClock
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.shape_estimate import ESTIMATE_BYTES_MAX, ShapeEstimate, pack_estimate
from membrane_ctrl.model.telemetry import ROW_BYTES
from membrane_ctrl.processes import published_rings, ring
from tests.worlds.loop_bench import LoopBench

_START_S = 180.0


class SlowedLoop(asyncio.SelectorEventLoop):
    """An event loop whose seconds last `slowness` seconds."""

    def __init__(self, slowness: float) -> None:
        self._slowness = slowness
        super().__init__(_Slowed(slowness))

    def time(self) -> float:
        """Slowed seconds."""
        return time.monotonic() / self._slowness


class _Slowed(selectors.DefaultSelector):  # type: ignore[misc,valid-type]  # the platform's
    def __init__(self, slowness: float) -> None:
        super().__init__()
        self._slowness = slowness

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        return super().select(None if timeout is None else timeout * self._slowness)


async def hold(logs: Path, number: int) -> None:
    """Hold until cancelled."""
    config = Config()
    config = config.model_copy(update={"twin": config.twin.model_copy(update={"seed": number})})
    loop, board, ticks = (
        asyncio.get_running_loop(),
        LoopBench(config),
        list[tuple[float, float, float]](),
    )
    begin_s, utc = loop.time(), datetime.now(UTC)
    run = logs / f"{utc:%Y%m%dT%H%M%SZ}-held"
    await asyncio.to_thread(run.mkdir, parents=True)
    with ExitStack() as stack:
        sizes = {
            "telemetry": (3000, ROW_BYTES),
            "events": (64, 4096),
            "shapes": (8, ESTIMATE_BYTES_MAX),
        }
        rings = {name: stack.enter_context(ring.open_ring(*size)) for name, size in sizes.items()}
        writers = {
            name: stack.enter_context(contextlib.closing(ring.RingWriter(each)))
            for name, each in rings.items()
        }
        published_rings.publish_rings(run, rings, stack)
        clock = VirtualClock(0.0, utc, lambda: loop.time() - begin_s)
        shape, due_s = TruthShape(board.virtual, config, number), 0.0

        def newest() -> ShapeEstimate | None:
            nonlocal due_s
            if clock.now() < due_s:
                return None
            due_s = clock.now() + config.shape.period_s
            estimate = shape(clock.now())
            if estimate is not None:
                writers["shapes"].put(pack_estimate(estimate))
            return estimate

        def noted(outputs: TickOutputs) -> None:
            ticks.append((time.time(), outputs.row.lateness_ms, outputs.row.missed_ticks))

        wiring = Wiring(board, writers["telemetry"], writers["events"], shapes=newest)
        controller = Controller(config, zernike_projection())
        supervisor = Supervisor(controller, wiring, cast(Any, clock), config.loop.rate_hz)
        settings = (lambda: controller.loop_config, lambda: controller.pump_config)
        listeners = listeners_for(PortConfig(), logs, stack)
        port = Port(
            PortConfig(),
            listeners,
            run.name,
            RunHooks(supervisor.queue_command, supervisor.record_event, clock.now, *settings),
        )
        wiring.tick_listeners = {"control port": port.handle_tick, "noted": noted}
        await board.open()
        supervisor.queue_command(Command("hold", "the test"))
        try:
            async with port.open():
                exit_ = await supervisor.run(None)
            print(f"{logs.name} ended: {exit_.name.lower()}", file=sys.stderr, flush=True)
        finally:
            await asyncio.to_thread(np.save, run / "ticks.npy", np.array(ticks))


async def main(folder: Path, names: list[str]) -> None:
    """Hold all, and obey the lines of standard input."""
    lines: asyncio.Queue[str] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    def read() -> None:
        for line in sys.stdin:
            loop.call_soon_threadsafe(lines.put_nowait, line)
        loop.call_soon_threadsafe(lines.put_nowait, "")

    threading.Thread(target=read, daemon=True).start()
    running: dict[str, asyncio.Task[None]] = {}
    for number, name in enumerate(names, 1):
        running[name] = asyncio.create_task(hold(folder / name, number))
        await asyncio.sleep(0.0)
    print("ready", flush=True)
    while words := (await lines.get()).split():
        order, name = words
        if order == "begin":
            running[name] = asyncio.create_task(hold(folder / name, 1 + names.index(name)))
        else:
            await _ended(running.pop(name))
    for task in running.values():
        await _ended(task)


async def _ended(task: asyncio.Task[None]) -> None:
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


@contextlib.contextmanager
def slowed_holds(
    folder: Path, slowness: float, names: list[str]
) -> Iterator[subprocess.Popen[str]]:
    """Run them; to end one or begin it again, write a line to the process."""
    words = [sys.executable, "-m", "tests.worlds.slowed_holds", str(folder), str(slowness), *names]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.stdin.close()


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=lambda: SlowedLoop(float(sys.argv[2]))) as runner:
        runner.run(main(Path(sys.argv[1]), sys.argv[3:]))
