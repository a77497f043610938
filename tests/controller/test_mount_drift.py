"""How far the estimate may let the laser's mount drift, and what counts as a drift."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from membrane_ctrl.config.schema import ShapeConfig
from membrane_ctrl.control.centre_estimate import Sensor
from membrane_ctrl.controller.mount_drift import MountDrift
from membrane_ctrl.model.events import Maintenance

TICK_S = 0.1
LIMIT_UM = 10.0


def find_notices(mount_um: Callable[[float], float], knocked_s: tuple[float, ...]) -> list[str]:
    """Names of the notices of a minute; at `knocked_s` the estimate finds a jump of the laser."""
    drift = MountDrift(ShapeConfig(trim_max_um=LIMIT_UM))
    drift.start(mount_um(0.0))
    names = []
    for tick in range(600):
        time_s = tick * TICK_S
        jumped = {Sensor.LASER} if any(abs(time_s - at_s) < 1e-6 for at_s in knocked_s) else set()
        events = drift.step(mount_um(time_s), jumped, time_s, TICK_S, has_laser=True)
        names += [event.name for event in events if isinstance(event, Maintenance)]
    return names


def knocked(step_um: float) -> Callable[[float], float]:
    """A mount that is knocked at 20 s; the estimate follows within a second and a half."""
    return lambda time_s: step_um * min(max((time_s - 20.0) / 1.5, 0.0), 1.0)


@pytest.mark.parametrize("step_um", [-40.0, 40.0])
def test_a_knock_of_the_laser_is_no_drift(step_um: float) -> None:
    assert find_notices(knocked(step_um), knocked_s=(20.0,)) == []


@pytest.mark.parametrize("step_um", [-40.0, 40.0])
def test_the_same_move_without_a_knock_is_a_drift(step_um: float) -> None:
    assert find_notices(knocked(step_um), knocked_s=()) == ["trim_limit"]


@pytest.mark.parametrize("um_per_s", [-0.5, 0.5])
def test_a_drift_after_a_knock_counts(um_per_s: float) -> None:
    def mount_um(time_s: float) -> float:
        return knocked(40.0)(time_s) + um_per_s * max(time_s - 22.5, 0.0)

    assert find_notices(mount_um, knocked_s=(20.0,)) == ["trim_limit"]


def test_several_small_drifts_add_up_and_are_reported_once() -> None:
    assert find_notices(lambda time_s: 0.3 * time_s, knocked_s=()) == ["trim_limit"]
