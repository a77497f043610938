"""A run in virtual time: the same controller on the twin behind its board, without processes, sockets or waiting.

What a run has and this has not: the latency of the link (a read here is the plant's state at the tick, a write takes
effect at once) and the processes. A shape source, if given, is asked on its cycle's deadlines. The board is the
emulator's own, with its watchdog, latches and limits, on the plant's time.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from firmware_iface.roles import BenchCommand, BenchReading, LinkDownError, LinkError
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.commands import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.metrology.optics.hencky import zernike_projection
from membrane_ctrl.model import errors, shape_estimate, telemetry
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.events import Event
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual.bench import VirtualBench

ShapeSource = Callable[[float], shape_estimate.ShapeEstimate | None]
Alter = Callable[[float, BenchReading], BenchReading | None]


@dataclass(frozen=True, slots=True)
class VirtualTick:
    """One tick: what went in, and what came out."""

    inputs: TickInputs
    outputs: TickOutputs

    @property
    def row(self) -> telemetry.TelemetryRow:
        """For the record."""
        return self.outputs.row

    @property
    def events(self) -> tuple[Event, ...]:
        """For the record."""
        return self.outputs.events


class VirtualRun:
    """Does for a controller in virtual time what the supervisor does in real time, a tick a call.

    Parameters
    ----------
    config : Config
        As for a run.
    bench : VirtualBench
        Plant, board, and what is wrong with them.
    sag_sensitivity : (36,) array
        See `Controller`.
    shape : callable, optional
        Called with the time every `shape.period_s`; returns an estimate or None.
    alter : callable, optional
        Stands between the board and the controller: gets the time and the reading, returns what is read.

    Attributes
    ----------
    now_s : float
        The run's clock.
    finished : Exit or None
        How the run ended.
    """

    def __init__(
        self,
        config: Config,
        bench: VirtualBench,
        sag_sensitivity: FloatArray,
        shape: ShapeSource | None = None,
        alter: Alter | None = None,
    ) -> None:
        self._bench = bench
        self._controller = Controller(config, sag_sensitivity)
        self._shape, self._alter = shape, alter
        self._shape_period_s = config.shape.period_s
        self._shape_due_s = 0.0
        self._period_s = 1.0 / config.loop.rate_hz
        self._steps = 0
        self._last_s = 0.0
        self._missed = 0
        self._link_up = True
        self._vent_fraction = 0.0
        self.now_s = 0.0
        self.finished: errors.Exit | None = None
        bench.open()

    def tick(self, commands: tuple[Command, ...] = ()) -> VirtualTick | None:
        """Let one period pass and run the tick at its end; None if the control process did not run."""
        self._steps += 1
        self.now_s = self._steps * self._period_s  # no sum, which would drift
        self._bench.advance(self._period_s)
        if self.finished is not None:
            return None
        if self._bench.wrong.stalled:
            self._missed += 1
            return None
        reading = self._read()
        if reading is not None and self._alter is not None:
            reading = self._alter(self.now_s, reading)
        inputs = self._inputs(reading, commands)
        outputs = self._controller.tick(inputs)
        self._last_s = self.now_s
        self._act(outputs)
        return VirtualTick(inputs, outputs)

    def _inputs(self, reading: BenchReading | None, commands: tuple[Command, ...]) -> TickInputs:
        wrong, truth = self._bench.wrong, self._bench.truth
        dt_s = self.now_s - self._last_s
        return TickInputs(
            now_s=self.now_s,
            dt_s=dt_s,
            reading=reading,
            lateness_ms=wrong.late_ms + 1e3 * max(0.0, dt_s - 1.5 * self._period_s),
            missed_ticks=self._missed,
            link_up=self._link_up,
            estimate=self._newest_shape(),
            commands=commands,
            dead_tasks=("virtual task",) if wrong.dead_task else (),
            truth_displacement_um=truth.displacement_um,
            truth_laser_bias_um=truth.laser_bias_um,
        )

    def _newest_shape(self) -> shape_estimate.ShapeEstimate | None:
        if self._shape is None or self.now_s < self._shape_due_s:
            return None
        self._shape_due_s += self._shape_period_s
        return self._shape(self.now_s)

    def _act(self, outputs: TickOutputs) -> None:
        self._vent_fraction = outputs.command.vent_fraction
        if outputs.clear_mask:
            self._try(lambda: self._bench.clear_faults(outputs.clear_mask))
        self._try(lambda: self._bench.write(outputs.command))
        if outputs.finished is not None:
            self.finished = outputs.finished
            self._try(lambda: self._bench.write(BenchCommand(0.0, self._vent_fraction)))
            self._bench.close()

    def _read(self) -> BenchReading | None:
        if not self._link_up:
            self._link_up = True
            self._try(self._bench.open)
        readings: list[BenchReading] = []
        self._try(lambda: readings.append(self._bench.read()))
        return readings[0] if readings else None

    def _try(self, ask: Callable[[], None]) -> None:
        """Ask the bench for something, unless the link is known to be down."""
        if not self._link_up:
            return
        try:
            ask()
        except LinkDownError:
            self._link_up = False
        except LinkError:
            pass  # one answer less: the age of the readings tells


def run_virtual(
    config: Config,
    plant: Plant,
    duration_s: float,
    sag_sensitivity: FloatArray,
    shape: ShapeSource | None = None,
    alter: Alter | None = None,
) -> Iterator[VirtualTick]:
    """Hold the twin for `duration_s` of its time, as fast as it goes.

    Parameters
    ----------
    config, sag_sensitivity, shape, alter
        See `VirtualRun`.
    plant : Plant
        The twin's physics.
    duration_s : float
        When the hold is asked to stop.

    Yields
    ------
    VirtualTick
        Until the controller says that the run is over.
    """
    run = VirtualRun(config, VirtualBench(plant), sag_sensitivity, shape, alter)
    commands: tuple[Command, ...] = (Command("hold", "virtual run"),)
    stop_at_s = duration_s
    while run.finished is None:
        if run.now_s + 1.0 / config.loop.rate_hz >= stop_at_s:
            commands, stop_at_s = (*commands, Command("stop", "duration")), float("inf")
        tick = run.tick(commands)
        commands = ()
        if tick is not None:
            yield tick


# Shapes made from the twin's truth: what a measurement cycle would say, without rendering a frame.
#
# For runs of days in virtual time and for the fault campaign; the real cycle on rendered frames is `virtual_camera`.


# Change of sag of a cycle of rendered full-size frames at 50 Hz in typical weather: 0.007 um (docs/control.md).
SAG_SIGMA_UM = 0.01
EXPOSURES_S = 0.9  # first to last frame of that cycle: over it the laser's readings are averaged


class TruthShape:
    """A `virtual_run.ShapeSource`; equal seeds give equal shapes.

    Parameters
    ----------
    bench : VirtualBench
        What is measured, and what is wrong with camera and laser.
    config : Config
        Of the run: noise and rate of the laser readings.
    seed : int
        Of the noise.
    sag_sigma_um : float
        Standard deviation of a cycle's sag; a bench whose frames are worse than rendered ones has more.
    """

    def __init__(self, bench: VirtualBench, config: Config, seed: int, sag_sigma_um: float = SAG_SIGMA_UM) -> None:
        self._bench = bench
        self._rng = np.random.default_rng(seed)
        self._projection = zernike_projection()
        self._sag_sigma_um = sag_sigma_um
        self._laser_sigma_um = config.twin.laser_noise_um / math.sqrt(max(1.0, EXPOSURES_S * config.loop.rate_hz))
        self._covariance = sag_sigma_um**2 * np.outer(self._projection, self._projection)
        self._cycle = 0

    def __call__(self, now_s: float) -> shape_estimate.ShapeEstimate | None:
        """One cycle; None while the camera is lost."""
        wrong = self._bench.wrong
        if wrong.camera_lost:
            return None
        self._cycle += 1
        truth = self._bench.plant.truth()
        sag_noise, laser_noise = self._rng.standard_normal(2).tolist()
        sag_um = 1e3 * truth.sag_mm + wrong.camera_offset_um + self._sag_sigma_um * sag_noise
        laser_um = truth.displacement_um + truth.laser_bias_um + wrong.laser_offset_um
        blind = wrong.no_light or truth.laser_lost > 0
        return shape_estimate.ShapeEstimate(
            time_s=now_s,
            kind="fringes",
            coeffs_um=sag_um * self._projection,
            hencky_um=0.0,
            covariance_um2=self._covariance,
            sag_um=sag_um,
            sag_sigma_um=self._sag_sigma_um,
            displacement_um=math.nan if blind else laser_um + self._laser_sigma_um * laser_noise,
            slope_residual_urad=1.0,
            valid_fraction=1.0,
            modulation_median_adu=80.0,
            saturated_fraction=0.0,
            verdict="ok",
            cycle=self._cycle,
        )
