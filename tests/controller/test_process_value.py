"""`process_value = "auto"`: the loop follows the estimate where it is better, else the laser."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.control import EstimatorConfig, LoopConfig, PumpConfig
from membrane_ctrl.config.schema import Config, ShapeConfig, StatesConfig, leave_to_start
from membrane_ctrl.control.centre_estimate import CentreEstimate, Sensor, SensorView
from membrane_ctrl.control.loop_comparison import LoopErrors, MeanSquare
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.process_value import (
    NOTICE,
    ProcessValueChoice,
    ProcessValueFacts,
    ProcessValueState,
)
from membrane_ctrl.hold.virtual_run import VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import (
    Event,
    Maintenance,
    MaintenanceOver,
    ProcessValueChosen,
    PumpResponseFound,
)
from membrane_ctrl.model.state_tree import decode_state, encode_state
from membrane_ctrl.model.telemetry import SafeLevel, State
from tests.worlds.eleven_benches import BENCHES, Bench, ForeignCamera
from tests.worlds.foreign_plant import ForeignPump, foreign_bench

DT_S = 0.1
LOOP = LoopConfig(rate_hz=10.0)
ESTIMATOR = EstimatorConfig(process_value="auto")
CALM = tuple(SensorView(fresh, 0.1, 0.5) for fresh in (True, False, True, True))
ESTIMATE = CentreEstimate(0.1, 0.05, 0.0, 0.1, 0.0, 1.2, 1.2, CALM)
FACTS = ProcessValueFacts(
    now_s=0.0,
    dt_s=DT_S,
    estimate=ESTIMATE,
    held_by_optics=False,
    response_known=True,
    on_trial=False,
    laser_um=0.1,
    repeats_sample=False,
    laser_doubted=False,
    steady=True,
    setpoint_um=0.0,
    flow_um_per_s=1.2,
    weather=(98_000.0, 20.0),
)


class Choice:
    """A choice with its clock."""

    def __init__(self) -> None:
        self.choice = ProcessValueChoice(LOOP, PumpConfig(), ESTIMATOR)
        self.now_s = 0.0
        self.events: list[Event] = []

    def run(self, seconds: float, facts: ProcessValueFacts) -> list[bool]:
        """Whether the loop follows the estimate, by tick."""
        follows = []
        for _ in range(round(seconds / DT_S)):
            self.now_s += DT_S
            estimate, events = self.choice.step(replace(facts, now_s=self.now_s))
            follows.append(estimate is not None)
            self.events += events
        return follows

    @property
    def codes(self) -> list[str]:
        return [event.code for event in self.events if isinstance(event, ProcessValueChosen)]


def without(sensor: Sensor) -> CentreEstimate:
    sensors = list(CALM)
    sensors[sensor] = SensorView(False, 0.1, 0.0)
    return replace(ESTIMATE, sensors=tuple(sensors))


def test_the_estimate_is_followed_once_the_response_is_known() -> None:
    choice = Choice()
    assert not any(choice.run(20.0, replace(FACTS, response_known=False)))
    assert choice.run(20.0, FACTS)[-1]
    assert choice.codes == ["response_unknown", "response_known"]
    chosen = choice.events[-1]
    assert chosen.sentence == (
        "The loop follows the estimate of the centre: dead time and lag of the pump are known"
    )


def test_the_laser_is_followed_without_camera_and_barometer() -> None:
    choice = Choice()
    alone = replace(FACTS, estimate=without(Sensor.BAROMETER))
    assert not any(choice.run(20.0, alone))
    assert choice.codes == ["laser_alone"]


@pytest.mark.parametrize(("gone_s", "back_s"), [(2.0, 6.0), (8.0, 11.0), (60.0, 60.0)])
def test_a_barometer_that_comes_and_goes_does_not_exchange_the_loops_again_and_again(
    gone_s: float, back_s: float
) -> None:
    choice = Choice()
    unjudged = replace(FACTS, steady=False)
    choice.run(20.0, unjudged)
    alone = replace(unjudged, estimate=without(Sensor.BAROMETER))
    while choice.now_s < 1800.0:
        choice.run(gone_s, alone)
        choice.run(back_s, unjudged)
    assert 1 <= len(choice.codes) <= 10


@pytest.mark.parametrize("response_known", [True, False])
@pytest.mark.parametrize(("gone_s", "back_s"), [(0.7, 0.7), (11.0, 1.0), (11.0, 11.0)])
def test_a_laser_that_comes_and_goes_before_the_camera_is_no_decision_again_and_again(
    gone_s: float, back_s: float, response_known: bool
) -> None:
    choice = Choice()
    both = replace(FACTS, held_by_optics=True, response_known=response_known, steady=False)
    choice.run(20.0, both)
    lost = replace(both, laser_um=math.nan, estimate=without(Sensor.LASER))
    while choice.now_s < 1800.0:
        assert all(choice.run(gone_s, lost))  # whatever is decided
        choice.run(back_s, both)
    assert 1 <= len(choice.codes) <= 10


def test_a_laser_that_returns_as_the_camera_is_lost_is_followed_at_once() -> None:
    choice = Choice()
    both = replace(FACTS, held_by_optics=True, response_known=False)
    choice.run(20.0, both)
    choice.run(20.0, replace(both, laser_um=math.nan, estimate=without(Sensor.LASER)))
    assert all(choice.run(5.0, both))
    assert not any(choice.run(5.0, replace(both, held_by_optics=False)))


@pytest.mark.parametrize(
    ("apart_um_per_s", "camera", "creeps"),
    [(0.1, True, True), (-0.1, True, True), (0.0, True, False), (0.1, False, False)],
)
def test_the_notice_names_laser_and_camera_that_move_apart(
    apart_um_per_s: float, camera: bool, creeps: bool
) -> None:
    choice = Choice()
    while choice.now_s < 200.0:
        moved = replace(ESTIMATE, mount_um=apart_um_per_s * choice.now_s)
        choice.run(DT_S, replace(FACTS, estimate=moved, held_by_optics=camera))
    (notice,) = (event for event in choice.events if isinstance(event, Maintenance))
    assert ("either of them may creep" in notice.message) == creeps


def test_the_notice_gives_a_limit_where_the_noise_hides_the_error() -> None:
    choice = Choice()
    choice.run(20.0, FACTS)
    memory = choice.choice.memory
    memory.tries_pi = True
    memory.estimate_error = MeanSquare(0.01, 0.02)
    choice.run(120.0, FACTS)
    (notice,) = (event for event in choice.events if isinstance(event, Maintenance))
    assert "moved by less than 0.22 µm with the estimate" in notice.message


@pytest.mark.parametrize(
    ("pump_response", "correlation", "excess_um2", "tried"),
    [
        ("identified", 0.4, -0.03, False),
        ("identified", 0.4, -0.01, True),  # the prediction does not decide
        ("identified", 0.55, -0.03, True),
        ("stated", 0.4, -0.03, True),
        ("stated", 0.3, -0.03, False),
        ("identified", 0.0, 0.03, True),
    ],
)
def test_an_identified_response_is_doubted_less_where_the_prediction_favours_it(
    pump_response: str, correlation: float, excess_um2: float, tried: bool
) -> None:
    estimator = ESTIMATOR.model_copy(update={"pump_response": pump_response})
    choice = ProcessValueChoice(LOOP, PumpConfig(), estimator)
    choice.memory.correlation.samples = 1000
    choice.memory.correlation.products_um2 = [1.0, 0.0, -correlation, 0.0, 0.0, 0.0]
    errors = LoopErrors(MeanSquare(0.05, 0.01), MeanSquare(excess_um2, 0.01))
    assert choice._may_be_worse(errors) == tried


@pytest.mark.parametrize(
    ("pi_um", "camera", "returns"), [(0.5, True, True), (0.5, False, False), (0.05, True, False)]
)
def test_the_camera_ends_a_trial_that_the_laser_does_not_decide(
    pi_um: float, camera: bool, returns: bool
) -> None:
    """The noise of the laser is 3 µm: it shows no difference of either sign."""
    rng = np.random.default_rng(3)
    choice = Choice()

    def run(seconds: float, error_um: float) -> None:
        until_s = choice.now_s + seconds
        while choice.now_s < until_s:
            um = error_um * math.sin(choice.now_s)
            laser_um = um + 3.0 * float(rng.standard_normal())
            estimate = replace(ESTIMATE, um=um)
            choice.run(
                DT_S, replace(FACTS, estimate=estimate, laser_um=laser_um, held_by_optics=camera)
            )

    run(150.0, 0.1)
    memory = choice.choice.memory
    memory.estimate_error = MeanSquare(0.01, 0.5)
    memory.estimate_error_by_camera = choice.choice._find_error_by_camera()
    assert (memory.estimate_error_by_camera is not None) == camera
    memory.tries_pi = True
    choice.choice._stop_comparing()  # as the change of the loop does
    run(150.0, pi_um)
    assert (choice.codes[-1] == "response_known") == returns


@pytest.mark.parametrize("seen_as_jump", [True, False])
def test_a_door_is_no_reason_to_try_the_pi(seen_as_jump: bool) -> None:
    """It moves the film by 7 µm, which the pump takes out within 6 s, under any loop."""
    choice, rng = Choice(), np.random.default_rng(3)
    for tick in range(2400):
        since_s = tick * DT_S - 150.0
        door_um = 0.0
        if 0.0 <= since_s < 6.0:
            door_um = -7.0 * (1.0 - since_s / 6.0)
        um, noise_um = (rng.standard_normal(2) * (0.05, 0.3)).tolist()
        jumped: tuple[Sensor, ...] = ()
        if seen_as_jump and 0.2 < since_s < 0.35:
            jumped = (Sensor.BAROMETER,)
        estimate = replace(ESTIMATE, um=um + door_um, jumped_sensors=jumped)
        choice.run(DT_S, replace(FACTS, estimate=estimate, laser_um=um + door_um + noise_um))
    expected = ["response_known"] if seen_as_jump else ["response_known", "pi_tried"]
    assert choice.codes[:2] == expected


def test_any_number_of_trials_keeps_the_longest_fall_back() -> None:
    choice = Choice()
    choice.run(20.0, FACTS)
    memory = choice.choice.memory
    memory.trials = 5000
    memory.tries_pi = True
    memory.estimate_error = MeanSquare(1.0, 0.1)
    choice.run(120.0, FACTS)
    assert choice.codes[-1] == "estimate_worse"
    assert memory.fall_back_until_s < choice.now_s + 7 * 3600.0


def test_gains_on_trial_act_on_the_mirror() -> None:
    choice = Choice()
    choice.run(20.0, FACTS)
    assert not any(choice.run(20.0, replace(FACTS, on_trial=True)))
    assert choice.run(20.0, FACTS)[-1]


@pytest.mark.parametrize(
    "unusable",
    [
        {"laser_um": math.nan},
        {"laser_doubted": True},
        {
            "estimate": replace(ESTIMATE, sensors=(SensorView(True, -6.0, 0.5), *CALM[1:])),
        },
    ],
    ids=["missing", "doubted", "jumps"],
)
def test_a_laser_that_the_optics_replace_is_never_followed(unusable: dict[str, object]) -> None:
    """Also while the loop follows the laser, from the first such tick on."""
    choice = Choice()
    by_laser = replace(FACTS, response_known=False, held_by_optics=True)
    assert not any(choice.run(5.0, by_laser))
    assert all(choice.run(5.0, replace(by_laser, **unusable)))  # type: ignore[arg-type]


def test_a_missing_laser_without_optics_is_left_to_the_safety_table() -> None:
    choice = Choice()
    alone = replace(FACTS, response_known=False, laser_um=math.nan)
    assert not any(choice.run(5.0, alone))


@pytest.mark.parametrize("delay_s", [0.0, 0.3, 2.0])
def test_another_response_is_used_in_a_hold(delay_s: float) -> None:
    choice = Choice()
    choice.run(40.0, FACTS)
    slower = ESTIMATOR.model_copy(update={"pump_delay_s": delay_s})
    choice.choice.set_loop(LOOP, PumpConfig(), slower)
    choice.choice.forget_verdict()
    assert all(choice.run(40.0, FACTS))


def test_the_decision_continues_from_its_memory() -> None:
    first = Choice()
    first.run(12.0, FACTS)
    memory = decode_state(encode_state(first.choice.memory), ProcessValueState, 100_000)
    second = ProcessValueChoice(LOOP, PumpConfig(), ESTIMATOR, memory)
    facts = replace(FACTS, now_s=12.1)
    assert second.step(facts) == first.choice.step(facts)
    assert encode_state(second.memory) == encode_state(first.choice.memory)


def bench_of(name: str, rate_hz: float = 10.0) -> Bench:
    (bench,) = (bench for bench in BENCHES if bench.name == name)
    return replace(bench, rate_hz=rate_hz)


class Held:
    """A foreign bench held for some time."""

    def __init__(self, bench: Bench, estimator: EstimatorConfig, seconds: float, seed: int = 1):
        plant = bench.plant(seed)
        config = bench.config().model_copy(update={"estimator": estimator})
        run = VirtualRun(config, foreign_bench(plant), zernike_projection())
        self.ticks: list[VirtualTick] = []
        self.true_um: list[float] = []
        commands: tuple[Command, ...] = (Command("hold", "a test"),)
        while run.now_s < seconds and (tick := run.run_tick(commands)) is not None:
            self.ticks.append(tick)
            self.true_um.append(plant.truth().displacement_um)
            commands = ()

    def events(self, kind: type[Event]) -> list[tuple[float, Event]]:
        return [
            (tick.row.mono_s, event)
            for tick in self.ticks
            for event in tick.events
            if isinstance(event, kind)
        ]

    def std_um(self, begin_s: float) -> float:
        values = [
            um
            for um, tick in zip(self.true_um, self.ticks, strict=True)
            if tick.row.mono_s > begin_s
        ]
        return float(np.std(values))


def test_an_estimate_with_a_wrong_response_falls_back_to_the_pi_with_a_notice() -> None:
    """A slow pump whose stated dead time and lag are those of a quick one."""
    bench = replace(bench_of("slow pump"), pump=lambda: ForeignPump(delay_s=0.8, lag_s=0.8))
    held = Held(bench, ESTIMATOR, 420.0)
    codes = [event.code for _, event in held.events(ProcessValueChosen)]  # type: ignore[attr-defined]
    assert codes == ["response_known", "pi_tried", "estimate_worse"]
    ((at_s, notice),) = held.events(Maintenance)
    assert notice.name == NOTICE  # type: ignore[attr-defined]
    assert "The loop follows the laser" in notice.message  # type: ignore[attr-defined]
    by_laser = Held(bench, ESTIMATOR.model_copy(update={"process_value": "laser"}), 420.0)
    assert held.std_um(at_s + 30.0) <= 1.05 * by_laser.std_um(at_s + 30.0)


def test_an_estimate_that_is_better_stays() -> None:
    estimator = EstimatorConfig(process_value="auto", pump_response="identified")
    held = Held(bench_of("quick pump"), estimator, 300.0)
    codes = [event.code for _, event in held.events(ProcessValueChosen)]  # type: ignore[attr-defined]
    assert codes == ["response_known"]
    assert held.events(Maintenance) == held.events(MaintenanceOver) == []
    by_laser = Held(
        bench_of("quick pump"), estimator.model_copy(update={"process_value": "laser"}), 300.0
    )
    assert held.std_um(60.0) < by_laser.std_um(60.0)


def test_the_transfer_makes_no_bump() -> None:
    estimator = EstimatorConfig(process_value="auto", pump_response="identified")
    held = Held(bench_of("quick pump"), estimator, 60.0)
    flows = np.array([tick.row.flow_um_per_s for tick in held.ticks])
    (at_s, _), *_ = held.events(ProcessValueChosen)
    times = np.array([tick.row.mono_s for tick in held.ticks])
    place = int(np.flatnonzero(times >= at_s)[0])
    usual = np.abs(np.diff(flows[place + 1 : place + 300]))
    assert abs(flows[place] - flows[place - 1]) <= np.quantile(usual, 0.99)


def test_without_a_response_the_hold_follows_the_laser() -> None:
    estimator = EstimatorConfig(process_value="auto", pump_response="identified")
    bench = bench_of("quick pump")
    plant = bench.plant(1)
    config = bench.config().model_copy(
        update={"estimator": estimator, "states": StatesConfig(actuator_test=False)}
    )
    run = VirtualRun(config, foreign_bench(plant), zernike_projection())
    ticks = [run.run_tick((Command("hold", "a test"),))]
    while run.now_s < 30.0:
        ticks.append(run.run_tick())
    rows = [tick.row for tick in ticks if tick is not None]
    events = [event for tick in ticks if tick is not None for event in tick.events]
    assert rows[-1].state == State.HOLD
    assert [e.code for e in events if isinstance(e, ProcessValueChosen)] == ["response_unknown"]
    assert not [e for e in events if isinstance(e, PumpResponseFound)]
    assert all(math.isnan(row.estimate_sigma_um) for row in rows)


def test_a_camera_that_replaces_the_laser_holds_the_mirror_at_once() -> None:
    """As with `estimate`, also in a hold that follows the laser."""
    bench = bench_of("quick pump")
    plant = bench.plant(1)
    config = bench.config().model_copy(
        update={
            "estimator": EstimatorConfig(process_value="auto", pump_response="identified"),
            "states": StatesConfig(actuator_test=False),
            "shape": ShapeConfig(mode="track", track_rate_hz=10.0),
        }
    )
    virtual = foreign_bench(plant)
    run = VirtualRun(config, virtual, zernike_projection(), ForeignCamera(plant, 1))
    run.run_tick((Command("hold", "a test"),))
    while run.now_s < 40.0:
        run.run_tick()
    before_um = plant.truth().displacement_um
    virtual.wrong.no_light = True
    rows = [tick.row for _ in range(200) if (tick := run.run_tick()) is not None]
    assert rows[-1].state == State.HOLD
    assert {row.safe_level for row in rows} == {SafeLevel.NONE}
    assert math.isfinite(rows[-1].estimate_sigma_um)
    assert abs(plant.truth().displacement_um - before_um) < 1.5


def test_a_file_that_states_nothing_leaves_the_process_value_to_the_hold() -> None:
    assert leave_to_start(Config()).estimator.process_value == "auto"
    stated = Config.model_validate({"estimator": {"process_value": "laser"}})
    assert leave_to_start(stated).estimator.process_value == "laser"
    assert Config().estimator.process_value == "laser"  # of a recorded run without the table
