"""A simulated mirror held by the estimate of its centre, in virtual time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config.schema import EstimatorConfig, LoopConfig, PumpConfig, TwinConfig
from membrane_ctrl.control.centre import CentreFilter
from membrane_ctrl.control.centre_estimate import CentreReadings
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput
from membrane_ctrl.sim.bench_events import BenchEvent
from membrane_ctrl.sim.plant import Plant

LOCK_S = 5.0  # from when on the optics are used
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Optics:
    """A tracking camera: rate, age of a figure when it arrives, its noise."""

    rate_hz: float = 20.0
    age_s: float = 0.04
    sigma_um: float = 0.036


@dataclass(frozen=True)
class Sensors:
    """What a bench has."""

    laser: bool = True
    optics: Optics | None = Optics()
    weather: bool = True


@dataclass(frozen=True)
class HeldCentre:
    """A run, one row a tick."""

    time_s: Array
    true_um: Array
    estimated_um: Array
    sigma_um: Array
    flow_um_per_s: Array

    def after(self, time_s: float) -> Array:
        """True centre from a time on."""
        return self.true_um[self.time_s >= time_s]


def hold(
    sensors: Sensors,
    twin: TwinConfig,
    duration_s: float,
    events: Sequence[BenchEvent] = (),
    config: EstimatorConfig = EstimatorConfig(),  # noqa: B008 (frozen)
    loop: LoopConfig = LoopConfig(),  # noqa: B008
    true_pump: PumpConfig = PumpConfig(),  # noqa: B008 (frozen)
    shake: tuple[float, float] = (0.0, 0.0),
) -> HeldCentre:
    """Hold the simulated mirror on the estimate; a laser is there for the first 10 s, then if
    `sensors` says so.

    `shake`: amplitude in µm and frequency in Hz of a sine that laser and optics see besides the
    centre.
    """
    plant = Plant(twin, true_pump, events)
    controller, centre = InnerLoop(loop, PumpConfig(), config), CentreFilter(config, loop)
    dt_s = 1 / loop.rate_hz
    first = plant.sample().displacement_um
    leak_um_per_s = plant.truth().leak_um_per_s
    controller.start(first, leak_um_per_s)
    centre.start(first, leak_um_per_s, 0.0)
    rng = np.random.default_rng([twin.seed, 7])
    flow, rows = leak_um_per_s, []
    frames: deque[tuple[float, float, float]] = deque()
    next_frame_s = LOCK_S
    for _ in range(round(duration_s * loop.rate_hz)):
        now_s, sample, truth = plant.time_s, plant.sample(), plant.truth()
        sag = (math.nan, math.nan, math.nan)
        shaken_um = shake[0] * math.sin(2 * math.pi * shake[1] * now_s)
        optics = sensors.optics
        if optics is not None and now_s >= next_frame_s - 1e-9:
            next_frame_s += 1 / optics.rate_hz
            sag_um = 1e3 * truth.sag_mm + shaken_um + optics.sigma_um * rng.standard_normal()
            frames.append((now_s + optics.age_s, sag_um, now_s))
        while frames and frames[0][0] <= now_s + 1e-9:
            _, sag_um, taken_s = frames.popleft()
            assert optics is not None
            sag = (sag_um, optics.sigma_um, taken_s)
        laser = sample.displacement_um + shaken_um if sensors.laser or now_s < 10.0 else math.nan
        pressure_pa, air_c = sample.ambient_pressure_pa, sample.air_temperature_c
        if not sensors.weather:
            pressure_pa = air_c = math.nan
        estimate = centre.step(CentreReadings(now_s, flow, laser, pressure_pa, air_c, *sag), dt_s)
        given = LoopInput(0.0, estimate.mount_um, laser, pressure_pa, air_c, estimate)
        out = controller.step(given, dt_s)
        flow = out.flow_um_per_s
        plant.advance(0.005)
        plant.actuate(out.pump_fraction, 0.0)
        rows.append(
            (now_s, truth.displacement_um, estimate.um - estimate.mount_um, estimate.sigma_um, flow)
        )
        plant.advance(dt_s - 0.005)
    return HeldCentre(*np.array(rows).T)
