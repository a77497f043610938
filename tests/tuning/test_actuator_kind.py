"""Actuators that no single lag describes are recognised from the experiments of a session.

The benches are those of the second world; the fit shares no code with them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from membrane_ctrl.config.schema import PumpConfig
from tests.worlds.eleven_benches import FanPump, PeristalticPump
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_bench, foreign_config
from tuning.identification.actuator_kind import ActuatorKind, follow_with_play, recognise_actuator
from tuning.identification.experiments import run_experiments
from tuning.identification.plant_fit import identify_plant
from tuning.rigs.hold_rig import HoldRig
from tuning.twin_hold import TwinHold

FULL_UM_PER_S = 5.3
# The curve of the straight pump, known from a map
STRAIGHT = PumpConfig(
    start_fraction=0.1,
    stall_fraction=0.1,
    curve_fraction=(0.1, 1.0),
    curve_um_per_s=(0.0, FULL_UM_PER_S),
)


def recognise(pump: ForeignPump, laser_um: float, seed: int = 1) -> ActuatorKind:
    """The kind that experiments of a hold show, in typical weather, at 10 Hz."""
    plant = ForeignPlant(pump, seed, laser_um=laser_um)
    config = foreign_config(rate_hz=10.0).model_copy(update={"pump": STRAIGHT})
    rig = HoldRig(TwinHold(config, bench=foreign_bench(plant)), "tester")
    record = run_experiments(rig).record
    return recognise_actuator(record, identify_plant(record))


@pytest.mark.parametrize(
    ("delay_s", "lag_s", "play", "laser_um"), [(0.3, 0.4, 0.02, 0.5), (0.1, 0.2, 0.03, 1.0)]
)
def test_backlash_is_recognised_and_measured(
    delay_s: float, lag_s: float, play: float, laser_um: float
) -> None:
    pump = ForeignPump("straight", FULL_UM_PER_S, delay_s, lag_s, play=play)
    found = recognise(pump, laser_um)
    assert found.kind == "backlash"
    assert found.play_um_per_s == pytest.approx(play * FULL_UM_PER_S / 0.9, rel=0.3)
    assert "backlash" in found.describe()


def test_a_fan_is_recognised_with_its_two_lags() -> None:
    fan = FanPump("straight", FULL_UM_PER_S, 0.2, 0.4, rotor_s=0.5)
    found = recognise(fan, 0.3)
    assert found.kind == "two lags"
    assert sum(found.lags_s) == pytest.approx(0.9, rel=0.15)
    assert "two lags" in found.describe()


@pytest.mark.fast_cases("<lambda>1", "<lambda>2")
@pytest.mark.parametrize(
    "pump",
    [
        lambda: ForeignPump("straight", FULL_UM_PER_S, 0.1, 0.2),
        lambda: ForeignPump("straight", FULL_UM_PER_S, 0.4, 0.6),
        lambda: PeristalticPump("straight", FULL_UM_PER_S, 0.05, 0.1),
    ],
)
def test_an_actuator_of_one_lag_is_not_accused(pump: Callable[[], ForeignPump]) -> None:
    found = recognise(pump(), 0.3, seed=3)
    assert found.kind == "one lag"
    assert found.describe() == ""


def test_play_holds_the_flow_within_its_band() -> None:
    flow = np.array([1.0, 1.05, 1.3, 1.25, 1.0, 1.05])
    assert follow_with_play(flow, 0.1) == pytest.approx([1.0, 1.0, 1.2, 1.2, 1.1, 1.1])
