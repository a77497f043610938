"""Laboratories drawn at random: actuators, mirrors, rooms and lasers with the flaws of real ones.

Film, gas and leak are those of `foreign_plant`, which shares no code with the twin. Here are the
actuators that need a model of their own, the room (doors, an air conditioner, a mount that bends
with its temperature), and the laser's flaws. A laboratory is drawn from its seed alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.config.schema import Config, ShapeConfig, leave_to_start
from tests.worlds.eleven_benches import FanPump, ForeignCamera, PeristalticPump, SupplyValve
from tests.worlds.foreign_plant import (
    CURVES,
    STEP_S,
    ForeignPlant,
    ForeignPump,
    ForeignTruth,
    foreign_config,
)

ACTUATORS = ("valve", "fan", "peristaltic", "diaphragm", "slow", "tight")
_CAMERA_HZ = 5.0
_FLICKER_MEMORIES_S = (0.3, 3.0, 30.0, 300.0)  # equal shares of variance: nearly 1/f
_MOUNT_LAG_S = 900.0
_GAP_S = 0.08  # of a laser that loses its light for a moment
_WEAK_RATIO, _STRONG_RATIO = 1.3, 20.0  # full flow over leak
_FULL_UM_PER_S = 1.6, 16.0  # a third to three times what the configuration states


@dataclass
class ThresholdPump(ForeignPump):
    """A diaphragm pump whose threshold follows the temperature of its room, and its own warmth."""

    per_k: float = 0.01
    warms: float = 0.02
    room_period_s: float = 900.0
    room_swing_k: float = 1.0
    _time_s: float = 0.0

    def step(self, command: float) -> float:
        self._time_s += STEP_S
        room_k = self.room_swing_k * math.sin(2 * math.pi * self._time_s / self.room_period_s)
        warmth = -math.expm1(-self._time_s / 300.0)
        shift = self.per_k * room_k + self.warms * warmth
        return super().step(command + shift if command > 0 else 0.0)


@dataclass(frozen=True)
class Room:
    """What moves the air and the mount.

    Attributes
    ----------
    weather : float
        Standard deviation of the slow pressure in Pa.
    gusts : bool
    doors_per_h, door_pa, door_hz : float
        Doors as infrasound: a swing of the pressure that rings down.
    cycle_k, cycle_s, cycle_pa : float
        Air conditioner: swing of the temperature, period, and step of the pressure while it runs.
    mount_um_per_k : float
        Bend of the laser's mount by the air's temperature, with a lag of a quarter of an hour.
    """

    weather: float
    gusts: bool
    doors_per_h: float = 0.0
    door_pa: float = 0.0
    door_hz: float = 1.0
    cycle_k: float = 0.0
    cycle_s: float = 900.0
    cycle_pa: float = 0.0
    mount_um_per_k: float = 0.0


@dataclass(frozen=True)
class LaserFlaws:
    """Noise of a laser beyond white noise.

    Attributes
    ----------
    flicker_um : float
        Standard deviation of its 1/f noise.
    step_um : float
        Quantisation; 0 for the 0.1 µm of the register.
    pace_s : float
        Interval of its own samples; a tick between two repeats the older one. 0: one a tick.
    lost_share : float
        Share of samples without a reading, one by one.
    gap_every_s : float
        Mean time between gaps of 80 ms; infinite for none.
    """

    flicker_um: float = 0.0
    step_um: float = 0.0
    pace_s: float = 0.0
    lost_share: float = 0.0
    gap_every_s: float = math.inf


class DrawnPlant(ForeignPlant):
    """A foreign plant in a room, read by a laser with flaws."""

    def __init__(
        self,
        pump: ForeignPump,
        seed: int,
        room: Room,
        flaws: LaserFlaws,
        leak_um_per_s: float,
        laser_um: float,
        barometer: bool,
    ) -> None:
        self._flaws = flaws
        self._bend_um_per_k = room.mount_um_per_k
        self._flaw_rng = np.random.default_rng([seed, 11])
        self._walks_um = np.zeros(len(_FLICKER_MEMORIES_S))
        self._read_s = 0.0
        self._gap_begins_s = self._draw_gap_s(0.0)
        self._paced: BoardSample | None = None
        super().__init__(pump, seed, room.weather, leak_um_per_s, room.gusts, laser_um, barometer)
        self._add_room(room, np.random.default_rng([seed, 12]))
        # the mirror begins in equilibrium with the room's first moment
        self._gas = self._pressure(0) * self._sag_um / self._air[0]
        self._mount_k = float(self._air[0])
        self._mount_zero_k = self._mount_k

    def _add_room(self, room: Room, rng: np.random.Generator) -> None:
        """Add doors and the air conditioner to pressure and temperature."""
        time_s = np.linspace(0.0, self.weather_s, self._ambient.size, endpoint=False)
        if room.doors_per_h:
            count = rng.poisson(room.doors_per_h * self.weather_s / 3600.0)
            for at_s in rng.uniform(0.0, self.weather_s, count):
                since_s = np.maximum(time_s - at_s, 0.0)
                swing = np.sin(2 * np.pi * room.door_hz * since_s)
                ring = swing * np.exp(-since_s * room.door_hz / 2.0)
                self._ambient += rng.choice((-1.0, 1.0)) * room.door_pa * ring
        if room.cycle_k:
            phase = time_s / room.cycle_s + rng.uniform()
            runs = np.mod(phase, 1.0) < 0.4
            # the room follows the machine with a lag of a sixth of the period
            lag_steps = room.cycle_s / 6.0 / (time_s[1] - time_s[0])
            share = -math.expm1(-1.0 / lag_steps)
            follows = np.empty(time_s.size)
            value = 0.4
            for i, on in enumerate(runs.tolist()):
                value += (float(on) - value) * share
                follows[i] = value
            self._air += room.cycle_k * (follows - follows[0])
            fan = np.convolve(runs.astype(float), np.ones(40) / 40.0, mode="same")
            self._ambient += room.cycle_pa * fan

    def _draw_gap_s(self, now_s: float) -> float:
        if math.isinf(self._flaws.gap_every_s):
            return math.inf
        return now_s + float(self._flaw_rng.exponential(self._flaws.gap_every_s))

    def _step(self) -> None:
        super()._step()
        i = min(int(self.time_s / 0.05), self._air.size - 1)
        self._mount_k += (float(self._air[i]) - self._mount_k) * STEP_S / _MOUNT_LAG_S

    def sample_of(self, truth: ForeignTruth) -> BoardSample:
        """A sample of the board, as old as the laser's own pace makes it."""
        flaws, now_s = self._flaws, self.time_s
        if self._paced is not None and not self._is_due(now_s):
            return self._paced
        sample = super().sample_of(truth)
        um = sample.displacement_um + self._flicker(now_s - self._read_s)
        um += self._bend_um_per_k * (self._mount_k - self._mount_zero_k)
        if flaws.step_um:
            um = round(um / flaws.step_um) * flaws.step_um
        self._read_s = now_s
        lost = bool(self._flaw_rng.random() < flaws.lost_share)
        if now_s >= self._gap_begins_s:
            lost = True
            if now_s >= self._gap_begins_s + _GAP_S:
                self._gap_begins_s = self._draw_gap_s(now_s)
        if lost:
            sample = replace(sample, displacement_um=math.nan, displacement_quality=1)
        else:
            sample = replace(sample, displacement_um=um)
        self._paced = sample
        return sample

    def _is_due(self, now_s: float) -> bool:
        """Whether the laser has taken a sample since the last one that was read."""
        pace_s = self._flaws.pace_s
        if not pace_s:
            return True
        return math.floor(now_s / pace_s) > math.floor(self._read_s / pace_s)

    def _flicker(self, step_s: float) -> float:
        """The 1/f noise now: walks with memories a decade apart."""
        if not self._flaws.flicker_um:
            return 0.0
        part_um = self._flaws.flicker_um / math.sqrt(len(_FLICKER_MEMORIES_S))
        for number, memory_s in enumerate(_FLICKER_MEMORIES_S):
            kept = math.exp(-step_s / memory_s)
            push = part_um * math.sqrt(1.0 - kept * kept) * self._flaw_rng.standard_normal()
            self._walks_um[number] = kept * self._walks_um[number] + push
        return float(self._walks_um.sum())


@dataclass(frozen=True)
class DrawnLaboratory:
    """One laboratory, and what its configuration states.

    Attributes
    ----------
    seed : int
    actuator : str
        One of `ACTUATORS`.
    shape : str
        Curve of flow against command.
    full_um_per_s, delay_s, lag_s, start, stall, play : float
        As of `ForeignPump`.
    extra : dict
        Further attributes of the actuator.
    leak_um_per_s, laser_um, rate_hz : float
    barometer, camera : bool
    room : Room
    flaws : LaserFlaws
    """

    seed: int
    actuator: str
    shape: str
    full_um_per_s: float
    delay_s: float
    lag_s: float
    leak_um_per_s: float
    laser_um: float
    rate_hz: float
    barometer: bool
    camera: bool
    room: Room
    flaws: LaserFlaws
    start: float = 0.0
    stall: float = 0.0
    play: float = 0.0
    extra: dict[str, float] = field(default_factory=dict)

    @property
    def gusts(self) -> bool:
        return self.room.gusts

    def pump(self) -> ForeignPump:
        kinds: dict[str, type[ForeignPump]] = {
            "valve": SupplyValve,
            "fan": FanPump,
            "peristaltic": PeristalticPump,
            "diaphragm": ThresholdPump,
        }
        kind = kinds.get(self.actuator, ForeignPump)
        return kind(
            shape=self.shape,
            full_um_per_s=self.full_um_per_s,
            delay_s=self.delay_s,
            lag_s=self.lag_s,
            start=self.start,
            stall=self.stall,
            play=self.play,
            **self.extra,
        )

    def plant(self, weather_seed: int) -> DrawnPlant:
        """The laboratory in weather that no other one has."""
        return DrawnPlant(
            self.pump(),
            10 * self.seed + weather_seed,
            self.room,
            self.flaws,
            self.leak_um_per_s,
            self.laser_um,
            self.barometer,
        )

    def config(self) -> Config:
        """The defaults, with the rate and the sensors that the laboratory has."""
        config = foreign_config(
            rate_hz=self.rate_hz,
            feedforward_barometer=self.barometer,
            feedforward_temperature=self.barometer,
        )
        if self.camera:
            shape = ShapeConfig(mode="track", track_rate_hz=min(_CAMERA_HZ, self.rate_hz))
            config = config.model_copy(update={"shape": shape})
        return leave_to_start(config)

    def figures(self, plant: DrawnPlant) -> ForeignCamera | None:
        """The camera's figures of the plant, if there is a camera."""
        return ForeignCamera(plant, self.seed) if self.camera else None

    def describe(self) -> str:
        """The laboratory in one line of a table."""
        room, flaws = self.room, self.flaws
        parts = [
            f"{self.actuator}, {self.shape}",
            f"{self.full_um_per_s:.1f} against {self.leak_um_per_s:.1f} µm/s",
            f"{self.delay_s:.2f} + {self.lag_s:.2f} s",
            f"laser {self.laser_um:.1f} µm",
            f"{self.rate_hz:g} Hz",
        ]
        named = {
            "barometer": self.barometer,
            "camera": self.camera,
            "gusty": room.gusts,
            "doors": room.doors_per_h > 0,
            "air conditioner": room.cycle_k > 0,
            "mount bends": room.mount_um_per_k > 0,
            "1/f noise": flaws.flicker_um > 0,
            f"steps of {flaws.step_um:.1f} µm": flaws.step_um > 0,
            "own pace": flaws.pace_s > 0,
            "lost samples": flaws.lost_share > 0,
            "gaps": math.isfinite(flaws.gap_every_s),
        }
        return ", ".join([*parts, *(name for name, there in named.items() if there)])


def draw_laboratory(seed: int) -> DrawnLaboratory:
    """A laboratory whose mirror can be held: actuator, mirror, room and laser at random."""
    rng = np.random.default_rng([20261127, seed])

    def draw_log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    def happens(probability: float) -> bool:
        return bool(rng.random() < probability)

    actuator = ACTUATORS[int(rng.integers(len(ACTUATORS)))]
    leak_um_per_s = draw_log(0.15, 0.5) if actuator == "tight" else draw_log(0.4, 4.0)
    ratio = draw_log(_WEAK_RATIO, _STRONG_RATIO)
    full_um_per_s = min(max(leak_um_per_s * ratio, _FULL_UM_PER_S[0]), _FULL_UM_PER_S[1])
    delay_s, lag_s = draw_log(0.03, 0.25), draw_log(0.05, 0.5)
    if actuator == "slow":
        delay_s, lag_s = draw_log(0.2, 1.0), draw_log(0.3, 1.5)
    shapes = {"valve": ("straight", "root", "s-shaped"), "fan": ("quadratic", "root")}
    shape = str(rng.choice(shapes.get(actuator, tuple(sorted(CURVES)))))
    play, start, stall = 0.0, 0.0, 0.0
    extra: dict[str, float] = {}
    if actuator == "valve":
        play = float(rng.uniform(0.005, 0.03))
        extra = {"falls_per_h": float(rng.uniform(0.05, 0.3))}
    elif actuator == "fan":
        extra = {"rotor_s": draw_log(0.2, 1.2)}
    elif actuator == "peristaltic":
        extra = {"depth": float(rng.uniform(0.1, 0.5))}
    elif actuator == "diaphragm":
        first = next(d for d in np.linspace(0, 1, 1001) if CURVES[shape](d) > 0)
        start = float(first) + float(rng.uniform(0.03, 0.15))
        stall = start - float(rng.uniform(0.01, 0.04))
        extra = {
            "per_k": float(rng.uniform(0.005, 0.03)),
            "warms": float(rng.uniform(0.0, 0.04)),
            "room_period_s": draw_log(600.0, 3600.0),
        }
    rate_hz = float(rng.choice([10.0, 20.0, 25.0, 50.0], p=[0.3, 0.3, 0.2, 0.2]))
    room = Room(weather=draw_log(0.3, 2.5), gusts=happens(0.25))
    if happens(0.3):
        room = replace(
            room,
            doors_per_h=draw_log(3.0, 30.0),
            door_pa=draw_log(2.0, 15.0),
            door_hz=draw_log(0.3, 4.0),
        )
    if happens(0.4):
        room = replace(
            room,
            cycle_k=draw_log(0.03, 0.3),
            cycle_s=draw_log(300.0, 1200.0),
            cycle_pa=draw_log(0.2, 3.0),
        )
    if happens(0.4):
        room = replace(room, mount_um_per_k=draw_log(0.1, 1.0))
    flaws = LaserFlaws(
        flicker_um=draw_log(0.02, 0.3) if happens(0.4) else 0.0,
        step_um=draw_log(0.1, 1.0) if happens(0.3) else 0.0,
        pace_s=float(rng.uniform(0.5, 1.3)) / rate_hz if happens(0.3) else 0.0,
        lost_share=draw_log(0.0005, 0.01) if happens(0.3) else 0.0,
        gap_every_s=draw_log(20.0, 300.0) if happens(0.4) else math.inf,
    )
    return DrawnLaboratory(
        seed=seed,
        actuator=actuator,
        shape=shape,
        full_um_per_s=full_um_per_s,
        delay_s=delay_s,
        lag_s=lag_s,
        leak_um_per_s=leak_um_per_s,
        laser_um=draw_log(0.1, 3.0),
        rate_hz=rate_hz,
        barometer=happens(0.6),
        camera=happens(0.3),
        room=room,
        flaws=flaws,
        start=start,
        stall=stall,
        play=play,
        extra=extra,
    )
