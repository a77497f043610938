"""The acquisition's resources, opened and closed around its loop."""

import json
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from firmware_iface.roles import LinkError
from membrane_ctrl.acquisition import cycle, exposures, optical_bench, process, raw_frames
from membrane_ctrl.config.schema import Config, OpticsConfig, TwinConfig
from membrane_ctrl.geometry import file, spread_file
from membrane_ctrl.metrology.cycle import live_reconstructor
from membrane_ctrl.metrology.phase import pattern_sequence
from membrane_ctrl.metrology.tracking.live_tracker import LiveTracker
from membrane_ctrl.metrology.vibrations.mode_follower import Heard, Stethoscope
from membrane_ctrl.model import files, plain_json
from membrane_ctrl.model.clock import RunClock, pause_s
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.program import file_origin, remove_origin
from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate
from membrane_ctrl.model.state_tree import decode_state, encode_state
from membrane_ctrl.processes import child, frames, ring
from membrane_ctrl.run_files import run_folder
from membrane_ctrl.sim.optics.camera import FilmPosition, TwinOptics
from membrane_ctrl.sim.plant import Truth


class TwinTruth:
    """The simulated film's present position, from the truth ring of the bench; callable."""

    def __init__(self, address: ring.RingAddress) -> None:
        self._reader = ring.RingReader(address)

    def __call__(self) -> Truth:
        """Return the newest truth. Raises LinkError before the first."""
        message = self._reader.latest()
        if message is None:
            raise LinkError("twin camera: the simulated bench has not started")
        return Truth.unpack(message)

    @property
    def known(self) -> bool:
        """Whether there is any truth yet."""
        return self._reader.latest() is not None

    def close(self) -> None:
        """Detach."""
        self._reader.close()


# Runs every kernel of the cycle once, on a small sensor: a fresh machine compiles them here, for
# many seconds.


@dataclass(frozen=True, slots=True)
class _StandingFilm:
    """A film at its usual sag."""

    displacement_um: float
    sag_mm: float


# A real film's sag is unknown before the measurement; a metre of film at the usual pressure has
# this one
TYPICAL_FILM: FilmPosition = _StandingFilm(0.0, 37.1)

_SMALL_PX = 300  # still enough points for the fit of the terms, at a hundredth of the work


def small(optics: OpticsConfig) -> OpticsConfig:
    """The same view on a sensor with larger pixels."""
    camera = optics.camera
    larger = max(1, min(camera.width_px, camera.height_px) // _SMALL_PX)
    column_px, row_px = (
        (p + 0.5) / larger - 0.5 for p in camera.principal
    )  # pixel centres are at integers
    coarse = camera.model_copy(
        update={
            "width_px": camera.width_px // larger,
            "height_px": camera.height_px // larger,
            "pixel_um": camera.pixel_um * larger,
            "principal_px": (column_px, row_px),
        }
    )
    return optics.model_copy(update={"camera": coarse})


def warm_up(
    reconstructor: cycle.Reconstructor,
    optics: OpticsConfig,
    plan: cycle.CyclePlan,
    position: FilmPosition,
    clock: exposures.CycleClock,
) -> None:
    """Run a full cycle and two fringes-only cycles, with and without known motion, of a film at
    rest.

    `reconstructor` is a disposable one for `small(optics)`, and `optics` are those small ones.
    """
    bench = TwinOptics(optics, TwinConfig(), lambda: position, clock)
    # displacements that differ by more than noise trigger the kernels that correct the film's
    # motion
    still, moving = np.zeros(1), np.array([-10.0, 10.0])
    for full, reconstruct, motion_um in (
        (True, reconstructor.full, moving),
        (False, reconstructor.fringes, moving),
        (False, reconstructor.fringes, still),
    ):
        taken = []
        for pattern in plan.patterns(full):
            bench.screen.show(pattern)
            taken.append(bench.camera.grab().pixels)
        displacement_um = position.displacement_um + np.resize(motion_um, len(taken))
        reconstruct(taken, 0.1 * np.arange(len(taken), dtype=np.float64), displacement_um)


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


def run(spec: process.AcquisitionSpec, remote: process.Remote) -> None:
    """Prepare, then measure until stopped.

    Before the first cycle `processes.STOP` simply ends the process, as no resource needs care and a
    compiling kernel cannot check for it; afterwards it ends the cycle at its next exposure. Raises
    LinkError if no camera is configured, or its patterns do not fit on the screen.
    """
    remote.listen()  # the first report, which allows silence until all this is done
    remote.report("preparing", "rendering the first picture, compiling")
    config, clock = spec.config, WaitingClock(spec.clock)
    geometry = file.geometry_of_run(spec.run_dir, config)
    remote.tell(cycle.geometry_event(geometry))
    plan = _plan(config, geometry.optics)
    with ExitStack() as stack:
        if spec.truth is None:
            bench = optical_bench.configured_bench(config, clock)
            _warm_up(config, plan, TYPICAL_FILM, clock)
        else:
            bench = _twin_bench(spec.truth, config, plan, clock, remote, stack)
        signal.signal(child.STOP, lambda number, frame: remote.end())
        stack.callback(bench.close)
        _open(bench, config, clock, remote)
        if remote.stop:
            return
        reconstructor, plan, period_s = _reconstructor(spec, geometry.optics, plan)
        drift, hear = (
            cycle.LiveDrift(geometry, config.shape.bin_px),
            listener(config, spec.clock, spec.run_dir),
        )
        shapes = stack.enter_context(closing(ring.RingWriter(spec.shapes)))
        slots = stack.enter_context(closing(frames.FrameWriter(spec.frames)))
        stack.callback(
            bench.close
        )  # before the frame ring: a running exposure holds the pixels of a slot
        laser = stack.enter_context(
            closing(cycle.LaserHistory(spec.telemetry, config.loop.rate_hz))
        )
        raw = _raw_frames(spec, geometry.optics, plan, stack, remote)
        taking = cycle.ShapeCycle(
            bench.camera,
            bench.screen,
            reconstructor,
            plan,
            slots,
            clock,
            laser,
            stopping=remote.interrupts,
        )

        def publish(estimate: ShapeEstimate) -> None:
            shapes.put(pack_estimate(estimate))
            for notice in (drift.after(estimate), *hear(estimate)):
                if notice is not None:
                    remote.tell(notice)
            if raw is not None:
                raw.after(estimate)

        def keep(estimate: ShapeEstimate) -> Path:
            if raw is None:
                raise OSError("the run has no folder")
            return raw.capture(estimate)

        remote.prepared()
        remote.report("running", "first cycle")
        cycle.keep_cycling(taking, remote, publish, clock, period_s, keep)


_HEARD = "vibrations.json"  # in the run's folder
_HEARD_SCHEMA = "membrane-vibrations/1"
_HEARD_BYTES_MAX = 1 << 20  # usually 10 kB


def listener(
    config: Config, clock: RunClock, run_dir: Path | None
) -> Callable[[ShapeEstimate], list[Event]]:
    """What takes the figures and tells the mirror's vibrations.

    It goes on where the run's last acquisition ended, or that of the newest earlier run with the
    same devices in the folder of runs: a film that moved meanwhile is told as well. What it has
    heard is kept in the run's folder.
    """
    known = None if run_dir is None else _heard_before(config, run_dir)
    stethoscope = Stethoscope(config.pump.stroke_hz, clock.origin_utc.timestamp(), known)

    def hear(estimate: ShapeEstimate) -> list[Event]:
        told = stethoscope.after(estimate)
        if told and run_dir is not None:
            with suppress(OSError):  # a full disk: the recorder says so
                heard = json.loads(encode_state(stethoscope.heard))
                table = {**file_origin(_HEARD_SCHEMA), "heard": heard}
                text = plain_json.dumps_checked(table)
                files.write_text_atomic(run_dir / _HEARD, text + "\n")
        return told

    return hear


def _heard_before(config: Config, run_dir: Path) -> Heard | None:
    for path in sorted(run_dir.parent.glob(f"*/{_HEARD}"), reverse=True):
        run = path.parent
        if run.name > run_dir.name or _bench_name(run_folder.read_config(run, [])) != _bench_name(
            config
        ):
            continue
        with suppress(OSError, ValueError, RecursionError):  # damaged: take an older one
            heard = _read_heard(path)
            # what another run has reported, this one has not
            return heard if run == run_dir else replace(heard, said=[])
    return None


def _read_heard(path: Path) -> Heard:
    """Read what an acquisition has heard. Raises OSError; ValueError for a damaged file."""
    table = plain_json.loads(files.read_text(path, _HEARD_BYTES_MAX))
    if not isinstance(table, dict) or not plain_json.take_checksum(table):
        raise ValueError(f"{path}: damaged")
    remove_origin(table, _HEARD_SCHEMA)
    return decode_state(json.dumps(table.get("heard")).encode(), Heard, _HEARD_BYTES_MAX)


def _bench_name(config: Config) -> str:
    return "" if config.devices is None else config.devices.name


def _plan(config: Config, optics: OpticsConfig) -> cycle.CyclePlan:
    """The patterns of the cycles."""
    pattern = optics.pattern
    return cycle.CyclePlan(
        pattern_sequence.full_sequence(pattern),
        pattern_sequence.fringe_sequence(pattern),
        config.shape.frame_interval_s,
    )


def _reconstructor(
    spec: process.AcquisitionSpec, optics: OpticsConfig, plan: cycle.CyclePlan
) -> tuple[cycle.Reconstructor, cycle.CyclePlan, Callable[[], float]]:
    """What makes figures of the frames, the patterns it needs, and the interval between its
    figures.

    The figures have their covariance if the uncertainty of the geometry is stated.
    """
    shape = spec.config.shape
    kept = None if spec.run_dir is None else spec.run_dir / file.KEPT
    spread, _ = spread_file.spread_of(optics, kept if kept is not None and kept.exists() else None)
    cycles = live_reconstructor.LiveReconstructor(optics, shape.bin_px, spread=spread)
    if shape.mode == "cycle":
        return cycles, plan, lambda: shape.period_s
    exposure_s = optical_bench.exposure_s(spec.config) if spec.truth is None else 0.0
    tracker = LiveTracker(optics, cycles, shape.track_periods, shape.track_step_s, exposure_s)
    return (
        tracker,
        replace(plan, standing=lambda: tracker.pattern),
        lambda: tracker.slower / shape.track_rate_hz,
    )


def _twin_bench(
    address: ring.RingAddress,
    config: Config,
    plan: cycle.CyclePlan,
    clock: WaitingClock,
    remote: process.Remote,
    stack: ExitStack,
) -> optical_bench.OpticalBench:
    """Camera and screen at the twin's mirror, once its bench has published the film's position."""
    truth = stack.enter_context(closing(TwinTruth(address)))
    while not truth.known and not remote.stop:
        remote.listen(_TRUTH_LOOK_S)
    optics = TwinOptics(config.optics, config.twin, truth, clock)
    if not remote.stop:
        _warm_up(config, plan, truth(), clock)
        optics.prepare()
    return optical_bench.emulated_bench(config, clock, optics)


def _warm_up(
    config: Config, plan: cycle.CyclePlan, position: FilmPosition, clock: WaitingClock
) -> None:
    coarse = small(config.optics)
    cycles = live_reconstructor.LiveReconstructor(coarse, config.shape.bin_px)
    warm_up(cycles, coarse, plan, position, clock)
    if config.shape.mode == "track":
        tracker = LiveTracker(
            coarse, cycles, config.optics.pattern.periods, config.shape.track_step_s
        )
        one = replace(plan, standing=lambda: tracker.pattern)
        warm_up(tracker, coarse, one, position, clock)


def _open(
    bench: optical_bench.OpticalBench, config: Config, clock: WaitingClock, remote: process.Remote
) -> None:
    """Open camera and screen; retry until stopped if they are missing, while the hold continues."""
    failures = 0
    while not remote.stop:
        try:
            found = optical_bench.open_bench(bench, config, clock)
            who = (f"camera: {found.camera}",) if found.camera else ()
            for line in (*who, *found.measured, *found.problems):
                remote.report("preparing", line)
            return
        except LinkError as error:
            failures += 1
            remote.report("retrying", str(error))
        again_s = clock.now() + pause_s(failures)
        while not remote.stop and (remaining_s := again_s - clock.now()) > 0:
            remote.listen(remaining_s)


def _raw_frames(
    spec: process.AcquisitionSpec,
    optics: OpticsConfig,
    plan: cycle.CyclePlan,
    stack: ExitStack,
    remote: process.Remote,
) -> raw_frames.RawFrames | None:
    """The keeper of raw frames, if the run has a folder."""
    if spec.run_dir is None:
        return None
    folder, recording = spec.run_dir / "raw", spec.config.recording
    raw = raw_frames.RawFrames(
        folder, optics, plan, recording, spec.frames, spec.telemetry, remote.tell
    )
    return stack.enter_context(closing(raw))
