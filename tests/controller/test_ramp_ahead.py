"""A pump stronger than configured lifts the mirror ahead of the ramp, which continues."""

from __future__ import annotations

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_hold import VirtualHold
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_bench, foreign_config


def make_config() -> Config:
    """A proportional pump, stated 40 % too weak, and a film that begins nearly flat."""
    config = foreign_config(flow_max_um_per_s=88.0, setpoint_ramp_um_per_s=80.0)
    pump = {"flow_full_um_per_s": 88.0, "dead_fraction": 0.0, "start_fraction": 0.0}
    limits = config.limits.model_copy(update={"displacement_min_um": -36_700.0})
    return config.model_copy(
        update={
            "pump": config.pump.model_copy(update={**pump, "stall_fraction": 0.0}),
            "limits": limits,
        }
    )


def test_the_ramp_does_not_wait_for_a_mirror_ahead_of_it() -> None:
    plant = ForeignPlant(ForeignPump("top unreachable", full_um_per_s=88.0), seed=2)
    plant.lower(500.0)
    hold = VirtualHold(make_config(), foreign_bench(plant), "ahead")
    hold.send_command(Command("setpoint", "test", value=-33_400.0))
    hold.send_command(Command("hold", "test"))
    for _ in range(12):
        rows = hold.read_news().rows
    assert rows[-1].displacement_um > -35_500.0  # a minute later; it stood still at -36,330
