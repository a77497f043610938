"""Early, late and missing ticks: the loop gets the true time step."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.config.schema import LoopConfig, PumpConfig, TwinConfig
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput
from membrane_ctrl.sim.plant import Plant


def true_centre_um(steps_s: np.ndarray) -> np.ndarray:
    """Hold the twin at the given times between ticks (multiples of the twin's 5 ms)."""
    plant, inner = (
        Plant(TwinConfig(start_error_um=-5.0), PumpConfig()),
        InnerLoop(LoopConfig(), PumpConfig()),
    )
    inner.start(plant.sample().displacement_um, plant.truth().leak_um_per_s)
    centre_um, dt_s = [], 0.02
    for next_s in steps_s:
        sample = plant.sample()
        given = LoopInput(
            0.0, 0.0, sample.displacement_um, sample.ambient_pressure_pa, sample.air_temperature_c
        )
        plant.actuate(inner.step(given, dt_s).pump_fraction, 0.0)
        plant.advance(next_s)
        dt_s = next_s
        centre_um.append(plant.truth().displacement_um)
    return np.array(centre_um)


def test_irregular_ticks_increase_the_error_only_slightly() -> None:
    steps_s = np.random.default_rng(2).choice([0.01, 0.015, 0.02, 0.025, 0.06, 0.1], 4000)
    settled_um = true_centre_um(steps_s)[1000:]
    assert settled_um.std() < 0.25
    assert abs(settled_um.mean()) < 0.1
    assert np.abs(settled_um).max() < 2.0
