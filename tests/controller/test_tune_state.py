"""The controller's state `tune` on the twin in virtual time: experiments, their ends, and gains on
trial.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig, ShapeConfig, TwinConfig
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.control.pump_drift import PumpScale
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.commands import explain_refusal
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.snapshot import continue_from, take_snapshot
from membrane_ctrl.controller.tick import TickInputs
from membrane_ctrl.controller.tick_assembler import TickAssembler
from membrane_ctrl.controller.tick_codec import pack_tick, unpack_tick
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.bench_events import AmbientChange, BenchEvent
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

CONFIG = Config(
    twin=TwinConfig(scenario="quiet", start_error_um=-5.0), shape=ShapeConfig(enabled=False)
)
BEGIN_S = 40.0


def spec(**changed: Any) -> ExperimentSpec:
    base: dict[str, Any] = {
        "kind": "relay",
        "duration_s": 20.0,
        "holding_flow_um_per_s": 1.24,
        "laser_um": 1.0,
    }
    return ExperimentSpec.model_validate(base | changed)


def tune(**changed: Any) -> Command:
    return Command("tune", "tester", experiment=spec(**changed), number=7)


class Held:
    """A twin that has held for a while."""

    def __init__(self, config: Config = CONFIG, twin_events: tuple[BenchEvent, ...] = ()) -> None:
        self.bench = VirtualBench(Plant(config.twin, config.pump, twin_events))
        self._run = VirtualRun(config, self.bench, zernike_projection())
        self.events: list[EventLine] = []
        self.rows: list[Any] = []
        self.go(BEGIN_S, Command("hold", "tester"))
        assert self.state == State.HOLD

    @property
    def state(self) -> float:
        return float(self.rows[-1].state)

    def go(self, duration_s: float, *commands: Command) -> None:
        for _ in range(round(duration_s * CONFIG.loop.rate_hz)):
            tick = self._run.run_tick(commands)
            commands = ()
            if tick is not None:
                self.rows.append(tick.row)
                self.events += [
                    {**event.to_dict(), "mono_s": tick.row.mono_s} for event in tick.events
                ]

    def until_hold(self, at_most_s: float) -> None:
        self.go(0.02)
        for _ in range(round(at_most_s)):
            if self.state != State.TUNE:
                return
            self.go(1.0)
        pytest.fail("the experiment did not end")

    def of(self, kind: str) -> list[Mapping[str, Any]]:
        return [event for event in self.events if event["kind"] == kind]

    def furthest_um(self, since_s: float) -> float:
        return float(
            max(abs(row.truth_displacement_um) for row in self.rows if row.mono_s >= since_s)
        )


@pytest.mark.parametrize("kind", ["relay", "steps", "doublets", "multisine"])
def test_an_experiment_moves_the_mirror_within_its_limit_and_returns_to_hold(kind: str) -> None:
    held = Held()
    held.go(0.1, tune(kind=kind))
    assert held.state == State.TUNE
    held.until_hold(40.0)
    assert held.of("experiment")[-1] | {"mono_s": 0, "reason": ""} == {
        "kind": "experiment",
        "experiment": kind,
        "completed": True,
        "reason": "",
        "end": "completed",
        "mono_s": 0,
    }
    assert 1.0 < held.furthest_um(BEGIN_S) < 10.0
    held.go(30.0)
    assert held.state == State.HOLD
    assert held.furthest_um(held.rows[-1].mono_s - 5.0) < 2.0


STEPS = [
    {"fraction": 0.0, "duration_s": 20.0, "until_um": -3.0},
    {"fraction": 0.6, "duration_s": 20.0, "until_um": 2.0},
    {"fraction": 0.31, "duration_s": 1.0},
]


def test_a_pump_map_gives_each_command_until_its_height() -> None:
    """Down 3 µm at 1.24 µm/s, up 5 µm at 1.7 µm/s, then a second at the holding command."""
    held = Held()
    held.go(0.1, tune(kind="pump_map", duration_s=60.0, steps=STEPS))
    held.until_hold(60.0)
    assert held.of("experiment")[-1]["completed"]
    given = [row.pump_fraction for row in held.rows if row.state == State.TUNE][1:]
    lengths_s = [0.02 * given.count(step["fraction"]) for step in STEPS]
    assert sum(lengths_s) == pytest.approx(0.02 * len(given), abs=0.05)
    assert lengths_s == [
        pytest.approx(2.5, abs=1.0),
        pytest.approx(3.0, abs=1.0),
        pytest.approx(1.0, abs=0.05),
    ]
    held.go(30.0)
    assert held.furthest_um(held.rows[-1].mono_s - 5.0) < 2.0


def test_a_pump_map_that_takes_too_long_is_ended() -> None:
    held = Held()
    held.go(
        0.1, tune(kind="pump_map", duration_s=5.0, steps=[{"fraction": 0.31, "duration_s": 60.0}])
    )
    held.until_hold(12.0)
    assert "not done within 5 s" in held.of("experiment")[-1]["reason"]


def test_a_pump_map_without_steps_is_refused() -> None:
    held = Held()
    held.go(0.1, tune(kind="pump_map"))
    assert "without steps" in held.of("command")[-1]["refused"]
    assert held.state == State.HOLD


def test_a_pressure_step_ends_an_experiment_and_the_hold_continues() -> None:
    held = Held(twin_events=(AmbientChange(BEGIN_S + 5.0, -30.0),))
    held.go(0.1, tune())
    held.until_hold(30.0)
    assert "something else moved the mirror" in held.of("experiment")[-1]["reason"]
    held.go(40.0)
    assert held.state == State.HOLD
    assert held.furthest_um(held.rows[-1].mono_s - 5.0) < 2.0


def test_a_lost_laser_ends_an_experiment_at_the_holding_flow() -> None:
    held = Held()
    held.go(5.0, tune())
    held.bench.wrong.no_light = True
    held.go(3.0)
    assert held.state == State.HOLD
    assert not held.of("experiment")[-1]["completed"]
    assert held.rows[-1].flow_um_per_s == pytest.approx(1.24, abs=0.3)  # minus the weather
    held.bench.wrong.no_light = False
    held.go(30.0)
    assert held.furthest_um(held.rows[-1].mono_s - 5.0) < 2.0


def test_a_laser_found_faulty_ends_an_experiment_although_it_reads() -> None:
    held = Held()
    held.go(5.0, tune(duration_s=60.0))
    held.bench.wrong.laser_stuck = True
    held.go(CONFIG.limits.stuck_s + 1.0)
    assert held.state == State.HOLD
    assert not held.of("experiment")[-1]["completed"]


def test_the_mean_flow_of_the_safety_table_ends_an_experiment_although_the_laser_reads() -> None:
    held = Held()
    held.go(4.0, tune(duration_s=60.0))
    held.bench.wrong.gauge_offset_pa = -60.0  # a jump that no film can cause, within all limits
    held.go(0.2)
    assert held.rows[-1].safe_level == SafeLevel.HOLD_FLOW
    assert held.state != State.TUNE
    assert "mean flow" in held.of("experiment")[-1]["reason"]


@pytest.mark.parametrize(
    ("kind", "state"), [("hold", State.HOLD), ("lower", State.STANDBY), ("vent", State.LOWER)]
)
def test_every_operating_command_ends_an_experiment(kind: Any, state: State) -> None:
    held = Held()
    held.go(4.0, tune())
    held.go(3.0, Command(kind, "operator"))
    assert held.state == state
    assert "operator" in held.of("experiment")[-1]["reason"]
    held.go(2.0)
    assert held.state != State.TUNE  # it does not come back by itself


def test_a_fault_ends_an_experiment_which_is_not_resumed() -> None:
    held = Held()
    held.go(4.0, tune())
    held.bench.wrong.gauge_offset_pa = 500.0
    held.go(1.0)
    assert held.state == State.FAULT
    assert (
        "fault" in held.of("experiment")[-1]["reason"]
    )  # the board's own limit is the first to see it


def test_an_experiment_requested_in_the_tick_of_a_fault_never_runs() -> None:
    held = Held()
    held.bench.wrong.gauge_offset_pa = 500.0
    held.go(0.02)
    held.go(1.0, tune())
    assert held.state == State.FAULT
    assert not held.of("experiment")


def test_an_experiment_runs_in_hold_only() -> None:
    assert "in hold" in explain_refusal(tune(), State.SETTLE, CONFIG)
    assert explain_refusal(tune(), State.HOLD, CONFIG) == ""
    assert (
        explain_refusal(Command("tune", "tester"), State.HOLD, CONFIG) == "tune: experiment missing"
    )


def test_an_experiment_near_a_limit_is_refused_with_the_remedy() -> None:
    held = Held()
    held.go(0.1, tune(kind="doublets", holding_flow_um_per_s=0.1))
    assert held.state == State.HOLD
    assert "open the bleed" in held.of("command")[-1]["refused"]


@pytest.mark.parametrize(
    "changed",
    [
        {"limit_um": 99.0},
        {"limit_um": math.nan},
        {"duration_s": 1e5},
        {"kind": "jump"},
        {"version": 2},
    ],
)
def test_every_experiment_has_bounds(changed: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        spec(**changed)


def gains(kp_per_s: float, trial_s: float = float("nan")) -> Command:
    return Command(
        "gains", "tester", loop=CONFIG.loop.model_copy(update={"kp_per_s": kp_per_s}), value=trial_s
    )


def kp_of(held: Held) -> float:
    """P over its error: the loop's actual gain."""
    rows = [row for row in held.rows[-200:] if abs(row.error_um) > 0.02]
    return float(np.median([row.p_um_per_s / row.error_um for row in rows]))


def test_gains_on_trial_revert_after_their_time() -> None:
    held = Held()
    held.go(10.0, gains(0.3, 12.0))
    assert kp_of(held) == pytest.approx(0.3, rel=0.02)
    held.go(8.0)
    assert held.of("gains_reverted")[-1]["why"] == "the trial expired before they were kept"
    assert kp_of(held) == pytest.approx(CONFIG.loop.kp_per_s, rel=0.02)


def test_the_same_gains_for_a_second_end_a_trial() -> None:
    """So the page goes back: it need not know the former gains."""
    held = Held()
    held.go(5.0, gains(0.3, 600.0))
    assert not held.of("gains_reverted")
    held.go(8.0, gains(0.3, 1.0))
    assert len(held.of("gains_reverted")) == 1
    assert kp_of(held) == pytest.approx(CONFIG.loop.kp_per_s, rel=0.02)


def test_kept_gains_stay_and_the_next_trial_reverts_to_them() -> None:
    held = Held()
    held.go(5.0, gains(0.3, 6.0))
    held.go(5.0, Command("keep", "tester"))
    assert not held.of("gains_reverted")
    held.go(10.0, gains(0.9, 4.0))
    assert kp_of(held) == pytest.approx(0.3, rel=0.02)


def test_a_fault_reverts_gains_on_trial() -> None:
    held = Held()
    held.go(2.0, gains(0.3, 600.0))
    held.bench.wrong.gauge_offset_pa = 500.0
    held.go(1.0)
    assert "fault" in held.of("gains_reverted")[-1]["why"]


def test_the_time_constant_of_the_shape_loop_is_on_trial_with_the_gains() -> None:
    controller = Controller(CONFIG, zernike_projection())
    now_s = 0.0

    def obey_commands(*commands: Command) -> tuple[list[str], float]:
        nonlocal now_s
        now_s += 5.0
        out = controller.tick(TickInputs(now_s=now_s, dt_s=0.02, reading=None, commands=commands))
        return [event.kind for event in out.events], controller._shape._time_constant_s

    def tried(shape_s: float, trial_s: float = math.nan) -> Command:
        return replace(gains(CONFIG.loop.kp_per_s, trial_s), shape_time_constant_s=shape_s)

    assert obey_commands(tried(90.0, 8.0))[1] == 90.0
    kinds, memory_s = obey_commands()
    assert ("gains_reverted" in kinds, memory_s) == (False, 90.0)
    kinds, memory_s = obey_commands()
    assert ("gains_reverted" in kinds, memory_s) == (True, 40.0)
    obey_commands(tried(90.0, 8.0))
    obey_commands(Command("keep", "tester"))
    assert [obey_commands()[1] for _ in range(3)] == [90.0] * 3
    assert obey_commands(gains(0.3))[1] == 90.0  # gains alone leave it
    assert obey_commands(tried(60.0, 1.0))[1] == 60.0
    assert obey_commands()[1] == 90.0
    assert "outside" in explain_refusal(tried(0.5), State.HOLD, CONFIG)


class Stepped:
    """A controller with its shape loop on and the setpoint at 2 µm, told of trials that step the
    setpoint.
    """

    def __init__(self) -> None:
        self.controller = Controller(CONFIG, zernike_projection())
        self.now_s = 0.0
        self.obey_commands(Command("setpoint", "tester", value=2.1), Command("shape_on", "tester"))

    def obey_commands(self, *commands: Command, after_s: float = 1.0) -> tuple[float, bool]:
        self.now_s += after_s
        out = self.controller.tick(
            TickInputs(now_s=self.now_s, dt_s=0.02, reading=None, commands=commands)
        )
        assert not any(refused for _, refused in out.answers), out.answers
        return self.controller._context.setpoint_um, self.controller._shape.on


def stepped(step_um: float, trial_s: float = 10.0) -> Command:
    return replace(gains(0.3, trial_s), setpoint_step_um=step_um)


def test_setpoint_step_and_shape_loop_revert_after_the_trial() -> None:
    run = Stepped()
    assert run.obey_commands(stepped(0.0)) == (2.1, False)
    assert run.obey_commands(stepped(5.0)) == (7.1, False)
    assert run.obey_commands(after_s=9.0) == (7.1, False)  # the second trial counts
    assert run.obey_commands(after_s=2.0) == (2.1, True)
    assert run.controller.loop_config == CONFIG.loop


@pytest.mark.parametrize("ends", [gains(0.3), Command("keep", "tester")])
def test_a_step_ends_with_its_trial_also_when_gains_stay(ends: Command) -> None:
    run = Stepped()
    run.obey_commands(stepped(5.0))
    assert run.obey_commands(ends) == (2.1, True)
    assert run.controller.loop_config.kp_per_s == 0.3


def test_a_setpoint_set_during_a_step_stays() -> None:
    run = Stepped()
    run.obey_commands(stepped(5.0))
    assert run.obey_commands(
        Command("setpoint", "tester", value=-1.0), Command("shape_off", "tester")
    ) == (
        -1.0,
        False,
    )
    assert run.obey_commands(after_s=20.0) == (-1.0, False)


def test_a_fault_ends_a_step() -> None:
    held = Held()
    held.go(2.0, stepped(5.0, 600.0))
    held.bench.wrong.gauge_offset_pa = 500.0
    held.go(1.0)
    assert held._run._supervisor._controller._context.setpoint_um == 0.0


def test_a_setpoint_step_is_part_of_the_snapshot() -> None:
    run = Stepped()
    run.obey_commands(stepped(5.0))
    run.controller = continue_from(take_snapshot(run.controller), CONFIG, zernike_projection())
    assert run.obey_commands(after_s=20.0) == (2.1, True)


def test_a_step_without_a_trial_or_beyond_the_limits_is_refused() -> None:
    assert "for a trial" in explain_refusal(stepped(5.0, math.nan), State.HOLD, CONFIG)
    assert "outside the limits" in Stepped().controller._refuse_by_condition(stepped(1e6))


# Twice the true flow at every command: on it the mirror seems to lose twice its leak.
TWICE = PumpConfig(curve_fraction=(0.1, 1.0), curve_um_per_s=(0.0, 10.6), flow_full_um_per_s=10.6)


def on_curve(pump: PumpConfig, trial_s: float) -> Command:
    loop = LoopConfig(kp_per_s=0.3, flow_max_um_per_s=pump.flow_full_um_per_s)
    return replace(gains(0.3, trial_s), loop=loop, pump=pump)


def mean_flow(held: Held) -> float:
    return float(np.mean([row.flow_um_per_s for row in held.rows[-300:]]))


def test_a_curve_on_trial_rescales_the_flow_without_moving_the_mirror_and_reverts() -> None:
    held = Held()
    held.go(8.0, on_curve(TWICE, 10.0))
    assert mean_flow(held) == pytest.approx(2 * 1.24, rel=0.15)
    assert held.of("command")[-1]["loop"]["pump"]["flow_full_um_per_s"] == 10.6
    held.go(10.0)
    assert held.of("gains_reverted")[-1]["why"] == "the trial expired before they were kept"
    assert mean_flow(held) == pytest.approx(1.24, rel=0.15)
    assert held._run._supervisor._controller.pump_config == CONFIG.pump
    assert held.furthest_um(BEGIN_S) < 2.0


def test_a_kept_curve_stays_with_later_gains_and_is_in_the_snapshot() -> None:
    held = Held()
    held.go(2.0, on_curve(TWICE, 60.0))
    held.go(2.0, Command("keep", "tester"))
    held.go(4.0, gains(0.5, 2.0))
    assert held.of("gains_reverted")
    controller = held._run._supervisor._controller
    assert controller.pump_config == TWICE
    again = continue_from(take_snapshot(controller), CONFIG, zernike_projection())
    assert again.pump_config == TWICE
    assert again._context.loop._curve.flow(1.0) == 10.6


def test_the_present_curve_limits_the_manual_flow() -> None:
    held = Held()
    asked = Command("manual", "tester", value=8.0)
    held.go(0.1, asked)
    assert held.of("command")[-1]["refused"] == "flow 8 µm/s is outside 0 .. 5.3 µm/s"
    held.go(0.1, on_curve(TWICE, 10.0))
    held.go(0.1, asked)
    assert "refused" not in held.of("command")[-1]
    held.go(0.1, Command("hold", "tester"))
    held.go(10.0)
    held.go(0.1, asked)
    assert held.of("command")[-1]["refused"] == "flow 8 µm/s is outside 0 .. 5.3 µm/s"


def test_the_flow_reserve_is_judged_by_the_present_curve() -> None:
    held = Held()
    consistency = held._run._supervisor._controller._consistency
    weak = on_curve(TWICE.model_copy(update={"flow_full_um_per_s": 2.0, "change_max": 0.3}), 10.0)
    held.go(0.1, weak)
    (notice,) = consistency._health.step(3600.0, 1.24, 600.0)
    assert (notice.name, notice.message) == ("pump_reserve", "the leak takes 62 % of the pump")
    assert not consistency._pump.step(PumpScale(0.75, 0.01))[1]
    held.go(10.5)  # the former curve and its limits are back
    (notice,) = consistency._health.step(3600.0, 1.24, 600.0)
    assert (notice.name, notice.bad) == ("pump_reserve", False)
    assert consistency._pump.step(PumpScale(0.75, 0.01))[1][0].bad


def test_the_events_of_older_commands_have_no_new_keys() -> None:
    """Their words are in the checksum of a replay."""
    held = Held()
    held.go(0.1, gains(0.3, 5.0))
    held.go(0.1, tune())
    settings, experiment = held.of("command")[-2]["loop"], held.of("command")[-1]["experiment"]
    assert set(settings) == set(LoopConfig.model_fields)
    assert "steps" not in experiment


def test_a_trial_without_duration_is_refused() -> None:
    assert "on trial" in explain_refusal(gains(0.3, 0.0), State.HOLD, CONFIG)


def test_the_command_is_recorded_without_loss() -> None:
    """A replay gets the experiment that the run got."""
    held = Held()
    tick = held._run.run_tick((tune(), gains(0.3, 5.0)))
    assert tick is not None
    inputs, outputs = replace(tick.inputs, truth_displacement_um=0.0), tick.outputs
    messages = pack_tick(1, inputs, outputs, outputs.row.pack())
    batch = TickAssembler().add_messages(messages)
    again = unpack_tick(batch.records[0], batch.tails[1], {})
    assert again.commands[0].experiment == inputs.commands[0].experiment
    assert isinstance(again.commands[1].loop, LoopConfig)
