"""A bench whose physics share no code and no assumption with `membrane_ctrl.sim`.

Film: tension and stretch, p = a w + b w^3. Gas: ideal, isothermal, its volume proportional to the
sag, solved by Newton's method. Leak: an orifice, its flow proportional to the root of the pressure.
Weather: 1/f pressure noise, gusts, and the cycles of an air conditioner. Pump: any curve, then a
dead time and a lag.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig, ShapeConfig
from membrane_ctrl.sim.virtual_bench import VirtualBench

STEP_S = 0.01
_SAG_UM, _PRESSURE_PA, _AMBIENT_PA, _AIR_K = 37_100.0, 600.0, 98_400.0, 295.0
_TENSION_SHARE = 0.4  # of the pressure at the working point
_WEATHER_S, _WEATHER_STEP_S = 7200.0, 0.05

Curve = Callable[[float], float]  # share of the full flow against the command


def _beyond(dead: float, shape: Curve) -> Curve:
    """Nothing up to `dead`, from there the shape."""
    return lambda d: shape((d - dead) / (1 - dead)) if d > dead else 0.0


def _pwm(d: float) -> float:
    duty = math.floor(255 * d) / 255
    return duty if duty >= 0.12 else 0.0


CURVES: dict[str, Curve] = {
    "straight": _beyond(0.10, lambda x: x),
    "quadratic": _beyond(0.15, lambda x: x * x),
    "root": _beyond(0.05, math.sqrt),
    "s-shaped": _beyond(0.05, lambda x: x * x * (3 - 2 * x)),
    "dead zone": _beyond(0.30, lambda x: x),
    "hysteretic": _beyond(0.08, lambda x: 0.7 * x + 0.3 * x * x),
    "pwm": _pwm,
    "top unreachable": lambda d: min(d, 0.7) / 0.7,
    "bottom unreachable": lambda d: max(d, 0.12) if d > 0 else 0.0,
}


@dataclass
class ForeignPump:
    """A curve, play about it, stiction, dead time and lag.

    Attributes
    ----------
    full_um_per_s : float
        Flow at full command.
    start, stall : float
        Commands from which a standing pump starts, and below which a running one stops.
    play : float
        Half of the hysteresis, in command.
    """

    shape: str = "straight"
    full_um_per_s: float = 5.3
    delay_s: float = 0.1
    lag_s: float = 0.1
    start: float = 0.0
    stall: float = 0.0
    play: float = 0.0
    _drive: float = 0.0
    _runs: bool = False
    _flow: float = 0.0
    _tube: deque[float] = field(default_factory=deque)

    def settled(self, command: float, drive: float = math.nan) -> float:
        """Flow of a running pump that reached a command from below, or stands at a drive."""
        at = max(0.0, command - self.play) if math.isnan(drive) else drive
        return self.full_um_per_s * CURVES[self.shape](at) / CURVES[self.shape](1.0)

    def balance(self, flow_um_per_s: float) -> None:
        """Deliver this flow now, whatever the command was."""
        self._drive = next(
            (d for d in np.linspace(0, 1, 2001) if self.settled(0, d) >= flow_um_per_s), 1.0
        )
        self._runs = True
        self._flow = flow_um_per_s
        self._tube = deque([flow_um_per_s] * round(self.delay_s / STEP_S))

    def step(self, command: float) -> float:
        """Flow that arrives in this step."""
        self._runs = command > 0 and command >= (self.stall if self._runs else self.start)
        self._drive = (
            min(max(self._drive, command - self.play), command + self.play) if command > 0 else 0.0
        )
        self._tube.append(self.settled(0.0, max(self._drive, 0.0)) if self._runs else 0.0)
        self._flow += (self._tube.popleft() - self._flow) * -math.expm1(-STEP_S / self.lag_s)
        return self._flow


@dataclass(frozen=True)
class ForeignTruth:
    """The state, under the names that a bench gives."""

    displacement_um: float
    gauge_pressure_pa: float
    ambient_pressure_pa: float
    air_temperature_c: float
    laser_bias_um: float = 0.0


class ForeignPlant:
    """A bench of the second world, with the methods of `sim.plant.Plant`."""

    def __init__(
        self,
        pump: ForeignPump,
        seed: int = 1,
        weather: float = 1.0,
        leak_um_per_s: float = 1.24,
        gusts: bool = False,
        laser_um: float = 1.0,
        barometer: bool = True,
        tension_share: float = _TENSION_SHARE,
    ) -> None:
        self._tension = tension_share * _PRESSURE_PA / _SAG_UM
        self._stretch = (1.0 - tension_share) * _PRESSURE_PA / _SAG_UM**3
        self.pump, self._leak_um_per_s, self._laser_um = pump, leak_um_per_s, laser_um
        self._barometer = barometer
        weather_rng, self._rng = np.random.default_rng(seed).spawn(2)
        self._ambient, self._air = _weather(weather, gusts, weather_rng)
        self._steps = self._samples = 0
        self._rest = 0.0
        self._command = self._vent = 0.0
        self._sag_um = _SAG_UM - 5.0
        self._gas = self._pressure(0) * self._sag_um / self._air[0]
        pump.balance(leak_um_per_s)

    def lower(self, sag_um: float) -> None:
        """Take gas out until the film has this sag, with the pump at rest."""
        self._sag_um = sag_um
        self._gas = self._pressure(0) * sag_um / self._air[0]
        self.pump.step(0.0)

    @property
    def time_s(self) -> float:
        return self._steps * STEP_S

    weather_s = _WEATHER_S

    def undisturbed_um(self) -> np.ndarray:
        """The centre's displacement by the weather alone, every 50 ms: the first gas, no pump, no
        leak.
        """
        sag = np.full_like(self._ambient, _SAG_UM)
        for _ in range(4):
            total = self._ambient + sag * (self._tension + self._stretch * sag**2)
            sag -= (total * sag - self._gas * self._air) / (
                total + (self._tension + 3 * self._stretch * sag**2) * sag
            )
        return sag - _SAG_UM

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        self._command, self._vent = pump_fraction, vent_fraction

    def advance(self, duration_s: float) -> None:
        due = self._rest + duration_s / STEP_S
        steps = math.floor(due + 1e-6)
        self._rest = due - steps
        for _ in range(steps):
            self._step()

    def _step(self) -> None:
        gauge_pa = self._gauge()
        out = self._leak_um_per_s * math.sqrt(max(gauge_pa, 0.0) / _PRESSURE_PA) + 90.0 * self._vent
        # a flow of 1 µm/s moves the centre by 1 µm/s at the working point
        per_um = (_AMBIENT_PA + _PRESSURE_PA + self._stiffness(_SAG_UM) * _SAG_UM) / _AIR_K
        self._gas += per_um * (self.pump.step(self._command) - out) * STEP_S
        self._steps += 1
        i = min(int(self.time_s / _WEATHER_STEP_S), self._ambient.size - 1)
        for _ in range(2):
            total_pa = self._ambient[i] + self._gauge()
            miss = total_pa * self._sag_um - self._gas * self._air[i]
            self._sag_um -= miss / (total_pa + self._stiffness(self._sag_um) * self._sag_um)

    def truth(self) -> ForeignTruth:
        i = min(int(self.time_s / _WEATHER_STEP_S), self._ambient.size - 1)
        return ForeignTruth(
            self._sag_um - _SAG_UM,
            self._gauge(),
            float(self._ambient[i]),
            float(self._air[i]) - 273.15,
        )

    def sample(self) -> BoardSample:
        return self.sample_of(self.truth())

    def sample_of(self, truth: ForeignTruth) -> BoardSample:
        self._samples += 1
        laser, gauge, ambient, air = self._rng.standard_normal(4).tolist()
        return BoardSample(
            displacement_um=round(truth.displacement_um + self._laser_um * laser, 1),
            displacement_quality=0,
            gauge_pressure_pa=truth.gauge_pressure_pa + 0.5 * gauge,
            ambient_pressure_pa=truth.ambient_pressure_pa + 0.1 * ambient
            if self._barometer
            else math.nan,
            air_temperature_c=truth.air_temperature_c + 0.004 * air
            if self._barometer
            else math.nan,
            gas_temperature_c=math.nan,
            sample_counter=self._samples,
            device_time_s=self.time_s,
        )

    def _gauge(self) -> float:
        return self._sag_um * (self._tension + self._stretch * self._sag_um**2)

    def _pressure(self, i: int) -> float:
        return float(self._ambient[i]) + self._gauge()

    def _stiffness(self, sag_um: float) -> float:
        return self._tension + 3 * self._stretch * sag_um**2


def _weather(
    strength: float, gusts: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Air pressure in Pa (1/f below 1 Hz, gusts) and the gas's temperature in K, every 50 ms."""
    steps = round(_WEATHER_S / _WEATHER_STEP_S)
    f = np.fft.rfftfreq(steps, _WEATHER_STEP_S)
    shape = np.where(f > 0, 1 / np.sqrt(np.maximum(f, f[1]) * (1 + f**2)), 0.0)
    noise = np.fft.irfft(
        shape * (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)), steps
    )
    pressure = _AMBIENT_PA + strength * noise / noise.std()
    time_s = np.arange(steps) * _WEATHER_STEP_S
    if gusts:
        for at_s in np.cumsum(rng.exponential(40.0, round(_WEATHER_S / 40.0))):
            since = (time_s - at_s) / rng.uniform(1.5, 5.0)
            pressure += (
                rng.normal(0.0, 4.0) * np.maximum(since, 0.0) * np.exp(1 - np.maximum(since, 0.0))
            )
    period_s = rng.uniform(600.0, 1200.0)
    cycle = np.sin(2 * np.pi * time_s / period_s + rng.uniform(0, 6.28))
    return pressure, _AIR_K + 0.05 * strength * np.tanh(3 * cycle)


def foreign_bench(plant: ForeignPlant) -> VirtualBench:
    """The plant behind the board in virtual time."""
    return VirtualBench(plant)  # type: ignore[arg-type]  # it has the methods


def foreign_config(**loop: float) -> Config:
    """What somebody knows who knows nothing: the defaults."""
    return Config(
        loop=LoopConfig.model_validate({"flow_max_um_per_s": 5.3, **loop}),
        pump=PumpConfig(),
        shape=ShapeConfig(enabled=False),
    )
