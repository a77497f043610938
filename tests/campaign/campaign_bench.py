"""A bench for the campaign with real processes: the emulated board on its own clock, and a monitor
of its output.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from fcntl import ioctl
from pathlib import Path
from termios import TIOCSCTTY
from typing import Any

import psutil

from membrane_ctrl.config.schema import PumpConfig, TwinConfig
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.sim.bench import BenchSpec, LiveBench
from tests.worlds.faulty_board import PumpBoardEmulator

PATIENCE_S = 60.0
WATCHDOG_S = 0.5


@dataclass
class Output:
    """The board's output to the pump, and its time by the board's own clock."""

    time_s: float
    pump_fraction: float


@dataclass
class WatchedPlant:
    """Between board and plant: notes every change of the pump's drive,
    and how far the mirror went.
    """

    bench: LiveBench
    outputs: list[Output] = field(default_factory=list)
    looked_s: float = math.nan
    # between two rounds of the board: a busy machine adds this to its watchdog
    longest_gap_s: float = 0.0

    displacement_max_um: float = -math.inf
    gauge_pressure_max_pa: float = -math.inf

    def sample(self) -> Any:
        now_s = time.monotonic()
        if math.isfinite(self.looked_s):
            self.longest_gap_s = max(self.longest_gap_s, now_s - self.looked_s)
        self.looked_s = now_s
        sample = self.bench.sample()
        self.displacement_max_um = max(self.displacement_max_um, sample.displacement_um)
        self.gauge_pressure_max_pa = max(self.gauge_pressure_max_pa, sample.gauge_pressure_pa)
        return sample

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        self.outputs.append(Output(time.monotonic(), pump_fraction))
        self.bench.actuate(pump_fraction, vent_fraction)

    @property
    def pumping(self) -> bool:
        return bool(self.outputs) and self.outputs[-1].pump_fraction > 0

    def pump_ran_on_s(self, since_s: float) -> float:
        """How long after `since_s` the pump was driven, by the board's own clock."""
        return max(
            0.0,
            next(o.time_s for o in self.outputs if o.time_s > since_s and o.pump_fraction == 0)
            - since_s,
        )


class Run:
    """A `hold` as its own process against the emulated board."""

    def __init__(
        self,
        process: asyncio.subprocess.Process,
        folder: Path,
        board: PumpBoardEmulator,
        plant: WatchedPlant,
    ) -> None:
        self.process, self.folder, self.board, self.plant = process, folder, board, plant
        self.killed_utc_s: float | None = None

    @property
    def events(self) -> list[dict[str, Any]]:
        found = list(self.folder.glob("logs/*/events.jsonl"))
        if not found:
            return []
        return [
            json.loads(line) for line in found[0].read_text().splitlines() if line.endswith("}")
        ]

    @property
    def recorded(self) -> bool:
        """Whether the recorder has made its first round; until then the measurements are only in
        the rings.
        """
        return any(self.folder.glob("logs/*/.recorder-state"))

    def reached(self, state: str) -> bool:
        return any(event["kind"] == "state" and event["state"] == state for event in self.events)

    def faults(self) -> list[str]:
        return [event["name"] for event in self.events if event["kind"] == "fault"]

    def happened(self, kind: str, **words: Any) -> bool:
        """Whether an event of this kind with these words was recorded."""
        return any(
            event["kind"] == kind and words.items() <= event.items() for event in self.events
        )

    def recorder(self) -> psutil.Process:
        """The child that has the recording open. Raises LookupError."""
        for child in psutil.Process(self.process.pid).children():
            if any(str(self.folder / "logs") in file.path for file in child.open_files()):
                return child
        raise LookupError("no child has the recording open")

    def acquisition(self) -> psutil.Process:
        """The child with the lowest priority: the one that measures the shape."""
        return max(psutil.Process(self.process.pid).children(), key=lambda child: child.nice())

    async def until(self, what: Callable[[], bool]) -> None:
        """Wait for something. Raises AssertionError when it does not come."""
        give_up_s = time.monotonic() + PATIENCE_S
        while not what():
            assert time.monotonic() < give_up_s, (
                f"waited in vain; {self.events[-3:]}; {self.read_stderr_end()}"
            )
            assert self.process.returncode is None or what(), (
                f"ended with {self.process.returncode}; {self.read_stderr_end()}"
            )
            await asyncio.sleep(0.02)

    def read_stderr_end(self) -> str:
        """The last of what it wrote to standard error, where that is not a terminal."""
        path = self.folder / "stderr.txt"
        return path.read_text()[-2000:] if path.exists() else ""

    async def ended(self) -> int:
        """Its exit code."""
        return await asyncio.wait_for(self.process.wait(), PATIENCE_S)

    def signal(self, number: signal.Signals) -> float:
        """Send a signal to the control process alone; the time of it."""
        os.kill(self.process.pid, number)
        if number == signal.SIGKILL:
            self.killed_utc_s = time.time()
        return time.monotonic()


@contextlib.asynccontextmanager
async def running(
    folder: Path,
    plant: WatchedPlant,
    config: str = "",
    environment: Mapping[str, str] | None = None,
    terminal: int = asyncio.subprocess.DEVNULL,
) -> AsyncIterator[Run]:
    """A board and a running hold of it, on a terminal if given; both end afterwards."""
    on_terminal = terminal != asyncio.subprocess.DEVNULL
    board = PumpBoardEmulator(plant)
    await board.start()
    keep_up = asyncio.create_task(_catch_up(plant.bench))
    lab = folder / "lab.toml"
    lab.write_text(
        f'[devices]\nboard = "tcp://127.0.0.1:{board.port}"\nwatchdog_s = {WATCHDOG_S}\n{config}'
    )
    with (
        (folder / "stderr.txt").open("wb")
        if not on_terminal
        else contextlib.nullcontext(terminal) as stderr
    ):
        process = await asyncio.create_subprocess_exec(
            *(
                sys.executable,
                "-m",
                "membrane_ctrl",
                "hold",
                "--config",
                str(lab),
                "--logs",
                str(folder / "logs"),
            ),
            stdin=terminal,
            stdout=terminal,
            stderr=stderr,
            env={**os.environ, **(environment or {})},
            start_new_session=on_terminal,
            preexec_fn=(lambda: ioctl(0, TIOCSCTTY, 0)) if on_terminal else None,
        )
    children: list[psutil.Process] = []
    try:
        run = Run(process, folder, board, plant)
        await run.until(lambda: plant.pumping and run.reached("inflate") and run.recorded)
        children = psutil.Process(process.pid).children(recursive=True)
        yield run
    finally:
        if process.returncode is None:
            process.send_signal(signal.SIGCONT)
            process.kill()
        await process.wait()
        keep_up.cancel()
        await asyncio.gather(keep_up, return_exceptions=True)
        await board.stop()
        _, left = await asyncio.to_thread(psutil.wait_procs, children, 20.0)
        for child in left:
            child.kill()
    assert not left, f"left behind: {left}"


async def _catch_up(bench: LiveBench) -> None:
    while True:
        bench.catch_up()
        await asyncio.sleep(0.004)


def make_plant() -> WatchedPlant:
    """A calm bench in real time."""
    twin = TwinConfig(scenario="calm", start_error_um=-40.0)
    return WatchedPlant(LiveBench(BenchSpec(twin, PumpConfig(), RunClock.start(), port=0), None))
