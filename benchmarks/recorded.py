"""A simulated week with its recorder: does the memory of both stay flat, and how much comes to the disk?

The recorder's own code, fed by rings as in a run, on the simulated clock; it writes every half simulated minute
instead of every second, which costs less and keeps the same.

python -m benchmarks.recorded [--days 7] [--seed 1]
"""

from __future__ import annotations

import argparse
import json
import pickle
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.figures import Figure, at_most, show
from benchmarks.soak import RATE_HZ, everything, rss_mb, soak, soak_config, tell_days
from membrane_ctrl import config_file
from membrane_ctrl.clock import RunClock
from membrane_ctrl.ipc.ring import RingReader, RingWriter, ring
from membrane_ctrl.recording.recorder import Recorder
from membrane_ctrl.recording.sink import Recording
from membrane_ctrl.telemetry import ROW_BYTES
from membrane_ctrl.tick_record import MESSAGE_BYTES, pack_tick
from membrane_ctrl.virtual_run import VirtualTick

WRITE_EVERY_S = 30.0
_SLOTS, _EVENT_BYTES, _SHAPE_BYTES = round(4 * WRITE_EVERY_S * RATE_HZ), 4096, 32_768
_KINDS = ("*.rrd", "inputs-*.bin", "columns/*", "events.jsonl")
# Rerun and Arrow have then reached their working size; the first segment is closed by then
SETTLED_S = 2 * 3600.0


@dataclass(frozen=True, slots=True)
class _Clock(RunClock):
    """The simulated time of a run; `at` is one float in a list, as the clock itself is frozen."""

    at: list[float]

    def now(self) -> float:
        return self.at[0]


class RecordedRun:
    """Takes virtual ticks as the recorder of a run does."""

    def __init__(self, folder: Path, seed: int, stack: ExitStack) -> None:
        config = soak_config(seed)
        self._clock = _Clock(time.monotonic(), datetime(2026, 1, 1, tzinfo=UTC), [0.0])
        sizes = {"telemetry": ROW_BYTES, "events": _EVENT_BYTES, "inputs": MESSAGE_BYTES, "shapes": _SHAPE_BYTES}
        addresses = {name: stack.enter_context(ring(_SLOTS, size)) for name, size in sizes.items()}
        self._writers = {name: RingWriter(address) for name, address in addresses.items()}
        readers = {name: RingReader(address) for name, address in addresses.items()}
        for end in (*self._writers.values(), *readers.values()):
            stack.callback(end.close)
        (folder / "config.toml").write_text(config_file.dump(config))
        self.told: list[dict[str, object]] = []
        recording = Recording(folder, "week", self._clock, config, 0)
        self._recorder = Recorder(folder, self._clock, config, readers, recording, None, self.told.append)
        self._tick, self._next_write_s = 0, WRITE_EVERY_S
        self.settled_mb = 0.0

    def take(self, tick: VirtualTick) -> None:
        """One tick, and what is due with it."""
        tell_days(tick)
        self._tick += 1
        now_s = self._clock.at[0] = tick.row.mono_s
        row = tick.row.pack()
        self._writers["telemetry"].put(row)
        for message in pack_tick(self._tick, tick.inputs, tick.outputs, row):
            self._writers["inputs"].put(message)
        if tick.inputs.estimate is not None:
            self._writers["shapes"].put(pickle.dumps(tick.inputs.estimate))
        for event in tick.events:
            self._event(event)
        if now_s >= self._next_write_s:
            self._next_write_s += WRITE_EVERY_S
            self._recorder.drain()
            self._recorder.write()
        if not self.settled_mb and now_s >= SETTLED_S:
            self.settled_mb = rss_mb()

    def _event(self, event: dict[str, object]) -> None:
        times = {"time_utc": self._clock.utc(self._clock.now()).isoformat(), "mono_s": self._clock.now()}
        self._writers["events"].put(json.dumps({**times, **event}).encode())

    def finish(self) -> None:
        """Close the run."""
        self._event({"kind": "end", "exit": "done"})
        self._recorder.finish()


def figures(days: float, seed: int = 1) -> list[Figure]:
    """Memory and sizes of a recorded soak."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        record = RecordedRun(folder, seed, stack)
        soak(days, seed, True, everything(seed), record.take)
        ended_mb = rss_mb()
        record.finish()
        sizes_mb = {kind: sum(path.stat().st_size for path in folder.rglob(kind)) / 1e6 for kind in _KINDS}
        whole_mb = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    errors = [told for told in record.told if told["kind"] in ("recorder_error", "disk_low")]
    grown = 100 * (ended_mb / record.settled_mb - 1)
    return [
        at_most("simulated days at 10 Hz, a shape each 2 s", days, "d"),
        at_most(
            "memory of control and recorder grown since the second hour",
            grown,
            "%",
            5.0,
            "MB then",
            record.settled_mb,
        ),
        at_most("recorded", whole_mb / days, "MB a day"),
        *(at_most(f"of these {kind}", size / days, "MB a day") for kind, size in sizes_mb.items()),
        at_most("messages dropped", sum(summary["dropped"].values()), "", 0.0),
        at_most("recorder's errors", len(errors), "", 0.0),
    ]


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--days", type=float, default=7.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    found = figures(options.days, options.seed)
    show("recorded", found)
    return int(any(figure.met is False for figure in found))


if __name__ == "__main__":
    sys.exit(main())
