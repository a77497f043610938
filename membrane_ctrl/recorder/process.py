"""The recorder's process: started with `spawn`, fed by rings, ended by the run's "end" event.

Rerun is imported here only after the process has started: the control process must not load it, and
a stream inherited by a forked child loses what the child logs.
"""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event as Flag

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.child_events import Alive
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.events import Event, EventLine
from membrane_ctrl.model.run_events import Ended
from membrane_ctrl.processes.child import STOP, parent_lives
from membrane_ctrl.processes.event_pipe import make_event_sender
from membrane_ctrl.processes.frame_address import FrameAddress
from membrane_ctrl.processes.ring import RingAddress, RingReader
from membrane_ctrl.recorder.thumbnails import Thumbnails

# Rings are emptied this often; the ring of ticks must hold a few intervals.
POLL_S = 0.25
# A recorder silent for this long is replaced: half of the rings' capacity, so that the next one
# still finds everything. A disk that needs longer for one second of a run is treated as lost.
_ROUND_S = 30.0


@dataclass(frozen=True, slots=True)
class RecorderSpec:
    """Arguments of the recorder's process; picklable."""

    run_dir: Path
    run_name: str  # of the `.rrd` segments
    clock: RunClock
    config: Config
    inputs: RingAddress  # the ticks (`tick_codec.pack_tick`)
    events: RingAddress  # the last one has the kind "end"
    shapes: RingAddress | None = None
    frames: FrameAddress | None = None  # for thumbnails
    snapshots: RingAddress | None = None  # of the controller (`tick_codec.pack_snapshot`)
    # earlier recorders of this run that died; this one continues where they stopped
    resumes: int = 0
    flush_s: float = 1.0 - POLL_S  # between writes; a power cut may lose this plus one poll


def recorder_main(spec: RecorderSpec, status: Connection | None = None) -> None:
    """Record until the "end" event, `processes.STOP` or the parent's death; then close and
    summarise.

    Parameters
    ----------
    spec : RecorderSpec
        What to record and where.
    status : Connection or None
        Gets the recorder's events, and a sign of life each second; drops those that cannot be sent
        at once.
    """
    is_stop_requested = Flag()
    # Ctrl-C reaches the whole terminal group, but the supervisor ends the run, with the "end" event
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(STOP, lambda *_: is_stop_requested.set())
    prepare_rerun()
    if not _record_run(
        spec, make_event_sender(status), is_stop_requested.is_set, lambda: not parent_lives()
    ):
        os._exit(0)  # everything is written; Rerun's exit handler would wait for a dead writer


def prepare_rerun() -> None:
    """Set what Rerun reads when it is imported."""
    # its own log would spoil the console; its errors come as exceptions
    os.environ["RUST_LOG"] = "off"
    # makes its allocator free a closed segment's memory at once, else 30 MB would stay
    os.environ["MIMALLOC_PURGE_DELAY"] = "0"


def _record_run(
    spec: RecorderSpec,
    report: Callable[[Event], None],
    is_stop_requested: Callable[[], bool],
    orphan: Callable[[], bool],
) -> bool:
    """Record until the end; returns whether the process may exit normally."""
    from membrane_ctrl.recorder.recorder import Recorder
    from membrane_ctrl.recorder.rerun_recording import Recording

    addresses = {
        "inputs": spec.inputs,
        "events": spec.events,
        "shapes": spec.shapes,
        "snapshots": spec.snapshots,
    }
    rings = {
        name: RingReader(address) for name, address in addresses.items() if address is not None
    }
    # A successor numbers its segments after those of the dead recorder
    first = 0
    if spec.resumes:
        first = sum(1 for _ in spec.run_dir.glob(f"{spec.run_name}-*.rrd"))
    recording = Recording(spec.run_dir, spec.run_name, spec.clock, spec.config, first)
    wanted = spec.frames is not None and spec.config.recording.thumbnails
    thumbnails = None
    if wanted and spec.frames is not None:
        thumbnails = Thumbnails(spec.frames)
    recorder = Recorder(
        spec.run_dir, spec.clock, spec.config, rings, recording, thumbnails, report, spec.resumes
    )
    next_write_s = 0.0
    while not recorder.ended:
        # asked before draining, so that this round still sees a dying parent's last messages
        exit_word = "terminated" if is_stop_requested() else ""
        if orphan():
            exit_word = "killed"
        recorder.drain_rings()
        if exit_word and not recorder.ended:
            recorder.add_events([_end_event(spec.clock, exit_word)])
        elif recorder.urgent or time.monotonic() >= next_write_s:
            next_write_s = time.monotonic() + spec.flush_s
            recorder.write_second()
            report(Alive(_ROUND_S))
        if not recorder.ended:
            time.sleep(POLL_S)
    recorder.finish(in_haste=is_stop_requested())
    if thumbnails is not None:
        thumbnails.close()
    for ring in rings.values():
        ring.close()
    return not recording.stuck


def _end_event(clock: RunClock, exit_word: str) -> EventLine:
    now_s = clock.now()
    return {"time_utc": clock.utc(now_s).isoformat(), "mono_s": now_s} | Ended(exit_word).to_dict()
