"""Memory of the processes of a run after a week of telemetry, against that after an hour.

python -m benchmarks memory [the whole takes about ten minutes]

Recorder, console and alarms are the real processes on the real rings. They get a week of a hold at
10 Hz as fast as the recorder takes it. The hours that are compared, the first and the last two, are
written second by second, as in a run: Rerun's index of an open segment grows with every write. The
days between come in a minute a write. The run's clock is a number in shared memory. Shapes come
once a minute of run. The acquisition measures frames of its twin (306 x 256 pixels) at five cycles
a second; a week of its cycles is not run, so its figure says over how many cycles it was seen to
grow. The control process in virtual time is in `soak`.
"""

from __future__ import annotations

import os
import struct
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

import numpy as np
import psutil

from benchmarks.records.memory_acquisition import acquisition_figures
from membrane_ctrl.alarms.process import AlarmsSpec, watch_run
from membrane_ctrl.config.schema import Config, LoopConfig, RecordingConfig, ShapeConfig
from membrane_ctrl.console.process import ConsoleSpec, console_main
from membrane_ctrl.controller.tick_codec import MESSAGE_BYTES, RECORD, TICK
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.shape_estimate import pack_estimate, unpack_estimate
from membrane_ctrl.model.telemetry import FIELDS, ROW_BYTES
from membrane_ctrl.processes.child import Child
from membrane_ctrl.processes.event_pipe import make_pipe
from membrane_ctrl.processes.ring import RingAddress, RingWriter, open_ring
from membrane_ctrl.recorder import process
from membrane_ctrl.recorder.process import RecorderSpec
from membrane_ctrl.run_files.run_folder import create_run_folder
from tests.support.figures import Figure, at_most
from tests.worlds.recorded_hold import RunPart, parts_of

HOUR_S, WEEK_S = 3600.0, 7 * 86_400.0
ROUND_S = 1200.0
BETWEEN_S = 60  # 20 minutes in one write make the recorder take memory that a run never asks for
RATE_HZ = 10.0
_KEPT = round(2.5 * ROUND_S * RATE_HZ)
_DOUBLE = struct.Struct("<d")
_TIME, _TICK = FIELDS.index("mono_s"), FIELDS.index("tick")


@dataclass(frozen=True, slots=True)
class SharedClock(RunClock):
    """The run's clock as a number in shared memory."""

    memory: str = ""

    def now(self) -> float:
        """The feeder's time."""
        memory = _attached(self.memory)
        assert memory.buf is not None
        return float(_DOUBLE.unpack_from(memory.buf, 0)[0])


_memories: dict[str, SharedMemory] = {}


def _attached(name: str) -> SharedMemory:
    if name not in _memories:
        _memories[name] = SharedMemory(name)
    return _memories[name]


def hurried_recorder(spec: RecorderSpec, status: Connection) -> None:
    """The recorder without its pause between two reads of the rings."""
    process.POLL_S = 1e-3
    process.recorder_main(spec, status)


def quiet_console(spec: ConsoleSpec) -> None:
    """The console without a terminal or reader."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    console_main(spec)


def mute_alarms(spec: AlarmsSpec) -> None:
    """The alarms without a target."""
    watch_run(spec, [lambda notice: True], lambda event: None, lambda: True)


def run() -> list[Figure]:
    """The benchmark."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        found = _fed_figures(Path(folder), stack)
    return [*found, *acquisition_figures()]


def _fed_figures(folder: Path, stack: ExitStack) -> list[Figure]:
    config = Config(
        loop=LoopConfig(rate_hz=RATE_HZ),
        shape=ShapeConfig(period_s=60.0),
        recording=RecordingConfig(min_free_mb=1.0),
    )
    clock_memory = SharedMemory(create=True, size=8)
    stack.callback(clock_memory.unlink)
    stack.callback(clock_memory.close)
    clock = SharedClock(0.0, datetime.now(UTC), clock_memory.name)
    run_dir = create_run_folder(folder, "week", clock.origin_utc, config)
    sizes = {
        "telemetry": (_KEPT, ROW_BYTES),
        "inputs": (_KEPT, MESSAGE_BYTES),
        "shapes": (256, 1 << 16),
        "events": (1024, 4096),
    }
    rings = {name: stack.enter_context(open_ring(*size)) for name, size in sizes.items()}
    writers = {name: RingWriter(address) for name, address in rings.items()}
    for writer in writers.values():
        stack.callback(writer.close)
    children, status = _children(config, clock, rings, run_dir)
    for child in children:
        child.start()
        stack.callback(child.stop, 10.0)
    seen: list[tuple[float, dict[str, float]]] = []
    for now_s, part in _rounds(config):
        part.put(writers)
        assert clock_memory.buf is not None
        _DOUBLE.pack_into(clock_memory.buf, 0, now_s)
        _wait_for_writes(status, 2)
        _thin_out(run_dir)
        seen.append((now_s, _own_mb(children)))
    # the recorder's memory rises with its segment of an hour and falls with the next
    return list(_compared(_largest(seen, HOUR_S), _largest(seen, WEEK_S)))


def _children(
    config: Config, clock: RunClock, rings: dict[str, RingAddress], run_dir: Path
) -> tuple[list[Child], Connection]:
    ours, theirs = make_pipe()
    spec = RecorderSpec(
        run_dir,
        "week",
        clock,
        config,
        rings["inputs"],
        rings["events"],
        rings["shapes"],
        flush_s=0.0,
    )
    screen = ConsoleSpec(
        clock, rings["telemetry"], rings["events"], rings["shapes"], run_dir, config
    )
    alarms = AlarmsSpec(clock, rings["telemetry"], rings["events"], config.alarms, "week")
    return [
        Child("recorder", "benchmarks.records.memory:hurried_recorder", (spec, theirs), nice=5),
        Child("console", "benchmarks.records.memory:quiet_console", (screen,), nice=5),
        Child("alarms", "benchmarks.records.memory:mute_alarms", (alarms,), nice=5),
    ], ours


def _rounds(config: Config) -> Iterator[tuple[float, RunPart]]:
    """A week: the approach to the hold once, then the same 20 minutes of it, each time later."""
    seconds = list(parts_of(config, 2 * ROUND_S, 1.0))
    count = round(ROUND_S)
    first, again = seconds[:count], seconds[count:]
    for number in range(round(WEEK_S / ROUND_S)):
        begin_s = number * ROUND_S
        compared = begin_s < HOUR_S or begin_s >= WEEK_S - 2 * HOUR_S
        step = 1 if compared else BETWEEN_S
        for place in range(0, count, step):
            part = _joined((again if number else first)[place : place + step])
            yield begin_s + place + step, _later(part, max(number - 1, 0) * ROUND_S)


def _joined(parts: Sequence[RunPart]) -> RunPart:
    whole = RunPart()
    for part in parts:
        for name in ("telemetry", "inputs", "shapes", "events"):
            getattr(whole, name).extend(getattr(part, name))
    return whole


def _later(part: RunPart, by_s: float) -> RunPart:
    ticks = round(by_s * RATE_HZ)
    rows = np.frombuffer(b"".join(part.telemetry), dtype="<f8").reshape(-1, len(FIELDS)).copy()
    rows[:, _TIME] += by_s
    rows[:, _TICK] += ticks
    return RunPart(
        [row.tobytes() for row in rows],
        [_tick_later(message, ticks, by_s) for message in part.inputs],
        [_shape_later(message, by_s) for message in part.shapes],
        part.events,
    )


def _shape_later(message: bytes, by_s: float) -> bytes:
    estimate = unpack_estimate(message)
    return pack_estimate(replace(estimate, time_s=estimate.time_s + by_s))


def _tick_later(message: bytes, ticks: int, by_s: float) -> bytes:
    if message[:1] != TICK:
        return message
    record = np.frombuffer(message[1 : 1 + RECORD.itemsize], dtype=RECORD).copy()
    row = np.frombuffer(message[1 + RECORD.itemsize :], dtype="<f8").copy()
    record["tick"] += ticks
    record["now_s"] += by_s
    row[[_TIME, _TICK]] += by_s, ticks
    return TICK + record.tobytes() + row.tobytes()


def _wait_for_writes(status: Connection, count: int) -> None:
    """Wait for the recorder's report `alive`, which follows each write."""
    while count:
        count -= status.recv()["kind"] == "alive"


def _thin_out(run_dir: Path) -> None:
    """A week is some GB: remove closed, optimised segments."""
    for path in sorted(run_dir.glob("*.rrd"))[:-30]:
        path.unlink()


def _own_mb(children: list[Child]) -> dict[str, float]:
    """Without shared pages: libraries, and rings, of fixed size, whose pages count once they were
    touched.
    """
    found = {child.name: psutil.Process(child.pid).memory_info() for child in children}
    return {name: (info.rss - info.shared) / 1e6 for name, info in found.items()}


def _largest(seen: list[tuple[float, dict[str, float]]], until_s: float) -> dict[str, float]:
    """Of the hour before a moment."""
    part = [sizes for now_s, sizes in seen if until_s - HOUR_S < now_s <= until_s]
    return {name: max(sizes[name] for sizes in part) for name in part[0]}


def _compared(before_mb: dict[str, float], after_mb: dict[str, float]) -> Iterator[Figure]:
    for name, value in after_mb.items():
        grown = 100.0 * (value / before_mb[name] - 1.0)
        yield at_most(
            f"{name}: growth of peak memory, last hour of a week against the first",
            grown,
            "%",
            5.0,
            "peak of the first, MB",
            before_mb[name],
        )
