"""Bytes of a day: an hour of hold at 50 Hz with a shape every 2 s through the real recorder, a
write every 0.8 s.

python -m benchmarks recording
"""

from __future__ import annotations

import json
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.tick_codec import MESSAGE_BYTES
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.processes.ring import RingReader, RingWriter, open_ring
from membrane_ctrl.recorder.recorder import Recorder
from membrane_ctrl.recorder.rerun_recording import Recording
from membrane_ctrl.recorder.segment_optimizer import Optimizer
from membrane_ctrl.run_files import table_specs
from membrane_ctrl.run_files.run_folder import create_run_folder
from membrane_ctrl.run_files.table_store import writer as table_writer
from membrane_ctrl.run_files.table_store.disk import Disk
from tests.support.figures import Figure, at_most
from tests.worlds.recorded_hold import parts_of

DAY_S = 86_400.0
WRITE_S = 0.8  # the recorder's rounds: 0.75 s and a little
DURATION_S = 3600  # one whole segment
_RINGS = {"inputs": (400, MESSAGE_BYTES), "shapes": (64, 1 << 16), "events": (64, 4096)}


class HandClock(RunClock):
    """A clock moved by hand."""

    moment_s = 0.0

    def now(self) -> float:
        """The time set by hand."""
        return HandClock.moment_s


class CountingDisk(Disk):
    """Counts the bytes that tables write."""

    written_bytes = 0

    def write(self, descriptor: int, data: bytes) -> None:
        """Write, and count."""
        CountingDisk.written_bytes += len(data)
        super().write(descriptor, data)


@dataclass(frozen=True)
class Recorded:
    """What a run took."""

    mb_a_day: dict[str, float]  # by table, and of Rerun segments
    rrd_before_mb: float  # a day, before they were optimised
    optimising_s: float
    busy: float  # share of a core
    written_share: float  # bytes written for tables, to bytes kept

    @property
    def tables_mb(self) -> float:
        """All tables but thumbnails, a day."""
        return sum(
            self.mb_a_day[spec.name]
            for spec in table_specs.ALL
            if spec is not table_specs.THUMBNAILS
        )


def run() -> list[Figure]:
    """The benchmark."""
    found = recorded(Config(), DURATION_S)
    mb = found.mb_a_day
    return [
        at_most("tables, without thumbnails", found.tables_mb, "MB a day", 300.0),
        *(at_most(f"of it {name}", mb[name], "MB a day") for name in ("ticks", "inputs", "shapes")),
        at_most(
            "Rerun segments, optimised",
            mb["*.rrd"],
            "MB a day",
            None,
            "before optimising",
            found.rrd_before_mb,
        ),
        at_most("bytes written for tables, to bytes kept", found.written_share, "", 3.0),
        at_most("optimising an hour at the lowest priority", found.optimising_s, "s"),
        at_most("recorder, share of a core", 100 * found.busy, "%", 3.0),
    ]


def recorded(config: Config, duration_s: float) -> Recorded:
    """Record a run of some seconds."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        return _measured(Path(folder), stack, config, duration_s)


def _measured(folder: Path, stack: ExitStack, config: Config, duration_s: float) -> Recorded:
    clock = HandClock(0.0, datetime.now(UTC))
    run_dir = create_run_folder(folder, "day", clock.origin_utc, config)
    addresses = {name: stack.enter_context(open_ring(*size)) for name, size in _RINGS.items()}
    readers = {name: RingReader(address) for name, address in addresses.items()}
    writers = {name: RingWriter(address) for name, address in addresses.items()}
    for end in (*readers.values(), *writers.values()):
        stack.callback(end.close)
    recording = Recording(run_dir, "day", clock, config)
    CountingDisk.written_bytes = 0
    table_writer.Disk = CountingDisk  # type: ignore[misc]
    recorder = Recorder(run_dir, clock, config, readers, recording, None, lambda report: None)
    busy_s = 0.0
    for number, part in enumerate(parts_of(config, duration_s, WRITE_S)):
        HandClock.moment_s = (number + 1) * WRITE_S
        part.put(writers)
        begun_s = time.process_time()
        recorder.drain_rings()
        recorder.write_second()
        busy_s += time.process_time() - begun_s
    ended = json.dumps({"kind": "end", "exit": "done", "mono_s": duration_s})
    writers["events"].put(ended.encode())
    a_day = DAY_S / duration_s / 1e6
    before = _bytes(run_dir, "*.rrd")
    recorder.finish(in_haste=True)
    optimising_s = _optimised_s(run_dir)
    mb = {spec.name: _bytes(run_dir, f"{spec.name}/*") * a_day for spec in table_specs.ALL}
    mb["*.rrd"] = _bytes(run_dir, "*.rrd") * a_day
    kept_bytes = sum(_bytes(run_dir, f"{spec.name}/*") for spec in table_specs.ALL)
    return Recorded(
        mb,
        before * a_day,
        optimising_s,
        busy_s / duration_s,
        CountingDisk.written_bytes / kept_bytes,
    )


def _optimised_s(run_dir: Path) -> float:
    """Time to optimise the segments: at the end of a run the recorder waits at most 20 s for it."""
    begun_s = time.perf_counter()
    optimizer = Optimizer(run_dir)
    for path in sorted(run_dir.glob("*.rrd")):
        optimizer.add_segment(path)
    while optimizer.is_busy:
        optimizer.poll_worker()
        time.sleep(0.05)
    return time.perf_counter() - begun_s


def _bytes(run_dir: Path, pattern: str) -> int:
    return sum(path.stat().st_size for path in run_dir.glob(pattern))
