"""Everything the acquisition holds, opened and closed around its loop."""

from __future__ import annotations

import signal
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from firmware_iface.roles import LinkError
from membrane_ctrl.acquisition.cycle import CyclePlan, ShapeCycle, pause_s
from membrane_ctrl.acquisition.frames import FrameWriter
from membrane_ctrl.acquisition.geometry_watch import LiveDrift, geometry_event
from membrane_ctrl.acquisition.laser import LaserHistory
from membrane_ctrl.acquisition.optical_bench import OpticalBench, configured_bench, open_bench
from membrane_ctrl.acquisition.process import AcquisitionSpec
from membrane_ctrl.acquisition.raw_frames import RawFrames
from membrane_ctrl.acquisition.remote import Remote
from membrane_ctrl.acquisition.twin_bench import TwinTruth
from membrane_ctrl.acquisition.warm_up import TYPICAL_FILM, small, warm_up
from membrane_ctrl.acquisition.worker import estimate_message, keep_cycling
from membrane_ctrl.calibration.geometry_in_force import KEPT, geometry_of_run
from membrane_ctrl.calibration.geometry_spread_file import spread_of
from membrane_ctrl.clock import RunClock
from membrane_ctrl.config import Config, OpticsConfig
from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.ipc.ring import RingAddress, RingWriter
from membrane_ctrl.metrology.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.live import LiveReconstructor
from membrane_ctrl.metrology.patterns import fringe_sequence, full_sequence
from membrane_ctrl.processes import STOP
from membrane_ctrl.twin.camera import FilmPosition, TwinOptics

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

    Until the first cycle `processes.STOP` simply ends the process, as nothing is held that would need care and a
    kernel that is being compiled cannot be asked; from then on it ends the cycle at its next exposure.

    Raises
    ------
    LinkError
        If no camera is configured, or its patterns do not fit on the screen.
    """
    remote.listen()  # the first word, which promises the next one for when all this is over
    remote.report("preparing", "tracing the first picture, compiling what is not compiled yet")
    config, clock = spec.config, WaitingClock(spec.clock)
    geometry = geometry_of_run(spec.run_dir, config)
    remote.tell(geometry_event(geometry))
    pattern = geometry.optics.pattern
    plan = CyclePlan(full_sequence(pattern), fringe_sequence(pattern), config.shape.frame_interval_s)
    with ExitStack() as stack:
        if spec.truth is None:
            bench = configured_bench(config, clock)
            _warm_up(config, plan, TYPICAL_FILM, clock)
            signal.signal(STOP, lambda number, frame: remote.end())
            stack.callback(bench.close)
            _open(bench, config, clock, remote)
        else:
            bench = _twin_bench(spec.truth, config, plan, clock, remote, stack)
            signal.signal(STOP, lambda number, frame: remote.end())
            stack.callback(bench.close)
        if remote.stop:
            return
        spread = _spread(spec.run_dir, geometry.optics)
        reconstructor = LiveReconstructor(geometry.optics, config.shape.bin_px, spread=spread)
        drift = LiveDrift(geometry, config.shape.bin_px)
        shapes = stack.enter_context(closing(RingWriter(spec.shapes)))
        frames = stack.enter_context(closing(FrameWriter(spec.frames)))
        stack.callback(bench.close)  # before the ring of frames: an exposure under way holds the pixels of a slot
        laser = stack.enter_context(closing(LaserHistory(spec.telemetry, config.loop.rate_hz)))
        raw = _raw_frames(spec, geometry.optics, plan, stack, remote)
        cycle = ShapeCycle(
            bench.camera, bench.screen, reconstructor, plan, frames, clock, laser, stopping=remote.interrupts
        )

        def publish(estimate: ShapeEstimate) -> None:
            shapes.put(estimate_message(estimate))
            if (notice := drift.after(estimate)) is not None:
                remote.tell(notice)
            if raw is not None:
                raw.after(estimate)

        def keep(estimate: ShapeEstimate) -> Path:
            if raw is None:
                raise OSError("the run has no folder")
            return raw.capture(estimate)

        remote.prepared()
        remote.report("running", "first cycle")
        keep_cycling(cycle, remote, publish, clock, config.shape.period_s, keep)


def _twin_bench(
    address: RingAddress, config: Config, plan: CyclePlan, clock: WaitingClock, remote: Remote, stack: ExitStack
) -> OpticalBench:
    """The twin's camera and screen, once its bench has said where the film is."""
    truth = stack.enter_context(closing(TwinTruth(address)))
    while not truth.known and not remote.stop:
        remote.listen(_TRUTH_LOOK_S)
    optics = TwinOptics(config.optics, config.twin, truth, clock)
    if not remote.stop:
        _warm_up(config, plan, truth(), clock)
        optics.prepare()
    return OpticalBench(optics.camera, optics.screen)


def _warm_up(config: Config, plan: CyclePlan, position: FilmPosition, clock: WaitingClock) -> None:
    coarse = small(config.optics)
    warm_up(LiveReconstructor(coarse, config.shape.bin_px), coarse, plan, position, clock)


def _open(bench: OpticalBench, config: Config, clock: WaitingClock, remote: Remote) -> None:
    """Open camera and screen; what is not there is tried again until told to stop: the hold goes on meanwhile."""
    failures = 0
    while not remote.stop:
        try:
            found = open_bench(bench, config, clock)
            for line in (f"camera: {found.camera}", *found.measured, *found.problems):
                remote.report("preparing", line)
            return
        except LinkError as error:
            failures += 1
            remote.report("retrying", str(error))
        again_s = clock.now() + pause_s(failures)
        while not remote.stop and (remaining_s := again_s - clock.now()) > 0:
            remote.listen(remaining_s)


def _spread(run_dir: Path | None, optics: OpticsConfig) -> GeometrySpread | None:
    """How well the run's geometry is known; None if nothing is stated of it."""
    kept = None if run_dir is None else run_dir / KEPT
    spread, _said = spread_of(optics.geometry, kept if kept is not None and kept.exists() else None)
    return spread if spread.names else None


def _raw_frames(
    spec: AcquisitionSpec, optics: OpticsConfig, plan: CyclePlan, stack: ExitStack, remote: Remote
) -> RawFrames | None:
    """What keeps frames, if there is a place for them."""
    if spec.run_dir is None:
        return None
    folder, recording = spec.run_dir / "raw", spec.config.recording
    raw = RawFrames(folder, optics, plan, recording, spec.frames, spec.telemetry, remote.tell)
    return stack.enter_context(closing(raw))
