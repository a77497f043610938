"""What the acquisition process needs of its run.

Imports nothing heavy, as the parent process imports it.
"""

from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.processes import frame_address, ring


@dataclass(frozen=True, slots=True)
class AcquisitionSpec:
    """The run, as the acquisition process gets it.

    Attributes
    ----------
    config : Config
    clock : RunClock
    telemetry : ring.RingAddress
        Source of the laser readings.
    shapes : ring.RingAddress
        Destination of the estimates (`shape_estimate.pack_estimate`).
    truth : ring.RingAddress, optional
        The twin's truth, which its camera renders; None on a real bench.
    frames : frame_address.FrameAddress
    run_dir : Path, optional
        Folder of the run, for kept frames.
    """

    config: Config
    clock: RunClock
    telemetry: ring.RingAddress
    shapes: ring.RingAddress
    truth: ring.RingAddress | None
    frames: frame_address.FrameAddress
    run_dir: Path | None = None
