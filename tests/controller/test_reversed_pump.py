"""A pump that begins to take gas instead of giving it is found in every state, in another world."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from membrane_ctrl.config.schema import ShapeConfig, leave_to_start
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Fault, ProcessValueChosen
from membrane_ctrl.model.telemetry import State
from tests.worlds.eleven_benches import ForeignCamera
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_bench, foreign_config

FOUND_WITHIN_S = 40.0


@dataclass
class ReversiblePump(ForeignPump):
    sign: float = 1.0

    def step(self, command: float) -> float:
        return self.sign * super().step(command)


def find_fault(state: State, after_switch_s: float, start_um: float = 0.0) -> tuple[str, float]:
    """The first fault and how long it took, from the moment at which the pump is reversed: in this
    state, and so long after the loop has begun to follow the estimate (negative: at once).
    """
    config = foreign_config(rate_hz=10.0)
    config = config.model_copy(update={"shape": ShapeConfig(mode="track", track_rate_hz=5.0)})
    if start_um:
        loop = config.loop.model_copy(update={"setpoint_um": start_um})
        config = config.model_copy(update={"loop": loop})
    plant = ForeignPlant(ReversiblePump(), 1)
    run = VirtualRun(
        leave_to_start(config), foreign_bench(plant), zernike_projection(), ForeignCamera(plant, 1)
    )
    commands: tuple[Command, ...] = (Command("hold", "test"),)
    switched_s = 0.0 if after_switch_s < 0.0 else 1e9
    reversed_s = 0.0
    while run.now_s < 200.0:
        tick = run.run_tick(commands)
        commands = ()
        assert tick is not None
        for event in tick.events:
            if isinstance(event, ProcessValueChosen) and "estimate" in event.value:
                switched_s = min(switched_s, run.now_s)
            if isinstance(event, Fault):
                assert reversed_s, event
                return event.name, run.now_s - reversed_s
        ready = tick.row.state == state and run.now_s >= switched_s + max(0.0, after_switch_s)
        if not reversed_s and ready:
            assert isinstance(plant.pump, ReversiblePump)
            plant.pump.sign = -1.0
            reversed_s = run.now_s
    return "", run.now_s - reversed_s


@pytest.mark.parametrize(
    ("state", "after_switch_s", "start_um"),
    [
        pytest.param(State.SETTLE, 0.0, 0.0, id="at the switch to the estimate, before the hold"),
        pytest.param(State.HOLD, 0.0, 0.0, id="at the first tick of a hold by the estimate"),
        pytest.param(State.HOLD, 10.0, 0.0, id="ten seconds after the switch"),
        pytest.param(State.INFLATE, -1.0, 60.0, id="on the way to the setpoint"),
    ],
)
def test_a_pump_that_is_reversed_is_found(
    state: State, after_switch_s: float, start_um: float
) -> None:
    name, time_s = find_fault(state, after_switch_s, start_um)
    assert name == ("overdue" if state == State.INFLATE else "following_error")
    assert time_s < FOUND_WITHIN_S
