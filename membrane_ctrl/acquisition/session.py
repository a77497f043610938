"""The acquisition's resources, opened and closed around its loop."""

import signal
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

from firmware_iface.roles import LinkError
from membrane_ctrl.acquisition import (
    cycle,
    cycle_loop,
    cycle_plan,
    geometry_watch,
    laser_history,
    optical_bench,
    raw_frames,
)
from membrane_ctrl.acquisition.remote import CaptureRequest, Remote
from membrane_ctrl.acquisition.spec import AcquisitionSpec
from membrane_ctrl.acquisition.twin_truth import TwinTruth
from membrane_ctrl.acquisition.vibrations import make_vibration_handler
from membrane_ctrl.acquisition.waiting_clock import WaitingClock
from membrane_ctrl.acquisition.warm_up import FilmAtRest, coarse_optics, warm_up
from membrane_ctrl.config.schema import Config, OpticsConfig
from membrane_ctrl.geometry import run_geometry, spread_file
from membrane_ctrl.metrology.cycle import live_reconstructor
from membrane_ctrl.metrology.phase import pattern_sequence
from membrane_ctrl.metrology.tracking.live_tracker import LiveTracker
from membrane_ctrl.model.durations import pause_s
from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate
from membrane_ctrl.processes import child, frames, ring
from membrane_ctrl.sim.optics.camera import FilmPosition, TwinOptics

_TRUTH_POLL_S = 0.1  # interval at which the twin's truth is read until it is there


def run_acquisition(spec: AcquisitionSpec, remote: Remote) -> None:
    """Prepare, then measure until stopped.

    Before the first cycle `processes.STOP` simply ends the process, because no resource needs to be
    released and a compiling kernel cannot check for it; afterwards it ends the cycle at its next
    exposure.

    Parameters
    ----------
    spec : AcquisitionSpec
    remote : Remote
        The other end of the process.

    Raises
    ------
    LinkError
        If no camera is configured, or its patterns do not fit on the screen.
    """
    # The first report permits silence until all this is done.
    remote.take_commands()
    remote.report_state("preparing", "rendering the first picture, compiling")
    config = spec.config
    clock = WaitingClock(spec.clock)
    geometry = run_geometry.read_run_geometry(spec.run_dir, config)
    remote.send_event(geometry_watch.make_geometry_event(geometry, spec.run_dir))
    plan = _cycle_plan(config, geometry.optics)
    with ExitStack() as stack:
        # Camera and screen, open, and compiled kernels.
        if spec.truth is None:
            bench = optical_bench.configured_bench(config, clock)
            _warm_up(config, plan, FilmAtRest(), clock)
        else:
            bench = _make_twin_bench(spec.truth, config, plan, clock, remote, stack)
        signal.signal(child.STOP, lambda number, frame: remote.request_stop())
        stack.callback(bench.close)
        _open_bench(bench, config, clock, remote)
        if remote.stop:
            return

        # What makes figures, and what evaluates them.
        cycles = _make_cycles(spec, geometry.optics)
        reconstructor, plan, period_s = _make_reconstructor(spec, geometry.optics, plan, cycles)
        statement_watch = geometry_watch.StatementWatch()
        drift = geometry_watch.GeometryWatch(geometry, config.shape.bin_px)
        handle_vibrations = make_vibration_handler(config, spec.clock, spec.run_dir)

        # Rings. The bench closes before that of the frames: a running exposure holds the pixels of
        # a slot.
        shapes = stack.enter_context(closing(ring.RingWriter(spec.shapes)))
        slots = stack.enter_context(closing(frames.FrameWriter(spec.frames)))
        stack.callback(bench.close)
        history = laser_history.LaserHistory(spec.telemetry, config.loop.rate_hz)
        laser = stack.enter_context(closing(history))
        raw = _make_raw_frames(spec, geometry.optics, plan, stack, remote)
        shape_cycle = cycle.ShapeCycle(
            bench.camera,
            bench.screen,
            reconstructor,
            plan,
            slots,
            clock,
            laser,
            stopping=remote.is_interrupting,
        )

        def publish(estimate: ShapeEstimate) -> None:
            """Send a figure to the other processes, with the events that follow from it."""
            shapes.put(pack_estimate(estimate))
            stated = statement_watch.check_statement(cycles.geometry_statement)
            for event in (stated, drift.check_estimate(estimate), *handle_vibrations(estimate)):
                if event is not None:
                    remote.send_event(event)
            if raw is not None:
                raw.keep_due_frames(estimate)

        def write_capture(estimate: ShapeEstimate, request: CaptureRequest) -> Path:
            """Write a requested set. Raises OSError."""
            if raw is None:
                raise OSError("the run has no folder")
            return raw.write_capture(estimate, request.turned_deg)

        remote.start_line_checks()
        remote.report_state("running", "first cycle")
        cycle_loop.keep_cycling(shape_cycle, remote, publish, clock, period_s, write_capture)


def _cycle_plan(config: Config, optics: OpticsConfig) -> cycle_plan.CyclePlan:
    """The patterns of the cycles."""
    pattern = optics.pattern
    return cycle_plan.CyclePlan(
        pattern_sequence.full_sequence(pattern),
        pattern_sequence.fringe_sequence(pattern),
        config.shape.frame_interval_s,
    )


def _make_cycles(
    spec: AcquisitionSpec, optics: OpticsConfig
) -> live_reconstructor.LiveReconstructor:
    """What makes figures of full and fringes-only cycles, with the geometry's uncertainty."""
    kept = None
    if spec.run_dir is not None:
        kept = spec.run_dir / run_geometry.GEOMETRY_COPY
    file = None
    if kept is not None and kept.exists():
        file = kept
    spread, source = spread_file.geometry_spread(optics, file)
    return live_reconstructor.LiveReconstructor(
        optics,
        spec.config.shape.bin_px,
        spread=spread,
        known_by=spread_file.find_known_by(optics, file),
        source=source,
    )


def _make_reconstructor(
    spec: AcquisitionSpec,
    optics: OpticsConfig,
    plan: cycle_plan.CyclePlan,
    cycles: live_reconstructor.LiveReconstructor,
) -> tuple[cycle.Reconstructor, cycle_plan.CyclePlan, Callable[[], float]]:
    """The reconstructor of the figures, the patterns that it needs, and the function of the
    interval between its figures.
    """
    shape = spec.config.shape
    if shape.mode != "track":
        return cycles, plan, lambda: shape.period_s

    # Tracking: one pattern stays on the screen, and each frame is a figure.
    exposure_s = 0.0
    if spec.truth is None:
        exposure_s = optical_bench.exposure_s(spec.config)
    tracker = LiveTracker(optics, cycles, shape.track_periods, shape.track_step_s, exposure_s)
    tracking_plan = replace(plan, standing=lambda: tracker.pattern)
    return tracker, tracking_plan, lambda: tracker.interval_factor / shape.track_rate_hz


def _make_twin_bench(
    address: ring.RingAddress,
    config: Config,
    plan: cycle_plan.CyclePlan,
    clock: WaitingClock,
    remote: Remote,
    stack: ExitStack,
) -> optical_bench.OpticalBench:
    """Camera and screen at the twin's mirror, once its bench has published the film's position."""
    truth = stack.enter_context(closing(TwinTruth(address)))
    while not truth.known and not remote.stop:
        remote.take_commands(_TRUTH_POLL_S)
    optics = TwinOptics(config.optics, config.twin, truth, clock)
    if not remote.stop:
        _warm_up(config, plan, truth(), clock)
        optics.prepare()
    return optical_bench.emulated_bench(config, clock, optics)


def _warm_up(
    config: Config, plan: cycle_plan.CyclePlan, position: FilmPosition, clock: WaitingClock
) -> None:
    coarse = coarse_optics(config.optics)
    cycles = live_reconstructor.LiveReconstructor(coarse, config.shape.bin_px)
    warm_up(cycles, coarse, plan, position, clock)
    if config.shape.mode == "track":
        tracker = LiveTracker(
            coarse, cycles, config.optics.pattern.periods, config.shape.track_step_s
        )
        one = replace(plan, standing=lambda: tracker.pattern)
        warm_up(tracker, coarse, one, position, clock)


def _open_bench(
    bench: optical_bench.OpticalBench, config: Config, clock: WaitingClock, remote: Remote
) -> None:
    """Open camera and screen; retry until stopped if they are missing, while the hold continues."""
    failures = 0
    while not remote.stop:
        try:
            found = optical_bench.open_bench(bench, config, clock)
            if found.camera:
                remote.report_state("preparing", f"camera: {found.camera}")
            for line in (*found.measured, *found.problems):
                remote.report_state("preparing", line)
            return
        except LinkError as error:
            failures += 1
            remote.report_state("retrying", str(error))
        again_s = clock.now() + pause_s(failures)
        while not remote.stop and (remaining_s := again_s - clock.now()) > 0:
            remote.take_commands(remaining_s)


def _make_raw_frames(
    spec: AcquisitionSpec,
    optics: OpticsConfig,
    plan: cycle_plan.CyclePlan,
    stack: ExitStack,
    remote: Remote,
) -> raw_frames.RawFrames | None:
    """The keeper of raw frames, if the run has a folder."""
    if spec.run_dir is None:
        return None
    folder = spec.run_dir / "raw"
    recording = spec.config.recording
    raw = raw_frames.RawFrames(
        folder, optics, plan, recording, spec.frames, spec.telemetry, remote.send_event
    )
    return stack.enter_context(closing(raw))
