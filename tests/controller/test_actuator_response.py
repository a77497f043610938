"""The actuator test waits for a response: slow and weak actuators pass, dead and reversed ones do
not, and the failure states what was seen.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import (
    Config,
    LoopConfig,
    PumpConfig,
    ShapeConfig,
    TwinConfig,
    leave_to_start,
)
from membrane_ctrl.control.gain_limits import find_dead_time_s, limit_gains
from membrane_ctrl.control.pump_response import PumpResponse
from membrane_ctrl.controller.actuator_test import ActuatorTest, ActuatorTestState
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Event, GainsLimited, PumpResponseFound, PumpStronger
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.state_tree import decode_state, encode_state
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_bench, foreign_config
from tests.worlds.virtual_record import run_virtual

# What a test took that ran twice on a dead actuator, at 50 Hz.
PRESENT_TIME_S = 7.2
_SUBSTEPS = 10
Error = Callable[[float], float]


def no_error(_: float) -> float:
    return 0.0


@dataclass(frozen=True)
class Bench:
    """A film that moves at the speed of its gas, and its actuators: dead time, then a lag."""

    rate_hz: float = 50.0
    pump_share: float = 1.0  # of the flow that the curve promises
    pump_delay_s: float = 0.1
    pump_lag_s: float = 0.15
    vent_um_per_s: float = 100.0  # fully open
    vent_delay_s: float = 0.1
    vent_lag_s: float = 0.15
    noise_um: float = 1.0
    identify: bool = False
    error_um: Error = no_error  # of the laser, by the time of the test
    before_um_per_s: float = 0.0  # the pump's flow until the test begins
    leak_um_per_s: float = 1.2
    assumed: bool = False

    def run(self, seed: int) -> tuple[str, float]:
        """The test's failure, and how long it took."""
        test, time_s = self.run_test(seed)
        return test.failure, time_s

    def run_test(self, seed: int) -> tuple[ActuatorTest, float]:
        """The test at its end, and how long it took."""
        rng = np.random.default_rng(seed)
        pump = PumpConfig()
        test = ActuatorTest(pump, True, self.rate_hz, self.identify, assumed=self.assumed)
        dt_s = 1.0 / self.rate_hz / _SUBSTEPS
        pumped, vented = (
            deque([flow_um_per_s] * max(1, round(delay_s / dt_s)))
            for flow_um_per_s, delay_s in (
                (self.before_um_per_s, self.pump_delay_s),
                (0.0, self.vent_delay_s),
            )
        )
        inflow = self.before_um_per_s
        outflow = height_um = time_s = 0.0
        while (part := test.part) is not None:
            drive = max(0.0, part.pump_fraction - pump.dead_fraction) / (1 - pump.dead_fraction)
            for _ in range(_SUBSTEPS):
                pumped.append(self.pump_share * pump.flow_full_um_per_s * drive)
                vented.append(self.vent_um_per_s * part.vent_fraction)
                inflow -= (pumped.popleft() - inflow) * math.expm1(-dt_s / self.pump_lag_s)
                outflow -= (vented.popleft() - outflow) * math.expm1(-dt_s / self.vent_lag_s)
                height_um += dt_s * (inflow - outflow - self.leak_um_per_s)
            seen_um = height_um + self.error_um(time_s) + self.noise_um * rng.standard_normal()
            test.step(seen_um, 1.0 / self.rate_hz)
            time_s += 1.0 / self.rate_hz
        return test, time_s

    def failures(self, count: int) -> list[str]:
        """Failures of tests with different noise; those that pass are left out."""
        found = (self.run(seed)[0] for seed in range(count))
        return [failure for failure in found if failure]

    def durations_s(self, count: int) -> list[float]:
        return [self.run(seed)[1] for seed in range(count)]


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 50.0])
def test_a_quick_bench_passes_whatever_the_noise(rate_hz: float) -> None:
    bench = Bench(rate_hz)
    assert bench.failures(100) == []
    if rate_hz == 50.0:
        assert np.median(bench.durations_s(20)) == pytest.approx(3.56, abs=0.03)


@pytest.mark.parametrize(
    ("delay_s", "lag_s"), [(0.3, 0.5), (0.4, 0.8), (1.0, 1.0), (2.0, 1.5), (0.0, 2.0)]
)
@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
def test_a_slow_pump_is_awaited(rate_hz: float, delay_s: float, lag_s: float) -> None:
    assert Bench(rate_hz, pump_delay_s=delay_s, pump_lag_s=lag_s).failures(40) == []


@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
def test_a_slow_pump_whose_former_gas_still_comes_is_awaited_and_identified(
    rate_hz: float,
) -> None:
    """The hold began while the pump balanced the leak: the film seems to stand still with the pump
    off, and the pump to lift it by little.
    """
    bench = Bench(rate_hz, pump_delay_s=1.0, pump_lag_s=1.5, before_um_per_s=1.2, identify=True)
    for seed in range(40):
        test, time_s = bench.run_test(seed)
        assert test.failure == ""
        assert test.response is not None
        assert time_s < 14.0 * (50.0 / rate_hz) ** (1 / 3)


def test_a_weak_and_slow_vent_is_awaited() -> None:
    assert len(Bench(vent_um_per_s=30.0).failures(100)) <= 1
    assert len(Bench(vent_um_per_s=40.0, vent_delay_s=0.4, vent_lag_s=0.5).failures(100)) <= 1


def test_a_noisy_laser_takes_longer_and_is_no_failure() -> None:
    bench = Bench(noise_um=3.0)
    assert bench.failures(30) == []
    assert np.median(bench.durations_s(20)) > np.median(Bench().durations_s(20))


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 50.0])
@pytest.mark.parametrize(
    ("dead", "words"),
    [
        ({"pump_share": 0.0}, "the pump, at 80% for 5."),
        ({"vent_um_per_s": 0.0}, "the vent, 8% open for 3."),
    ],
    ids=["pump", "vent"],
)
def test_noise_rarely_hides_a_dead_actuator(
    rate_hz: float, dead: dict[str, float], words: str
) -> None:
    found = replace(Bench(rate_hz), **dead).failures(150)
    assert len(found) >= 147  # a pass in a hundred at most
    assert all(words in failure for failure in found)
    assert all(" ± " in failure for failure in found)


def test_a_dead_actuator_is_found_within_the_time_of_two_quick_tests() -> None:
    assert max(Bench(pump_share=0.0).durations_s(20)) <= PRESENT_TIME_S
    assert max(Bench(vent_um_per_s=0.0).durations_s(20)) <= PRESENT_TIME_S


def test_a_reversed_pump_is_found_earlier_than_a_dead_one() -> None:
    bench = Bench(pump_share=-1.0)
    assert all("lifts the mirror by -" in failure for failure in bench.failures(20))
    assert len(bench.failures(20)) == 20
    assert np.median(bench.durations_s(20)) < 5.0


@pytest.mark.parametrize("share", [0.1, 4.0])
def test_a_pump_of_another_size_than_its_curve_fails(share: float) -> None:
    failures = Bench(pump_share=share).failures(40)
    assert len(failures) >= 39
    assert all("not by about 4.1 µm/s" in failure for failure in failures)


@pytest.mark.parametrize(
    ("share", "leak_um_per_s", "rate_hz"),
    [(0.4, 1.2, 50.0), (0.27, 0.2, 20.0), (0.27, 0.8, 20.0), (4.0, 1.2, 10.0), (4.0, 1.2, 50.0)],
)
def test_a_pump_of_an_assumed_curve_passes_if_it_lifts_the_mirror(
    share: float, leak_um_per_s: float, rate_hz: float
) -> None:
    bench = Bench(
        rate_hz, share, leak_um_per_s=leak_um_per_s, before_um_per_s=leak_um_per_s, assumed=True
    )
    assert len(bench.failures(30)) <= 1
    late = replace(bench, pump_delay_s=0.3, pump_lag_s=0.5)
    assert len(late.failures(30)) <= 1


@pytest.mark.parametrize("dead", [{"pump_share": 0.0}, {"pump_share": -1.0}, {"pump_share": 10.0}])
@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
def test_an_assumed_curve_delays_no_failure_and_hides_none(
    rate_hz: float, dead: dict[str, float]
) -> None:
    bench = replace(Bench(rate_hz, assumed=True), **dead)
    stated = replace(bench, assumed=False)
    count = 30
    assert len(bench.failures(count)) >= count - 1
    later_s = np.subtract(bench.durations_s(count), stated.durations_s(count))
    if dead["pump_share"] <= 0.0:
        assert np.quantile(later_s, 0.97) <= 0.0


def test_a_dead_pump_of_a_tight_mirror_is_found_whatever_the_curve() -> None:
    bench = Bench(pump_share=0.0, leak_um_per_s=0.1, assumed=True)
    assert len(bench.failures(100)) >= 98


@pytest.mark.parametrize("delay_s", [0.05, 0.3])
def test_a_pump_much_stronger_than_assumed_is_a_line_of_its_size(delay_s: float) -> None:
    bench = Bench(pump_share=3.5, pump_delay_s=delay_s, identify=True, assumed=True)
    for seed in range(5):
        pump = bench.run_test(seed)[0].stronger_pump
        assert pump is not None
        # at the test's command it gives what the stronger pump does
        assert 0.8 * pump.flow_full_um_per_s == pytest.approx(3.5 * 5.3 * 0.7 / 0.9, rel=0.15)
        assert pump.dead_fraction == pump.start_fraction == pump.stall_fraction == 0.0
        assert replace(bench, assumed=False).run_test(seed)[0].stronger_pump is None
        assert replace(bench, pump_share=1.1).run_test(seed)[0].stronger_pump is None


@pytest.mark.parametrize(
    "pump",
    [
        pytest.param(ForeignPump("root", 16.0, 0.05, 0.1), id="first percent gives more than leak"),
        pytest.param(ForeignPump("quadratic", 2.3, 0.1, 0.2), id="weak"),
    ],
)
def test_a_hold_of_an_unknown_pump_begins_with_the_defaults(pump: ForeignPump) -> None:
    config = leave_to_start(foreign_config(rate_hz=10.0))
    assert config.states.actuator_size == "any"
    run = VirtualRun(config, foreign_bench(ForeignPlant(pump, 5)), zernike_projection())
    ticks = [run.run_tick((Command("hold", "test"),))]
    while run.now_s < 100.0 and run.finished is None:
        ticks.append(run.run_tick())
    assert ticks[-1] is not None
    assert ticks[-1].row.state == State.HOLD
    events = [event for tick in ticks if tick is not None for event in tick.events]
    found = [event for event in events if isinstance(event, PumpStronger)]
    assert len(found) == (pump.shape == "root")
    assert run.loop_config.flow_max_um_per_s == pytest.approx(run.pump_config.flow_full_um_per_s)
    assert run.pump_config.flow_full_um_per_s == (
        found[0].flow_full_um_per_s if found else config.pump.flow_full_um_per_s
    )


def test_a_stated_curve_keeps_its_limits() -> None:
    config = leave_to_start(Config(pump=PumpConfig(flow_full_um_per_s=5.3)))
    assert config.states.actuator_size == "stated"
    proportional = PumpConfig(dead_fraction=0.0, start_fraction=0.0, stall_fraction=0.0)
    assert leave_to_start(Config(pump=proportional)).states.actuator_size == "any"


@pytest.mark.parametrize(
    "error_um",
    [
        lambda time_s: -20.0 * (0.5 < time_s < 0.9),  # everything off
        lambda time_s: -20.0 * (1.4 < time_s < 1.7),  # the vent is open
        lambda time_s: -20.0 * (time_s > 3.3),  # the pump runs: looks like a reversed one
    ],
    ids=["off", "vent", "pump"],
)
def test_something_in_the_beam_is_no_failure(error_um: Error) -> None:
    assert Bench(error_um=error_um).failures(40) == []


@pytest.mark.parametrize("ends_s", [3.4, math.inf])
def test_something_in_the_beam_is_no_response(ends_s: float) -> None:
    bench = Bench(pump_share=0.0, error_um=lambda time_s: 20.0 * (2.9 < time_s < ends_s))
    assert len(bench.failures(60)) >= 58


@pytest.mark.parametrize("jump_um", [-60.0, -20.0, -8.0, 8.0, 20.0, 60.0])
@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 50.0])
def test_one_jump_of_the_laser_is_no_failure(rate_hz: float, jump_um: float) -> None:
    """Taken for noise, a jump would make every later response unclear."""
    failures = []
    for at_s in np.arange(0.05, 4.0, 0.15):
        bench = Bench(rate_hz, error_um=lambda t, at_s=at_s: jump_um * (t > at_s))  # type: ignore[misc]
        failures += bench.failures(3)
    assert failures == []


def test_a_film_that_jumps_with_everything_off_is_named() -> None:
    bench = Bench(error_um=lambda time_s: 20.0 * (math.fmod(time_s, 0.6) < 0.3))
    assert bench.failures(5) == ["its readings jump by micrometres with pump and vent off"] * 5


def test_an_actuator_test_continues_from_its_memory() -> None:
    """As after each tick, and from a snapshot."""
    pump = PumpConfig()
    rng = np.random.default_rng(2)
    whole, memory = ActuatorTest(pump, True, 50.0), ActuatorTestState(pump, True)
    for number in range(250):
        reading_um = 0.01 * number + float(rng.standard_normal())
        whole.step(reading_um, 0.02)
        memory = decode_state(encode_state(memory), ActuatorTestState, 1_000_000)
        part = ActuatorTest(memory.pump, memory.test_vent, 50.0, memory=memory)
        part.step(reading_um, 0.02)
        assert (part.part, part.failure) == (whole.part, whole.failure)
    assert whole.failure


@pytest.mark.parametrize(
    ("delay_s", "lag_s", "longest_s"),
    [(0.1, 0.15, 10.0), (0.3, 0.5, 10.0), (0.4, 0.8, 11.0), (1.0, 1.0, 11.0), (0.0, 2.0, 11.0)],
)
@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
def test_the_pump_is_identified_at_a_start(
    rate_hz: float, delay_s: float, lag_s: float, longest_s: float
) -> None:
    """Also behind a vent that closes slowly, and within the time that the test may take."""
    bench = Bench(rate_hz, pump_delay_s=delay_s, pump_lag_s=lag_s, vent_lag_s=0.25, identify=True)
    scores = []
    for seed in range(12):
        test, time_s = bench.run_test(seed)
        assert test.failure == ""
        assert time_s <= longest_s * (50.0 / rate_hz) ** (1 / 3) + 0.2
        assert test.response is not None
        # the bench holds a flow for half of its own step more than the pump does
        error_s = test.response.sum_s - delay_s - lag_s - 0.5 / rate_hz / _SUBSTEPS
        scores.append(error_s / test.response.sum_sigma_s)
    assert np.mean(np.abs(scores) < 2.5) >= 0.8


def test_identification_costs_two_seconds_on_a_quick_bench() -> None:
    quick = Bench(identify=True)
    assert np.median(quick.durations_s(20)) == pytest.approx(5.56, abs=0.03)
    assert quick.failures(20) == []


@pytest.mark.parametrize("dead", [{"pump_share": 0.0}, {"pump_share": -1.0}])
def test_identification_delays_no_failure(dead: dict[str, float]) -> None:
    plain = replace(Bench(), **dead)
    assert [plain.run(seed) for seed in range(6)] == [
        replace(plain, identify=True).run(seed) for seed in range(6)
    ]


def test_a_hand_in_the_beam_gives_no_response_and_is_no_failure() -> None:
    bench = Bench(identify=True, error_um=lambda time_s: 30.0 * (4.2 < time_s < 4.6))
    for seed in range(10):
        test, _ = bench.run_test(seed)
        assert test.failure == ""
        if test.response is not None:
            assert abs(test.response.sum_s - 0.25) < 4 * test.response.sum_sigma_s


SLOW_PUMPS = {
    "0.3 + 0.5 s": ForeignPump(delay_s=0.3, lag_s=0.5),
    "0.4 + 0.8 s": ForeignPump(delay_s=0.4, lag_s=0.8),
    "s-shaped, 0.5 + 1 s": ForeignPump("s-shaped", delay_s=0.5, lag_s=1.0),
}


@pytest.mark.fast_cases("0.3 + 0.5 s", "s-shaped, 0.5 + 1 s")
@pytest.mark.parametrize("name", SLOW_PUMPS)
def test_a_hold_starts_with_a_slow_pump_of_another_world(name: str) -> None:
    for seed in range(2):
        config = leave_to_start(foreign_config())
        assert config.states.actuator_test
        bench = foreign_bench(ForeignPlant(replace(SLOW_PUMPS[name], _tube=deque()), seed))
        run = VirtualRun(config, bench, zernike_projection())
        ticks = [run.run_tick((Command("hold", "test"),))]
        while run.now_s < 20.0 and run.finished is None:
            ticks.append(run.run_tick())
        states = [tick.row.state for tick in ticks if tick is not None]
        assert State.INFLATE in states, seed
        assert State.FAULT not in states, seed
        events = [event for tick in ticks if tick is not None for event in tick.events]
        (found,) = (event for event in events if isinstance(event, PumpResponseFound))
        pump = SLOW_PUMPS[name]
        assert abs(found.sum_s - pump.delay_s - pump.lag_s) < 3.5 * found.sum_sigma_s


@pytest.mark.parametrize(
    "rate_hz", [5.0, 10.0, 20.0, pytest.param(50.0, marks=pytest.mark.campaign)]
)
def test_the_film_of_the_twin_passes_at_any_rate(rate_hz: float) -> None:
    for seed in range(12):
        config = Config(
            loop=LoopConfig(rate_hz=rate_hz),
            twin=TwinConfig(seed=seed),
            shape=ShapeConfig(enabled=False),
        )
        rows = [
            t.row
            for t in run_virtual(
                config, Plant(config.twin, config.pump), 14.0, zernike_projection()
            )
        ]
        assert any(row.state == State.INFLATE for row in rows), seed


@pytest.mark.parametrize("rate_hz", [10.0, 25.0, pytest.param(100.0, marks=pytest.mark.campaign)])
@pytest.mark.parametrize(
    "wrong", [{"pump_share": 0.0}, {"vent_stuck_fraction": 0.0}], ids=["pump", "vent"]
)
def test_the_twin_is_not_inflated_with_a_dead_actuator_at_any_rate(
    rate_hz: float, wrong: dict[str, float]
) -> None:
    config = Config(loop=LoopConfig(rate_hz=rate_hz), shape=ShapeConfig(enabled=False))
    for seed in range(6):
        twin = config.twin.model_copy(update={"seed": seed})
        bench = VirtualBench(Plant(twin, config.pump))
        for name, value in wrong.items():
            setattr(bench.wrong, name, value)
        run = VirtualRun(config, bench, zernike_projection())
        ticks = [run.run_tick((Command("hold", "test"),))]
        while run.now_s < 25.0 and run.finished is None:
            ticks.append(run.run_tick())
        states = {tick.row.state for tick in ticks if tick is not None}
        assert State.INFLATE not in states, seed


def test_a_slow_pump_is_held_from_the_first_start_with_limited_gains() -> None:
    """Stated gains of a quick pump swing behind 1 s of dead time and 1.5 s of lag."""
    config = leave_to_start(foreign_config(rate_hz=10.0))
    config = config.model_copy(
        update={"estimator": config.estimator.model_copy(update={"process_value": "laser"})}
    )
    errors_um = []
    for limited in (True, False):
        plant = ForeignPlant(ForeignPump(delay_s=1.0, lag_s=1.5), 3)
        run = VirtualRun(config, foreign_bench(plant), zernike_projection())
        ticks = [run.run_tick((Command("hold", "test"),))]
        while run.now_s < 200.0 and run.finished is None:
            found = [e for t in ticks[-1:] if t for e in t.events if isinstance(e, GainsLimited)]
            if found and not limited:
                ticks.append(run.run_tick((Command("gains", "test", loop=config.loop),)))
            ticks.append(run.run_tick())
        rows = [tick.row for tick in ticks if tick is not None and tick.row.mono_s > 60.0]
        errors_um.append(float(np.std([row.truth_displacement_um for row in rows])))
        events = [event for tick in ticks if tick is not None for event in tick.events]
        (event,) = (event for event in events if isinstance(event, GainsLimited))
        assert 0.1 < event.kp_per_s < 0.3
        assert event.ti_s > 12.0
        status = RunStatus()
        for each in events:
            status = status.after_event(each)
        assert status.loop is not None
        assert (status.loop["kp_per_s"] == event.kp_per_s) == limited
    assert errors_um[0] < 0.6
    assert errors_um[1] > 2 * errors_um[0]


@pytest.mark.parametrize("delay_s", [0.05, 0.1])
def test_a_quick_pump_keeps_the_stated_gains(delay_s: float) -> None:
    response = PumpResponse(delay_s, 0.15, 0.03, 0.03, 0.05)
    stated = LoopConfig()
    assert limit_gains(stated, response) is stated


def test_limited_gains_keep_their_margins_at_any_response() -> None:
    for sum_s in (0.1, 0.5, 1.0, 3.0):
        for share in (0.1, 0.5, 0.9):
            response = PumpResponse(share * sum_s, (1 - share) * sum_s, 0.1, 0.1, 0.1 * sum_s)
            loop = limit_gains(LoopConfig(kp_per_s=5.0, ti_s=0.5), response)
            assert loop.kp_per_s * find_dead_time_s(loop, response) <= 0.5 + 1e-9
            assert loop.ti_s >= 8.0 * find_dead_time_s(loop, response) - 1e-9


def test_the_error_bar_of_a_quick_pump_holds_at_ten_ticks_a_second() -> None:
    """Where dead time and lag come out too small, their error must not."""
    bench = Bench(10.0, vent_lag_s=0.25, identify=True)
    scores = []
    for seed in range(40):
        response = bench.run_test(seed)[0].response
        assert response is not None
        scores.append((response.sum_s - 0.255) / response.sum_sigma_s)
    assert np.mean(np.abs(scores) < 2.0) >= 0.9
    assert np.sqrt(np.mean(np.square(scores))) > 0.7  # nor is it too wide


def test_a_later_start_that_finds_a_slower_pump_slows_the_loop_further() -> None:
    """Also after the first start has limited the gains; gains that a person has set stay."""
    config = foreign_config(rate_hz=10.0)
    for set_by_person in (False, True):
        limited = find_limited_gains(config, set_by_person)
        assert len(limited) == (1 if set_by_person else 2)
        if not set_by_person:
            assert limited[1].kp_per_s < 0.7 * limited[0].kp_per_s


def find_limited_gains(config: Config, set_by_person: bool) -> list[GainsLimited]:
    """What three starts limit, of which the last two find a slower pump."""
    controller = Controller(leave_to_start(config), zernike_projection())
    slow = PumpResponse(0.5, 0.5, 0.05, 0.05, 0.05)
    slower = PumpResponse(1.0, 1.5, 0.1, 0.1, 0.1)
    events: list[Event] = []
    for response in (slow, slower, slow):
        controller._context.found_response = response
        controller._use_response(events)
        if set_by_person:
            command = Command("gains", "test", loop=config.loop)
            controller._gains.begin(config.loop.model_copy(update={"ti_s": 9.0}), command, 0.0)
    return [event for event in events if isinstance(event, GainsLimited)]
