"""A latched fault in standby: no hold before a person acknowledges it."""

from __future__ import annotations

from membrane_ctrl.config.schema import Config, LoopConfig, ShapeConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import CommandTaken
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

CONFIG = Config(
    loop=LoopConfig(rate_hz=10.0),
    twin=TwinConfig(scenario="calm"),
    shape=ShapeConfig(enabled=False),
)


def refusals(run: VirtualRun, *commands: Command) -> list[str]:
    tick = run.run_tick(commands)
    assert tick is not None
    return [event.refused or "" for event in tick.events if isinstance(event, CommandTaken)]


def test_hold_is_refused_until_the_fault_is_acknowledged() -> None:
    run = VirtualRun(CONFIG, VirtualBench(Plant(CONFIG.twin, CONFIG.pump)), zernike_projection())
    assert refusals(run, Command("latched", "command line", text="over_pressure: 801 Pa")) == [""]
    (refused,) = refusals(run, Command("hold", "night shift"))
    assert "over_pressure: 801 Pa" in refused
    for _ in range(50):
        tick = run.run_tick()
        assert tick is not None
        assert tick.row.state == State.STANDBY
        assert tick.row.pump_fraction == 0.0
    assert refusals(run, Command("ack", "engineer"), Command("hold", "engineer")) == ["", ""]
    tick = run.run_tick()
    assert tick is not None
    assert tick.row.state == State.CHECK


def test_only_the_start_of_a_run_reports_a_latched_fault() -> None:
    run = VirtualRun(CONFIG, VirtualBench(Plant(CONFIG.twin, CONFIG.pump)), zernike_projection())
    (refused,) = refusals(run, Command("latched", "somebody", text="nothing"))
    assert "only the start of a run" in refused
    assert refusals(run, Command("hold", "somebody")) == [""]


def test_a_person_can_lock_the_mirror() -> None:
    run = VirtualRun(CONFIG, VirtualBench(Plant(CONFIG.twin, CONFIG.pump)), zernike_projection())
    assert refusals(run, Command("latch", "engineer", account="engineer")) == [""]
    (refused,) = refusals(run, Command("hold", "somebody"))
    assert '"locked by hand" by engineer' in refused
    ack, hold = refusals(run, Command("ack", "engineer"), Command("hold", "engineer"))
    assert (ack, hold) == ("", refused)
    unlock = Command("unlock", "engineer", account="engineer")
    assert refusals(run, unlock, Command("hold", "engineer")) == ["", ""]
