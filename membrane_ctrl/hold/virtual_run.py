"""A run in virtual time: the supervisor's own ticks on the twin behind its board, without processes
or waiting.

It lacks the latency of the link (a read is the plant's state at the tick, a write takes effect at
once), the processes and the deadlines. The board is the emulator's, with its watchdog, latches and
limits, on the plant's time. Its shapes come from the twin's truth, without frames.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache

import numpy as np

from firmware_iface import roles
from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.controller import controller, tick
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.supervisor import Supervisor, Wiring
from membrane_ctrl.metrology.figure.held_quantities import find_held_weights
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model import arrays, clock, errors, events, run_events, shape_estimate, telemetry
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.processes import ring
from membrane_ctrl.sim import virtual_bench
from membrane_ctrl.sim.figure_changes import FigureChange, list_figure_changes
from membrane_ctrl.sim.truth import Truth

Rings = Mapping[str, ring.RingWriter]
Alter = Callable[[float, roles.BenchReading], roles.BenchReading | None]
ShapeSource = Callable[[float], shape_estimate.ShapeEstimate | None]
# Change of sag of a cycle of rendered full-size frames at 50 Hz in typical weather: 0.007 µm
# (docs/explanation/control.md).
SAG_SIGMA_UM = 0.01
# Quadrature over the disc: exact for the terms times a change of the film
_RADII, _AZIMUTHS = 24, 48
EXPOSURES_S = 0.9  # first to last frame of that cycle, over which the laser's readings are averaged


@dataclass(frozen=True, slots=True)
class VirtualTick:
    """One tick: what went in, and what came out."""

    inputs: tick.TickInputs
    outputs: tick.TickOutputs

    @property
    def row(self) -> telemetry.TelemetryRow:
        """The tick's telemetry."""
        return self.outputs.row

    @property
    def events(self) -> tuple[events.Event, ...]:
        """The tick's events."""
        return self.outputs.events


@dataclass(frozen=True)
class VirtualClock(clock.RunClock):
    """The clock of a virtual run."""

    seconds: Callable[[], float]

    def now(self) -> float:
        """Seconds of the run."""
        return self.seconds()


class VirtualRun:
    """Steps the supervisor in virtual time, a tick a call.

    Parameters
    ----------
    config : Config
        As the controller gets it; rates of ticks and figures.
    bench : VirtualBench
        Plant, board, and their faults.
    sag_sensitivity : (terms,) array
        See `Controller`.
    shape : callable, optional
        Called with the time every `shape.period_s`; returns an estimate or None.
    alter : callable, optional
        Gets the time and the board's reading, returns what the controller reads.
    rings : mapping of str to RingWriter, optional
        Where to record the run: "telemetry", "inputs", "snapshots", "events" and "shapes".
    """

    def __init__(
        self,
        config: Config,
        bench: virtual_bench.VirtualBench,
        sag_sensitivity: arrays.FloatArray,
        shape: ShapeSource | None = None,
        alter: Alter | None = None,
        rings: Rings | None = None,
    ) -> None:
        self._bench = bench
        self._rings = rings or {}
        self._shape = shape
        self._alter = alter
        track = config.shape.mode == "track"
        if track:
            self._shape_period_s = 1 / config.shape.track_rate_hz
        else:
            self._shape_period_s = config.shape.period_s
        self._shape_due_s = 0.0
        self._period_s = 1.0 / config.loop.rate_hz
        self._steps = 0
        self._last_s = 0.0
        self.now_s = 0.0  # the run's clock
        self.finished: errors.Exit | None = None
        self.clock = VirtualClock(0.0, datetime.now(UTC), lambda: self.now_s)
        wiring = Wiring(
            _AtOnce(bench, self._alter_reading),
            telemetry=self._rings.get("telemetry"),
            events=self._rings.get("events"),
            inputs=self._rings.get("inputs"),
            snapshots=self._rings.get("snapshots"),
            shapes=self._newest_shape if shape else None,
            truth=self._record_truth,
        )
        self._controller = controller.Controller(
            config, sag_sensitivity, held_weights=find_held_weights(config)
        )
        self._supervisor = Supervisor(self._controller, wiring, self.clock, config.loop.rate_hz)
        bench.open()

    def run_tick(self, commands: tuple[Command, ...] = ()) -> VirtualTick | None:
        """Advance one period and run a tick; None if the control process does not run."""
        # The bench moves on, whether or not the program runs.
        self._steps += 1
        self.now_s = self._steps * self._period_s  # no sum, which would drift
        self._bench.advance(self._period_s)
        if self.finished is not None:
            return None
        if self._bench.wrong.stalled:
            self._supervisor.missed_ticks += 1
            return None
        for command in commands:
            self._supervisor.queue_command(command)
        # One tick, as late as the scenario wants it.
        dt_s = self.now_s - self._last_s
        late_s = 1e-3 * self._bench.wrong.late_ms + max(0.0, dt_s - 1.5 * self._period_s)
        inputs, outputs = virtual_bench.at_once(self._supervisor.tick(self.now_s, dt_s, late_s))
        self._last_s = self.now_s
        if outputs.finished is not None:
            self.finished = outputs.finished
            virtual_bench.at_once(self._supervisor.leave())
            self._bench.close()
        return VirtualTick(inputs, outputs)

    def record_event(self, event: events.Event) -> None:
        """Record an event, now."""
        self._supervisor.record_event(event)

    @property
    def exit_code(self) -> errors.Exit:
        """The exit code; `INTERRUPTED` while the run has not ended."""
        if self.finished is None:
            return errors.Exit.INTERRUPTED
        return self.finished

    @property
    def loop_config(self) -> LoopConfig:
        """The loop's present settings."""
        return self._controller.loop_config

    @property
    def pump_config(self) -> PumpConfig:
        """The pump's curve, as the loop uses it now."""
        return self._controller.pump_config

    def end_run(self) -> None:
        """Record the end of the run."""
        supervisor = self._supervisor
        self.record_event(
            run_events.Ended(
                self.exit_code.name.lower(),
                int(self.exit_code),
                supervisor.ticks,
                supervisor.missed_ticks,
            )
        )

    def _newest_shape(self) -> shape_estimate.ShapeEstimate | None:
        if self._shape is None or self.now_s < self._shape_due_s:
            return None
        self._shape_due_s += self._shape_period_s
        estimate = self._shape(self.now_s)
        if estimate is None or "shapes" not in self._rings:
            return estimate
        message = shape_estimate.pack_estimate(estimate)
        self._rings["shapes"].put(message)
        return shape_estimate.unpack_estimate(message)  # the record is then exact

    def _record_truth(self) -> tuple[float, float]:
        return self._bench.truth.displacement_um, self._bench.truth.laser_bias_um

    def _alter_reading(self, reading: roles.BenchReading) -> roles.BenchReading:
        if self._alter is None:
            return reading
        altered = self._alter(self.now_s, reading)
        if altered is None:
            raise roles.LinkError("no reading")
        return altered


class _AtOnce:
    """A virtual bench as the supervisor's `Bench`, which answers without waiting."""

    def __init__(
        self,
        bench: virtual_bench.VirtualBench,
        altered: Callable[[roles.BenchReading], roles.BenchReading],
    ) -> None:
        self._bench = bench
        self._altered = altered

    async def open(self) -> roles.BenchIdentity:
        return self._bench.open()

    async def read(self) -> roles.BenchReading:
        return self._altered(self._bench.read())

    async def write(self, command: roles.BenchCommand) -> None:
        self._bench.write(command)

    async def clear_faults(self, mask: int) -> None:
        self._bench.clear_faults(mask)

    def dead_guards(self) -> tuple[str, ...]:
        if not self._bench.wrong.dead_task:
            return ()
        return ("virtual task",)

    def link_state(self) -> roles.LinkState:
        return roles.NO_LINK_STATE

    async def close(self) -> None:
        self._bench.close()


class TruthShape:
    """A `ShapeSource` from the twin's truth: what a cycle would report, without rendering frames.

    Equal seeds give equal shapes.

    `sag_change_sigma_um` is the standard deviation of a cycle's sag, larger for a bench whose
    frames are worse than rendered ones.
    """

    def __init__(
        self,
        bench: virtual_bench.VirtualBench,
        config: Config,
        seed: int,
        sag_change_sigma_um: float = SAG_SIGMA_UM,
    ) -> None:
        self._bench = bench
        self._rng = np.random.default_rng(seed)
        self._projection = zernike_projection()
        self._sag_sigma_um = sag_change_sigma_um
        self._laser_sigma_um = config.twin.laser_noise_um / math.sqrt(
            max(1.0, EXPOSURES_S * config.loop.rate_hz)
        )
        self._covariance = sag_change_sigma_um**2 * np.outer(self._projection, self._projection)
        self._cycle = 0

    def _find_climate_change(self, truth: Truth) -> FloatArray:
        """Terms of the figure that the room's climate has changed, at the present sag."""
        terms_um: FloatArray = np.zeros(ZERNIKE_TERMS)
        for change, amount in list_figure_changes(truth):
            terms_um += amount * _find_terms(change)
        return terms_um

    def __call__(self, now_s: float) -> shape_estimate.ShapeEstimate | None:
        """One cycle; None while the camera is lost."""
        wrong = self._bench.wrong
        if wrong.camera_lost:
            return None
        # The true sag with the noise of a cycle, and the laser as the mean over the exposures
        self._cycle += 1
        truth = self._bench.plant.truth()
        sag_noise, laser_noise = self._rng.standard_normal(2).tolist()
        sag_um = 1e3 * truth.sag_mm + wrong.camera_offset_um + self._sag_sigma_um * sag_noise
        laser_um = truth.displacement_um + truth.laser_bias_um + wrong.laser_offset_um
        blind = wrong.no_light or truth.laser_lost > 0
        return shape_estimate.ShapeEstimate(
            time_s=now_s,
            kind="fringes",
            coeffs_um=sag_um * self._projection + self._find_climate_change(truth),
            hencky_um=0.0,
            covariance_um2=self._covariance,
            sag_um=sag_um,
            sag_change_sigma_um=self._sag_sigma_um,
            displacement_um=math.nan if blind else laser_um + self._laser_sigma_um * laser_noise,
            slope_residual_urad=1.0,
            valid_fraction=1.0,
            modulation_median_adu=80.0,
            saturated_fraction=0.0,
            verdict="ok",
            cycle=self._cycle,
        )


@cache
def _find_terms(change: FigureChange) -> FloatArray:
    """Terms (terms,) of a change of the film: means over the disc of height times term."""
    # Terms are orthonormal over the disc: each is the mean of height times term. Gauss nodes in
    # radius squared and even azimuths make that mean exact for polynomials
    nodes, weights = np.polynomial.legendre.leggauss(_RADII)
    radius = np.sqrt((nodes + 1) / 2)
    angle = 2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    x = np.outer(radius, np.cos(angle)).ravel()
    y = np.outer(radius, np.sin(angle)).ravel()
    height_um = np.polynomial.polynomial.polyval2d(x, y, np.array(change.poly_um))
    mean = np.repeat(weights / 2, _AZIMUTHS) / _AZIMUTHS
    return np.asarray(zernike.evaluate_terms(x, y) @ (mean * height_um))
