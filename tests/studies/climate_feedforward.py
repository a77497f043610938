"""Does feed-forward of the measured climate to the pump hold the centre better?

At constant gas an excess strain of the film moves the centre by `CENTRE_UM_PER_PPM`
(docs/explanation/climate.md, eq. 2). The flow that cancels it is added to the loop's feed-forward:
from the rate of the measured strains, behind a lag, bounded, without a step when a sensor is lost
or returns. For comparison also from the true strain. All runs of a seed have the same noise.

`python -m tests.studies.climate_feedforward hvac 1.0 1 2 3` prints a line for each seed: standard
deviation and largest deviation of the true centre without it, and what each source changes.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import Config, LimitsConfig, LoopConfig, TwinConfig
from membrane_ctrl.control.feedforward import FeedForward
from membrane_ctrl.control.filters import LagRate
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

RATE_HZ = 4.0
SETTLED_S = 300.0
# 1.7 % of the 3.45 µm of a film at constant pressure
CENTRE_UM_PER_PPM = 0.061
# A thermometer's noise of 0.05 K must not move the pump: 0.05 K are 0.05 µm
LAG_S = 60.0
# Ten times what the air conditioner needs
MOST_UM_PER_S = 0.05
Source = Callable[[], float]  # the present excess strain, 1e-6; NaN without


class ClimateFeedForward(FeedForward):
    """The loop's feed-forward with that of the climate."""

    def __init__(self, given: FeedForward, loop: LoopConfig, source: Source) -> None:
        super().__init__(loop, given.memory)
        self._source = source
        self._strain = LagRate()

    def update(self, ambient_pressure_pa: float, air_temperature_c: float, dt_s: float) -> float:
        """Return the flow that cancels weather and climate, µm/s."""
        weather_um_per_s = super().update(ambient_pressure_pa, air_temperature_c, dt_s)
        ppm_per_s = self._strain.update(self._source(), dt_s, LAG_S)
        climate_um_per_s = CENTRE_UM_PER_PPM * ppm_per_s
        return weather_um_per_s - min(max(climate_um_per_s, -MOST_UM_PER_S), MOST_UM_PER_S)


@dataclass(frozen=True)
class Held:
    """How well the centre was held.

    Attributes
    ----------
    off_um : (n,) array
        True displacement of each tick.
    """

    off_um: FloatArray

    @property
    def std_um(self) -> float:
        """Standard deviation."""
        return float(self.off_um.std())

    @property
    def peak_um(self) -> float:
        """Largest deviation from the mean."""
        return float(np.abs(self.off_um - self.off_um.mean()).max())


def hold_centre(room: str, hours: float, seed: int, strain: str) -> Held:
    """Hold by the laser; `strain` is `none`, `sensors` or `truth`."""
    loop = LoopConfig(rate_hz=RATE_HZ, measurement_filter_s=1 / RATE_HZ)
    twin = {"scenario": "quiet", "climate": room, "seed": seed, "laser_noise_um": 1.0}
    config = Config(
        twin=TwinConfig.model_validate(twin),
        loop=loop,
        limits=LimitsConfig(laser_gauge_apart_max_um=60.0, laser_gauge_drift_max_um=300.0),
    )
    bench = VirtualBench(Plant(config.twin, config.pump))
    run = VirtualRun(config, bench, zernike_projection())
    controller = run._controller
    sources: dict[str, Source] = {
        "sensors": lambda: _find_excess_ppm(controller._climate.fresh_strains),
        "truth": lambda: bench.truth.excess_strain_ppm,
    }
    inner = controller._context.loop
    if strain in sources:
        inner._feedforward = ClimateFeedForward(inner._feedforward, loop, sources[strain])
    commands: tuple[Command, ...] = (Command("hold", "a study"),)
    off_um: list[float] = []
    while run.now_s < SETTLED_S + 3600 * hours:
        tick = run.run_tick(commands)
        commands = ()
        assert tick is not None
        if run.now_s > SETTLED_S:
            off_um.append(bench.truth.displacement_um)
    assert run.finished is None
    return Held(np.array(off_um))


def _find_excess_ppm(parts: object) -> float:
    heat, water, ring = (getattr(parts, f"{name}_ppm") for name in ("heat", "water", "ring"))
    return float(heat + water - ring)


def main(room: str, hours: float, seeds: list[int]) -> None:
    """Print what feed-forward changes."""
    changes: dict[str, list[float]] = {"sensors": [], "truth": []}
    for seed in seeds:
        plain = hold_centre(room, hours, seed, "none")
        line = f"{room} seed {seed}: std {plain.std_um:.4f} µm, peak {plain.peak_um:.3f} µm"
        for strain, found in changes.items():
            held = hold_centre(room, hours, seed, strain)
            found.append(held.std_um - plain.std_um)
            peak_um = held.peak_um - plain.peak_um
            line += f"; {strain}: std {1e3 * found[-1]:+.2f} nm, peak {1e3 * peak_um:+.1f} nm"
        print(line, flush=True)
    for strain, found in changes.items():
        if len(found) > 1:
            error_um = float(np.std(found, ddof=1)) / math.sqrt(len(found))
            print(f"{strain}: {1e3 * np.mean(found):+.3f} +- {1e3 * error_um:.3f} nm of std")


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), [int(seed) for seed in sys.argv[3:]])
