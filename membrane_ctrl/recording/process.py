"""The recorder's process: started with `spawn`, fed by rings, ended by the run's "end" event.

Rerun is imported here only after the process has started: the control process must not load it, and a stream
that a forked child inherited loses what the child logs.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event as Flag
from typing import Any

from membrane_ctrl.acquisition.frame_address import FrameAddress
from membrane_ctrl.child_report import alive, reporter
from membrane_ctrl.clock import RunClock
from membrane_ctrl.config import Config
from membrane_ctrl.ipc.ring import RingAddress, RingReader
from membrane_ctrl.processes import STOP

# Rings are emptied this often: the telemetry ring has to hold a few of these.
POLL_S = 0.25
# A recorder that has not got round for so long is replaced: half of what the rings hold, so that the next one
# still finds everything. A disk that is slower than this for one second of a run is as good as gone.
_ROUND_S = 30.0


@dataclass(frozen=True, slots=True)
class RecorderSpec:
    """What the recorder's process needs; picklable.

    Attributes
    ----------
    run_dir : Path
        From `run_folder.create_run_folder`.
    run_name : str
        Name of the `.rrd` segments.
    clock : RunClock
    config : Config
    telemetry : RingAddress
        Packed `TelemetryRow`s.
    events : RingAddress
        JSON objects with `time_utc`, `mono_s`, `kind`, ...; the one of kind "end" (with `exit`) is the last.
    shapes : RingAddress or None
        `estimate.pack_estimate`.
    frames : FrameAddress or None
        Shared camera frames, for thumbnails.
    inputs : RingAddress or None
        What the ticks were given (`tick_record`), for a replay.
    resumes : int
        How many recorders of this run have died before this one; it goes on where they stopped.
    flush_s : float
        From one write to the next: with the round it waits for, what a power cut may lose.
    """

    run_dir: Path
    run_name: str
    clock: RunClock
    config: Config
    telemetry: RingAddress
    events: RingAddress
    shapes: RingAddress | None = None
    frames: FrameAddress | None = None
    inputs: RingAddress | None = None
    resumes: int = 0
    flush_s: float = 1.0 - POLL_S


def recorder_main(spec: RecorderSpec, status: Connection | None = None) -> None:
    """Record until the "end" event, until `processes.STOP`, or until the parent has died; then close and summarise.

    Parameters
    ----------
    spec : RecorderSpec
        What to record and where.
    status : Connection or None
        Gets small dicts {"kind": "recorder_error" | "recorder_recovered" | "disk_low" | "recorder_done", "message":
        ...} and each second that it is alive; one that cannot be taken at once is given up.
    """
    asked = Flag()
    # ctrl-C reaches the whole terminal group: the supervisor decides when the run is over, with the "end" event
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(STOP, lambda *_: asked.set())
    os.environ["RUST_LOG"] = "off"  # Rerun's own log would write over the live screen; its errors come as exceptions
    # read when Rerun is imported: its allocator gives back at once what a closed segment leaves, or 30 MB would stay
    os.environ["MIMALLOC_PURGE_DELAY"] = "0"
    if not _record(spec, reporter(status), asked.is_set, parent_died):
        os._exit(0)  # everything is written; Rerun's exit handler would wait for a dead writer


def _record(
    spec: RecorderSpec,
    report: Callable[[dict[str, Any]], None],
    asked: Callable[[], bool],
    orphan: Callable[[], bool],
) -> bool:
    """Record until the end; whether the process may end in the ordinary way."""
    from membrane_ctrl.recording.recorder import Recorder
    from membrane_ctrl.recording.sink import Recording
    from membrane_ctrl.recording.thumbnails import Thumbnails

    addresses = {
        "telemetry": spec.telemetry,
        "events": spec.events,
        "shapes": spec.shapes,
        "inputs": spec.inputs,
    }
    rings = {name: RingReader(address) for name, address in addresses.items() if address is not None}
    first = sum(1 for _ in spec.run_dir.glob(f"{spec.run_name}-*.rrd")) if spec.resumes else 0
    recording = Recording(spec.run_dir, spec.run_name, spec.clock, spec.config, first)
    wanted = spec.frames is not None and spec.config.recording.thumbnails
    thumbnails = Thumbnails(recording, spec.frames) if wanted and spec.frames is not None else None
    recorder = Recorder(spec.run_dir, spec.clock, spec.config, rings, recording, thumbnails, report, spec.resumes)
    next_write_s = 0.0
    while not recorder.ended:
        # asked before draining: what a parent put before it died is then seen in this round
        exit_word = "killed" if orphan() else "terminated" if asked() else ""
        recorder.drain()
        if exit_word and not recorder.ended:
            recorder.take_events([_end_event(spec.clock, exit_word)])
        elif recorder.urgent or time.monotonic() >= next_write_s:
            next_write_s = time.monotonic() + spec.flush_s
            recorder.write()
            report(alive(_ROUND_S))
        if not recorder.ended:
            time.sleep(POLL_S)
    recorder.finish(in_haste=asked())
    if thumbnails is not None:
        thumbnails.close()
    for ring in rings.values():
        ring.close()
    return not recording.stuck


def _end_event(clock: RunClock, exit_word: str) -> dict[str, Any]:
    now_s = clock.now()
    return {"time_utc": clock.utc(now_s).isoformat(), "mono_s": now_s, "kind": "end", "exit": exit_word}


def parent_died() -> bool:
    """Whether the process that started this one is gone: its children get another parent."""
    started_by = multiprocessing.parent_process()
    return started_by is not None and os.getppid() != started_by.pid
