"""Every sensor, every way in which it can fail: what notices it, how soon, and what the true mirror
does.

The faulty sensors are between plant and board, so that the board's own limits are deceived as well;
the plant's true state is judged. `sensor_faults_page.py` writes the results.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from firmware_iface.emulators.pump_board import BoardSample
from firmware_iface.roles import BenchReading
from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig, TwinConfig
from membrane_ctrl.control.shape_code import ShapeCode
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.safety import TABLE
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model import events
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import SafeLevel, State, TelemetryRow
from membrane_ctrl.sim.bench_events import AmbientChange, BenchEvent
from membrane_ctrl.sim.film import NOMINAL_PRESSURE_PA
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.truth import Truth
from membrane_ctrl.sim.virtual_bench import VirtualBench

RATE_HZ = 10.0
REGISTER_MAX = 2e6  # a value that does not fit a register of the board is sent as no value
SETTLED_S = 240.0
NAMES = {float(rule.code): rule.name for rule in TABLE}
# Where a sensor's value is; the board's own read-backs are changed after it, the camera separately.
SAMPLED = {
    "laser": "displacement_um",
    "gauge": "gauge_pressure_pa",
    "barometer": "ambient_pressure_pa",
    "air thermometer": "air_temperature_c",
    "gas thermometer": "gas_temperature_c",
}
READ_BACK = {"pump read-back": "pump_fraction", "vent read-back": "vent_fraction"}
CAMERA = "camera"

# the value now, the value when the fault began, seconds since then: the reading
Lie = Callable[[float, float, float], float]


@dataclass(frozen=True)
class SensorFault:
    """One sensor, one failure.

    Attributes
    ----------
    sensor, failure : str
    lie : callable or None
        The reading instead; None for a swap.
    swapped_with : str
        The sensor whose value this one shows, and the other way round.
    lasts_s : float
        How long it is monitored.
    """

    sensor: str
    failure: str
    lie: Lie | None = None
    swapped_with: str = ""
    lasts_s: float = 900.0

    def read(
        self, values: dict[str, float], first: dict[str, float], age_s: float
    ) -> dict[str, float]:
        """All readings, from the truth."""
        if self.swapped_with:
            other = values.get(self.swapped_with, math.nan)
            return {**values, self.sensor: other, self.swapped_with: values[self.sensor]}
        assert self.lie is not None
        return {**values, self.sensor: self.lie(values[self.sensor], first[self.sensor], age_s)}


class Lying:
    """The present fault, and since when; shared by plant, read-backs and camera of one bench."""

    def __init__(self, faults: Sequence[SensorFault]) -> None:
        self._faults = faults
        self._since_s = math.nan
        self._first: dict[str, float] = {}

    def begin(self, now_s: float) -> None:
        """It sets in."""
        self._since_s = now_s

    def read(self, values: dict[str, float], now_s: float) -> dict[str, float]:
        """The readings instead of these."""
        if math.isnan(self._since_s):
            return values
        for name, value in values.items():
            self._first.setdefault(name, value)
        for fault in self._faults:
            if fault.sensor in values:
                values = fault.read(values, self._first, now_s - self._since_s)
        return values


class LyingPlant(Plant):
    """The twin, with sensors that lie.

    Parameters
    ----------
    twin, pump, events
        As of a `Plant`.
    lying : Lying
    linear : float
        Share of a film's tension that was there before it was inflated: its pressure is no longer
        w^3 alone.
    """

    def __init__(
        self,
        twin: TwinConfig,
        pump: PumpConfig,
        events: Sequence[BenchEvent],
        lying: Lying,
        linear: float = 0.0,
    ) -> None:
        super().__init__(twin, pump, events)
        self._lying, self._linear = lying, linear

    def truth(self) -> Truth:
        """The true state."""
        truth = super().truth()
        if self._linear == 0.0:
            return truth
        share = (truth.gauge_pressure_pa / NOMINAL_PRESSURE_PA) ** (1 / 3)
        tense_pa = NOMINAL_PRESSURE_PA * ((1 - self._linear) * share**3 + self._linear * share)
        return replace(truth, gauge_pressure_pa=tense_pa)

    def sample_of(self, truth: Truth) -> BoardSample:
        """The sensors' readings of it."""
        sample = super().sample_of(truth)
        values = {name: getattr(sample, field) for name, field in SAMPLED.items()}
        read = self._lying.read(values, truth.time_s)
        for name, value in read.items():
            if value != values[name]:
                sent = value if abs(value) < REGISTER_MAX else math.nan
                sample = replace(sample, **{SAMPLED[name]: sent})  # type: ignore[arg-type]
        return sample


class LyingCamera:
    """Shapes from the truth, seen by a camera that lies about the sag."""

    def __init__(self, source: TruthShape, lying: Lying) -> None:
        self._source, self._lying = source, lying

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        estimate = self._source(now_s)
        if estimate is None:
            return None
        sag_um = self._lying.read({CAMERA: estimate.sag_um}, now_s)[CAMERA]
        laser_um = self._lying.read({"laser": estimate.displacement_um}, now_s)["laser"]
        return replace(
            estimate,
            sag_um=sag_um,
            coeffs_um=sag_um * zernike_projection(),
            displacement_um=laser_um,
        )


def stuck(value: float, first: float, age_s: float) -> float:
    """The same to the last bit."""
    return first


def scaled(by: float) -> Lie:
    """Another unit, another gain, another sign."""
    return lambda value, first, age_s: by * value


def offset(by: float) -> Lie:
    """A zero that has moved."""
    return lambda value, first, age_s: value + by


def drift(per_s: float) -> Lie:
    """A zero that moves."""
    return lambda value, first, age_s: value + per_s * age_s


def blocked(noise: float, seed: int = 1) -> Lie:
    """It measures only noise: a kinked hose, a loose plug."""
    rng = np.random.default_rng(seed)
    return lambda value, first, age_s: first + noise * float(rng.standard_normal())


# Failures that take an hour to show.
SLOW = ("2 µm/min", "-0.05 µm/s", "-10 Pa an hour")
UNITS = (10.0, 0.1, 1000.0, 0.001)


def _failures(
    sensor: str,
    offsets: dict[str, float],
    drifts: dict[str, float],
    swaps: Sequence[str] = (),
    units: Sequence[float] = UNITS,
) -> Iterator[SensorFault]:
    yield SensorFault(sensor, "stuck", stuck)
    for words, per_s in drifts.items():
        yield SensorFault(
            sensor, f"drifts by {words}", drift(per_s), lasts_s=3600.0 if words in SLOW else 900.0
        )
    for by in (0.8, 1.25):
        yield SensorFault(sensor, f"scale {by}", scaled(by))
    for words, by in offsets.items():
        yield SensorFault(sensor, f"offset {words}", offset(by))
    for by in units:
        yield SensorFault(sensor, f"unit: times {by:g}", scaled(by))
    yield SensorFault(sensor, "sign", scaled(-1.0))
    for other in swaps:
        yield SensorFault(sensor, f"swapped with {other}", swapped_with=other)


FAULTS: tuple[SensorFault, ...] = (
    *_failures(
        "laser",
        {"+15 µm": 15.0, "+40 µm": 40.0, "-40 µm": -40.0, "-100 µm": -100.0},
        {"2 µm/min": 2 / 60, "-2 µm/s": -2.0, "-0.2 µm/s": -0.2, "-0.05 µm/s": -0.05},
        ("gauge", "barometer"),
    ),
    SensorFault("gauge", "shows only noise", blocked(0.5)),
    *_failures(
        "gauge",
        {"+5 Pa": 5.0, "-5 Pa": -5.0, "-50 Pa": -50.0},
        {"0.1 Pa/s": 0.1, "-0.1 Pa/s": -0.1, "-10 Pa an hour": -1 / 360},
        ("barometer",),
    ),
    *_failures(
        "barometer", {"+500 Pa": 500.0}, {"1 Pa/s": 1.0, "10 Pa/s": 10.0}, ("air thermometer",)
    ),
    *_failures(
        "air thermometer",
        {"+10 K": 10.0},
        {"1 K/min": 1 / 60, "-0.1 K/s": -0.1},
        ("gas thermometer",),
    ),
    *_failures("gas thermometer", {"+10 K": 10.0}, {"1 K/min": 1 / 60}, units=(10.0,)),
    *_failures(
        "pump read-back",
        {"+0.04": 0.04, "+0.1": 0.1},
        {"0.001/s": 0.001},
        ("vent read-back",),
        (100.0,),
    ),
    *_failures("vent read-back", {"+0.1": 0.1}, {"0.001/s": 0.001}, units=(100.0, 0.01)),
    *_failures(
        CAMERA,
        {"+8 µm": 8.0, "+30 µm": 30.0},
        {"2 µm/min": 2 / 60, "0.5 µm/s": 0.5},
        units=(1000.0, 0.001),
    ),
)
PAIRS: tuple[tuple[SensorFault, ...], ...] = (
    (SensorFault("gauge", "stuck", stuck), SensorFault("laser", "drifts by -2 µm/s", drift(-2.0))),
    (
        SensorFault("gauge", "shows only noise", blocked(0.5)),
        SensorFault("laser", "drifts by -2 µm/s", drift(-2.0)),
    ),
    (
        SensorFault("gauge", "shows only noise", blocked(0.5), lasts_s=3600.0),
        SensorFault("laser", "drifts by -0.5 µm/s", drift(-0.5), lasts_s=3600.0),
    ),
)


@dataclass(frozen=True)
class Story:
    """Result of one run.

    Attributes
    ----------
    noticed : str
        First rule or event after the fault began; empty: none.
    after_s : float
        How long after.
    ended_in : State
    pumped_um : float
        How far the film rose above its setpoint while the pump could run; a ramp does not count.
    astray_um : float
        Largest distance of the true film from its setpoint in `hold`.
    pressure_max_pa : float
        Largest true gauge pressure since then.
    """

    noticed: str
    after_s: float
    ended_in: State
    pumped_um: float
    astray_um: float
    pressure_max_pa: float


def run_faults(faults: Sequence[SensorFault], seed: int, camera: bool, from_start: bool) -> Story:
    """Run one story; equal arguments give equal results. Weather, moment and door are drawn from
    the seed.
    """
    chance = np.random.default_rng([seed, *f"{faults[0].sensor} {faults[0].failure}".encode()])
    config = Config(
        loop=LoopConfig(rate_hz=RATE_HZ),
        twin=TwinConfig(seed=seed, scenario=str(chance.choice(["quiet", "typical", "gusty"]))),  # type: ignore[arg-type]
    )
    begins_s = 0.0 if from_start else SETTLED_S + float(chance.uniform(0.0, 120.0))
    lasts_s = max(fault.lasts_s for fault in faults)
    door = AmbientChange(begins_s + float(chance.uniform(200.0, 400.0)), 20.0)
    moved_s = begins_s + float(chance.uniform(500.0, 700.0))
    lying = Lying(faults)
    bench = VirtualBench(LyingPlant(config.twin, config.pump, (door,), lying))
    shape = LyingCamera(TruthShape(bench, config, seed), lying) if camera else None
    run = VirtualRun(config, bench, zernike_projection(), shape, _read_back(lying))
    watch = _Watch(bench, begins_s)
    commands: tuple[Command, ...] = (Command("hold", "campaign"),)
    begun = False
    while run.finished is None and run.now_s < begins_s + lasts_s:
        if not begun and run.now_s >= begins_s:
            begun = True
            lying.begin(run.now_s)
        if run.now_s >= moved_s:
            moved_s = math.inf
            commands = (*commands, Command("setpoint", "campaign", value=30.0))
        tick = run.run_tick(commands)
        commands = ()
        if tick is not None:
            watch.look(tick.row, tick.events, run.now_s)
    return watch.story()


def _read_back(lying: Lying) -> Callable[[float, BenchReading], BenchReading]:
    def alter(now_s: float, reading: BenchReading) -> BenchReading:
        values = {name: getattr(reading, field) for name, field in READ_BACK.items()}
        read = lying.read(values, now_s)
        for name, value in read.items():
            reading = replace(reading, **{READ_BACK[name]: value})  # type: ignore[arg-type]
        return reading

    return alter


class _Watch:
    """Notes the first rule or notice, and how far the true film went."""

    def __init__(self, bench: VirtualBench, begins_s: float) -> None:
        self._bench, self._begins_s = bench, begins_s
        self._noticed, self._after_s = "", math.nan
        self._state, self._highest_um = State.STANDBY, -math.inf
        self._astray_um = self._pressure_pa = self._pumped_um = 0.0

    def look(self, row: TelemetryRow, tick_events: Sequence[events.Event], now_s: float) -> None:
        self._state = State(int(row.state))
        if now_s <= self._begins_s:
            return
        truth = self._bench.truth
        self._pressure_pa = max(self._pressure_pa, truth.gauge_pressure_pa)
        setpoint_um = row.target_um
        self._pumped_um = max(self._pumped_um, truth.displacement_um - max(setpoint_um, 0.0))
        if self._state == State.HOLD and row.safe_level == SafeLevel.NONE:
            off_um = truth.displacement_um - row.setpoint_um + row.trim_um
            self._astray_um = max(self._astray_um, abs(off_um))
        for name in filter(None, map(_speaks, tick_events)):
            if not self._noticed:
                self._noticed, self._after_s = name, now_s - self._begins_s

    def story(self) -> Story:
        return Story(
            self._noticed,
            self._after_s,
            self._state,
            self._pumped_um,
            self._astray_um,
            self._pressure_pa,
        )


def _speaks(event: events.Event) -> str:
    """The name of the rule or notice, if the event is one."""
    match event:
        case events.Fault():
            return event.name
        case events.Plausibility() if event.opens_notice:
            return f"sensors: {event.faulty}"
        case events.ShapeLoopState(code=ShapeCode.TRIM_LIMIT):
            return "shape: trim at its limit"
        case events.ShapeLoopState(code=ShapeCode.CAMERA_REPEATS):
            return "shape: the camera repeats"
        case events.Maintenance():
            return f"maintenance: {event.name}"
        case _:
            return ""
