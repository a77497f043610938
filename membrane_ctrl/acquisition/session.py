"""Everything the acquisition holds, opened and closed around its loop."""

from __future__ import annotations

import signal
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass

from firmware_iface.roles import LinkError
from membrane_ctrl.acquisition.cycle import CyclePlan, ShapeCycle
from membrane_ctrl.acquisition.frames import FrameWriter
from membrane_ctrl.acquisition.laser import LaserHistory
from membrane_ctrl.acquisition.process import AcquisitionSpec
from membrane_ctrl.acquisition.remote import Remote
from membrane_ctrl.acquisition.twin_bench import TwinTruth
from membrane_ctrl.acquisition.warm_up import small, warm_up
from membrane_ctrl.acquisition.worker import estimate_message, keep_cycling
from membrane_ctrl.clock import RunClock
from membrane_ctrl.ipc.ring import RingWriter
from membrane_ctrl.metrology.live import LiveReconstructor
from membrane_ctrl.metrology.patterns import fringe_sequence, full_sequence
from membrane_ctrl.twin.camera import TwinOptics

_TRUTH_LOOK_S = 0.1


@dataclass(frozen=True, slots=True)
class WaitingClock:
    """The run's clock, with real waiting."""

    run: RunClock

    def now(self) -> float:
        """Seconds since the run's start."""
        return self.run.now()

    def sleep(self, duration_s: float) -> None:
        """Wait."""
        time.sleep(duration_s)


def run(spec: AcquisitionSpec, remote: Remote) -> None:
    """Prepare, then measure until told to stop.

    Until the first cycle SIGTERM simply ends the process, as nothing is held that would need care and a kernel
    that is being compiled cannot be asked; from then on it ends the cycle at its next exposure.

    Raises
    ------
    LinkError
        If there is no camera.
    """
    remote.report("preparing", "tracing the first picture, compiling what is not compiled yet")
    if spec.truth is None:
        raise LinkError("no camera: the twin's is the only one known; set shape.enabled = false to run without")
    config, clock = spec.config, WaitingClock(spec.clock)
    pattern = config.optics.pattern
    plan = CyclePlan(full_sequence(pattern), fringe_sequence(pattern), config.shape.frame_interval_s)
    with ExitStack() as stack:
        truth = stack.enter_context(closing(TwinTruth(spec.truth)))
        while not truth.known and not remote.stop:
            remote.listen(_TRUTH_LOOK_S)
        if remote.stop:
            return
        coarse = small(config.optics)
        warm_up(LiveReconstructor(coarse, config.shape.bin_px), coarse, plan, truth(), clock)
        bench = TwinOptics(config.optics, config.twin, truth, clock)
        bench.prepare()
        reconstructor = LiveReconstructor(config.optics, config.shape.bin_px)
        signal.signal(signal.SIGTERM, lambda number, frame: remote.end())
        shapes = stack.enter_context(closing(RingWriter(spec.shapes)))
        frames = stack.enter_context(closing(FrameWriter(spec.frames)))
        laser = stack.enter_context(closing(LaserHistory(spec.telemetry)))
        stack.callback(bench.camera.close)
        stack.callback(bench.screen.close)
        cycle = ShapeCycle(
            bench.camera, bench.screen, reconstructor, plan, frames, clock, laser, stopping=remote.interrupts
        )
        remote.report("running", "first cycle")
        keep_cycling(cycle, remote, lambda e: shapes.put(estimate_message(e)), clock, config.shape.period_s)
