"""The actuator test at slow rates and with an unlucky reading: a second look decides."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.actuator_test import ActuatorTest
from membrane_ctrl.config import Config, LoopConfig, PumpConfig, ShapeConfig, TwinConfig
from membrane_ctrl.metrology.hencky import zernike_projection
from membrane_ctrl.names import State
from membrane_ctrl.twin.plant import Plant
from membrane_ctrl.virtual.run import run_virtual


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 20.0, 50.0])
def test_the_film_of_the_twin_passes_at_any_rate(rate_hz: float) -> None:
    for seed in range(12):
        config = Config(
            loop=LoopConfig(rate_hz=rate_hz), twin=TwinConfig(seed=seed), shape=ShapeConfig(enabled=False)
        )
        rows = [t.row for t in run_virtual(config, Plant(config.twin, config.pump), 14.0, zernike_projection())]
        assert any(row.state == State.INFLATE for row in rows), seed


def noisy_complaint(rate_hz: float, seed: int) -> str:
    """The complaint about a perfect bench with 1 um of noise: 8 um/s of vent, the pump as it should be."""
    rng = np.random.default_rng(seed)
    pump = PumpConfig()
    test = ActuatorTest(pump, True, rate_hz)
    height_um, dt_s = 0.0, 1.0 / rate_hz
    while (part := test.part) is not None:
        flow = max(0.0, part.pump_fraction - pump.dead_fraction) / (1 - pump.dead_fraction)
        height_um += dt_s * (pump.flow_full_um_per_s * flow - 100.0 * part.vent_fraction - 1.2)
        test.step(height_um + rng.standard_normal(), dt_s)
    return test.complaint()


@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
def test_noise_alone_complains_rarely(rate_hz: float) -> None:
    complaints = sum(bool(noisy_complaint(rate_hz, seed)) for seed in range(300))
    assert complaints <= 9  # 3 %; two in a row are then one in a thousand
