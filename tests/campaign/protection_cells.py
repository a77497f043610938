"""Every process value and activity with every failure of a sensor: how far the true mirror goes,
and what stops it.

The faulty sensors stand between plant and board, or between plant and figures; the plant's true
state is judged. The film of odd seeds was stretched before it was inflated: its pressure is partly
linear in the sag.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from campaign_run import relay_about
from sensor_faults import Lie, Lying, LyingPlant, SensorFault, drift, offset, scaled, stuck

from membrane_ctrl.config.schema import (
    Config,
    EstimatorConfig,
    LoopConfig,
    PumpConfig,
    ShapeConfig,
    StatesConfig,
    TwinConfig,
)
from membrane_ctrl.control.experiments.spec import ExperimentKind, ExperimentSpec, PumpStep
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.duties import Activity, FilmSensor, ProcessValue
from membrane_ctrl.controller.protection import Failure
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Fault, Maintenance, Plausibility
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.virtual_bench import VirtualBench

RATE_HZ = 5.0
SAG_SIGMA_UM = 0.036
WARM_S = 60.0  # of hold before anything fails: the references of all comparisons are complete
LINEAR_SHARE = 0.3  # of the pressure of the other film
START_S = 300.0  # by which a hold must have begun
HOLDING_FLOW_UM_PER_S = 1.24  # of the twin's leak


class Undertaking(Enum):
    """What the hold does when the sensor fails: an activity, or one of the things tried in it."""

    INFLATE = "inflate"
    HOLD = "hold"
    SETPOINT = "hold, setpoint 40 µm up"
    GAINS = "hold, gains on trial"
    CURVE = "hold, pump curve on trial"
    PAUSE = "pause"
    MANUAL_UP = "manual, 5 µm/s"
    MANUAL_OFF = "manual, no flow"
    RELAY = "tune relay"
    STEPS = "tune steps"
    DOUBLETS = "tune doublets"
    MULTISINE = "tune multisine"
    PUMP_MAP = "tune pump_map"

    @property
    def activity(self) -> Activity:
        """Its row of the protection table."""
        word = self.value.split()[0].rstrip(",")
        return Activity(word)


# How far an undertaking itself moves the mirror up; displacement 0 of the optics is up to 12 µm
# above the start.
WAYS_UM = {Undertaking.INFLATE: 17.0, Undertaking.SETPOINT: 40.0}


@dataclass(frozen=True)
class SensorFailure:
    """A way in which a sensor of the film fails.

    Attributes
    ----------
    sensor : FilmSensor
    name : str
    kind : Failure or None
        By what its effect is bounded; None where the figure says so itself and only the cell
        counts.
    lie : callable or None
        The reading instead, as of a `SensorFault`; of optics, the sag.
    spoil : callable or None
        The figure instead, or None for a lost one; from the figure, seconds since the failure and a
        random generator.
    slow : bool
        Takes hours to show.
    """

    sensor: FilmSensor
    name: str
    kind: Failure
    lie: Lie | None = None
    spoil: Callable[[ShapeEstimate, float, np.random.Generator], ShapeEstimate | None] | None = None
    slow: bool = False

    @property
    def words(self) -> str:
        """Its name with the sensor's."""
        return f"{self.sensor.value} {self.name}"


def frozen_with_noise(noise: float, seed: int = 5) -> Lie:
    """It shows its last value with fresh noise."""
    rng = np.random.default_rng(seed)
    return lambda value, first, age_s: first + noise * float(rng.standard_normal())


def lost(value: float, first: float, age_s: float) -> float:
    """No value."""
    return math.nan


DRIFTS_UM_PER_S = (0.02, 0.05, 0.2, 1.0, 5.0)
_UM_PER_PA = 20.6


def _kind_of_drift(um_per_s: float) -> Failure:
    if um_per_s >= 1.0:
        return Failure.STEP
    return Failure.DRIFT if um_per_s >= 0.05 else Failure.DRIFT_WITHIN_CLIMATE


def _common(sensor: FilmSensor, unit: float, noise: float) -> Iterator[SensorFailure]:
    """Failures of any sensor of the film; `unit` is its unit in µm of the centre, `noise` that of a
    reading.
    """
    yield SensorFailure(sensor, "lost", Failure.LOST, lost)
    yield SensorFailure(sensor, "stuck", Failure.LOST, stuck)
    yield SensorFailure(sensor, "frozen with noise", Failure.STEP, frozen_with_noise(noise))
    for um_per_s in DRIFTS_UM_PER_S:
        for sign in (-1.0, 1.0):
            name = f"drifts by {sign * um_per_s:+g} µm/s"
            lie = drift(sign * um_per_s / unit)
            yield SensorFailure(sensor, name, _kind_of_drift(um_per_s), lie, slow=um_per_s <= 0.05)
    for step_um in (-150.0, -30.0, 30.0, 150.0):
        yield SensorFailure(
            sensor, f"steps by {step_um:+g} µm", Failure.STEP, offset(step_um / unit)
        )
    for share in (0.8, 1.25, -1.0):
        yield SensorFailure(sensor, f"scale {share:g}", Failure.STEP, scaled(share))


def _shift_time(
    shift_s: float,
) -> Callable[[ShapeEstimate, float, np.random.Generator], ShapeEstimate]:
    return lambda figure, age_s, rng: replace(figure, time_s=figure.time_s + shift_s)


FIGURE_FAILURES = (
    SensorFailure(
        FilmSensor.OPTICS,
        "sigma NaN",
        Failure.LOST,
        spoil=lambda f, t, r: replace(f, sag_change_sigma_um=math.nan),
    ),
    SensorFailure(
        FilmSensor.OPTICS,
        "sigma 1e3 µm",
        Failure.LOST,
        spoil=lambda f, t, r: replace(f, sag_change_sigma_um=1e3),
    ),
    SensorFailure(
        FilmSensor.OPTICS,
        "sigma 1e-9 µm",
        Failure.LOST,
        spoil=lambda f, t, r: replace(f, sag_change_sigma_um=1e-9),
    ),
    SensorFailure(
        FilmSensor.OPTICS,
        "sigma too small, 2 µm of noise",
        Failure.LOST,
        spoil=lambda f, t, r: replace(
            f, sag_um=f.sag_um + 2.0 * r.standard_normal(), sag_change_sigma_um=1e-3
        ),
    ),
    SensorFailure(FilmSensor.OPTICS, "times of the future", Failure.LOST, spoil=_shift_time(5.0)),
    SensorFailure(FilmSensor.OPTICS, "times 30 s late", Failure.LOST, spoil=_shift_time(-30.0)),
    SensorFailure(FilmSensor.OPTICS, "times 0.5 s late", Failure.LOST, spoil=_shift_time(-0.5)),
    SensorFailure(FilmSensor.OPTICS, "times NaN", Failure.LOST, spoil=_shift_time(math.nan)),
    SensorFailure(
        FilmSensor.OPTICS,
        "rejected",
        Failure.LOST,
        spoil=lambda f, t, r: replace(f, verdict="rejected"),
    ),
    SensorFailure(
        FilmSensor.OPTICS,
        "every third figure",
        Failure.LOST,
        spoil=lambda f, t, r: f if r.random() < 0.33 else None,
    ),
)
FAILURES: tuple[SensorFailure, ...] = (
    *_common(FilmSensor.LASER, 1.0, 1.0),
    *_common(FilmSensor.OPTICS, 1.0, SAG_SIGMA_UM),
    *FIGURE_FAILURES,
    *_common(FilmSensor.GAUGE, _UM_PER_PA, 0.5),
)
BY_WORDS = {failure.words: failure for failure in FAILURES}


@dataclass(frozen=True)
class Outcome:
    """Result of one cell.

    Attributes
    ----------
    off_um : float
        Largest distance of the true centre from where it should be, until the pump is taken off,
        with its sign.
    after_s : float
        Time from the failure to the first fault that is not cleared; NaN without one.
    fault : str
        That fault; empty without one.
    notice : str
        First notice or verdict after the failure; empty without one.
    notice_s : float
        Its time after the failure.
    notice_um : float
        Distance of the true centre then.
    pressure_max_pa : float
        Largest true gauge pressure.
    state : str
        State at the end.
    """

    off_um: float
    after_s: float
    fault: str
    notice: str
    notice_s: float
    notice_um: float
    pressure_max_pa: float
    state: str


class SpoiledFigures:
    """Figures from the truth, altered by the failures of the optics,
    and the laser's part of them.
    """

    def __init__(
        self, source: TruthShape, lying: Lying, failures: tuple[SensorFailure, ...], seed: int
    ) -> None:
        self._source, self._lying = source, lying
        self._spoils = [failure.spoil for failure in failures if failure.spoil is not None]
        self._rng = np.random.default_rng(seed)
        self.since_s = math.nan

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        figure = self._source(now_s)
        if figure is None:
            return None
        read = self._lying.read({"optics": figure.sag_um, "laser": figure.displacement_um}, now_s)
        if math.isnan(read["optics"]):
            return None
        altered: ShapeEstimate | None = replace(
            figure,
            sag_um=read["optics"],
            coeffs_um=read["optics"] * zernike_projection(),
            displacement_um=read["laser"],
        )
        if math.isfinite(self.since_s):
            for spoil in self._spoils:
                altered = (
                    None if altered is None else spoil(altered, now_s - self.since_s, self._rng)
                )
        return altered


def make_config(process_value: ProcessValue, seed: int) -> Config:
    """The configuration of a cell: default limits and times, a figure for every tick."""
    scenario = "quiet" if seed % 2 else "typical"
    by_optics = process_value is ProcessValue.OPTICS
    return Config(
        loop=LoopConfig(rate_hz=RATE_HZ),
        shape=ShapeConfig(mode="track", track_rate_hz=RATE_HZ),
        estimator=EstimatorConfig(process_value=process_value.value),
        states=StatesConfig(stay_after_trip=True),
        twin=TwinConfig(seed=seed, scenario=scenario, start_error_um=-5.0, laser=not by_optics),
    )


def _experiment(kind: ExperimentKind, flow_um_per_s: float) -> ExperimentSpec:
    if kind == "relay":
        return relay_about(flow_um_per_s)
    steps = (
        tuple(PumpStep(fraction=f, duration_s=3.0) for f in (0.5, 0.0, 0.7, 0.0))
        if kind == "pump_map"
        else ()
    )
    return ExperimentSpec(
        kind=kind, duration_s=60.0, holding_flow_um_per_s=flow_um_per_s, laser_um=1.0, steps=steps
    )


def _begin(undertaking: Undertaking, config: Config, flow_um_per_s: float) -> Command | None:
    """The command that begins an undertaking in a hold."""
    match undertaking:
        case Undertaking.INFLATE | Undertaking.HOLD:
            return None
        case Undertaking.SETPOINT:
            return Command("setpoint", "campaign", value=40.0)
        case Undertaking.GAINS:
            loop = config.loop.model_copy(update={"kp_per_s": 0.8, "ti_s": 5.0})
            return Command("gains", "campaign", value=300.0, loop=loop)
        case Undertaking.CURVE:
            pump = PumpConfig(
                curve_fraction=(0.1, 0.5, 1.0),
                curve_um_per_s=(0.0, 2.2, 5.0),
                start_fraction=0.22,
                stall_fraction=0.15,
            )
            return Command("gains", "campaign", value=300.0, loop=config.loop, pump=pump)
        case Undertaking.PAUSE:
            return Command("pause", "campaign")
        case Undertaking.MANUAL_UP:
            return Command("manual", "campaign", value=5.0)
        case Undertaking.MANUAL_OFF:
            return Command("manual", "campaign", value=0.0)
        case _:
            kind = undertaking.value.split()[1]
            return Command("tune", "campaign", experiment=_experiment(kind, flow_um_per_s))  # type: ignore[arg-type]


def _to_fault(failure: SensorFailure) -> SensorFault | None:
    if failure.lie is None:
        return None
    return SensorFault(failure.sensor.value, failure.name, failure.lie)


def run_cell(
    process_value: ProcessValue,
    undertaking: Undertaking,
    failures: tuple[SensorFailure, ...],
    seed: int,
    lasts_s: float,
) -> Outcome:
    """Run one cell; equal arguments give equal results."""
    config = make_config(process_value, seed)
    lying = Lying([fault for fault in map(_to_fault, failures) if fault is not None])
    bench = VirtualBench(LyingPlant(config.twin, config.pump, (), lying, LINEAR_SHARE * (seed % 2)))
    figures = SpoiledFigures(TruthShape(bench, config, seed, SAG_SIGMA_UM), lying, failures, seed)
    run = VirtualRun(config, bench, zernike_projection(), figures)
    first = (Command("hold", "campaign"),)
    awaited = State.INFLATE if undertaking is Undertaking.INFLATE else State.HOLD
    row = None
    while row is None or State(int(row.state)) != awaited:
        tick = run.run_tick(first)
        first = ()
        assert tick is not None
        row = tick.row
        assert run.now_s < START_S, f"{awaited.name} was not reached"
    if undertaking is not Undertaking.INFLATE:
        until_s = run.now_s + WARM_S
        while run.now_s < until_s:
            run.run_tick()
    begins = _begin(undertaking, config, HOLDING_FLOW_UM_PER_S)
    if begins is not None:
        run.run_tick((begins,))
        run.run_tick()
    lying.begin(run.now_s)
    figures.since_s = run.now_s
    return _watch(run, bench, run.now_s + lasts_s, WAYS_UM.get(undertaking, 0.0))


def _watch(run: VirtualRun, bench: VirtualBench, until_s: float, way_um: float) -> Outcome:
    """Follow the true mirror until the pump is off for good, or the time is over.

    `way_um` is how far the undertaking itself moves the mirror up.
    """
    since_s, start_um = run.now_s, bench.truth.displacement_um
    off_um, pressure_max_pa = 0.0, 0.0
    notice_s = notice_um = after_s = math.nan
    notice = fault = ""
    state = State.HOLD
    while run.finished is None and run.now_s < until_s:
        tick = run.run_tick()
        if tick is None:
            break
        row, truth = tick.row, bench.truth
        state = State(int(row.state))
        moved_um = truth.displacement_um - start_um
        away_um = moved_um - min(max(moved_um, 0.0), way_um)
        if abs(away_um) > abs(off_um):
            off_um = away_um
        pressure_max_pa = max(pressure_max_pa, truth.gauge_pressure_pa)
        for event in tick.events:
            match event:
                case Fault():
                    fault, after_s = event.name, run.now_s - since_s
                case Maintenance() if not notice:
                    notice, notice_s, notice_um = event.name, run.now_s - since_s, away_um
                case Plausibility() if not notice and event.opens_notice:
                    notice, notice_s, notice_um = (
                        f"{event.faulty} wrong",
                        run.now_s - since_s,
                        away_um,
                    )
        if state == State.FAULT and row.pump_fraction == 0.0:
            break
        if row.safe_level == SafeLevel.NONE and state != State.FAULT:
            fault, after_s = "", math.nan
    return Outcome(
        off_um, after_s, fault, notice, notice_s, notice_um, pressure_max_pa, state.name.lower()
    )
