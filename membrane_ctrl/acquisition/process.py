"""The process that owns screen and camera and measures the shape.

Imports nothing heavy: its parent imports it for the specification, and the limits on threads must be set before
NumPy is loaded.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from membrane_ctrl.acquisition.frame_address import FrameAddress
from membrane_ctrl.acquisition.remote import Remote
from membrane_ctrl.acquisition.threads import limit_threads
from membrane_ctrl.clock import RunClock
from membrane_ctrl.config import Config
from membrane_ctrl.ipc.ring import RingAddress

_NICENESS = 10  # behind the tick, the recorder and the screen


@dataclass(frozen=True, slots=True)
class AcquisitionSpec:
    """What the acquisition needs to know of the run.

    Attributes
    ----------
    config : Config
        The run's configuration.
    clock : RunClock
        The run's clock.
    telemetry : RingAddress
        Where the laser readings are.
    shapes : RingAddress
        Where the estimates go (`estimate.pack_estimate`).
    truth : RingAddress or None
        The twin's truth, which its camera renders; None on a real bench.
    frames : FrameAddress
        Where the pixels go.
    run_dir : Path or None
        Folder of the run, for the frames that are kept.
    """

    config: Config
    clock: RunClock
    telemetry: RingAddress
    shapes: RingAddress
    truth: RingAddress | None
    frames: FrameAddress
    run_dir: Path | None = None


def acquisition_main(spec: AcquisitionSpec, control: Connection) -> None:
    """Measure the shape until told to stop: target of a `spawn`ed process.

    Ends on "stop" over `control`, on `processes.STOP`, and when the parent has died.
    Reports go back over `control` as dicts {"kind": "acquisition", "state": ..., "message": ...}.

    Raises
    ------
    SystemExit
        With 1 if it cannot work at all (after a report of the reason).
    """
    parent = multiprocessing.parent_process()
    parent_pid = os.getppid() if parent is None or parent.pid is None else parent.pid
    os.nice(max(0, _NICENESS - os.nice(0)))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    limit_threads()
    remote = Remote(control, parent_pid)
    try:
        from membrane_ctrl.acquisition.session import run

        run(spec, remote)
    except Exception as error:
        remote.report("failed", f"{type(error).__name__}: {error}", traceback=traceback.format_exc())
        raise SystemExit(1) from None
    remote.report("stopped")
