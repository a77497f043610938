"""What the acquisition process needs to know about its run.

Imports nothing heavy, as the parent process imports it.
"""

from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.processes import frame_address, ring


@dataclass(frozen=True, slots=True)
class AcquisitionSpec:
    """What the acquisition needs to know about the run."""

    config: Config
    clock: RunClock
    telemetry: ring.RingAddress  # source of the laser readings
    shapes: ring.RingAddress  # destination of the estimates (`estimate.pack_estimate`)
    truth: (
        ring.RingAddress | None
    )  # the twin's truth, which its camera renders; None on a real bench
    frames: frame_address.FrameAddress
    run_dir: Path | None = None  # folder of the run, for kept frames
