"""A sensor fails in virtual time: protections use the others, and the true mirror is judged."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet

from membrane_ctrl.config.schema import (
    Config,
    EstimatorConfig,
    LimitsConfig,
    LoopConfig,
    ShapeConfig,
    StatesConfig,
    TwinConfig,
)
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import (
    ExperimentEnded,
    Fault,
    Maintenance,
    MaintenanceOver,
    Plausibility,
)
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench, Wrong
from tests.worlds.copied_bench import Originals

RATE_HZ = 10.0
Spoil = Callable[
    [float, ShapeEstimate], ShapeEstimate | None
]  # seconds since the failure, the figure
Fail = Callable[[Wrong, float], None]  # switches of the bench, seconds since the failure
MANUAL_RANGE_UM = StatesConfig().manual_range_um


# The loop follows the estimate; or the laser, as the pump's response is not known.
AUTO = ("auto", "auto, by the laser")


def config_of(process_value: str, **tables: object) -> Config:
    """A quiet bench with figures at the tick rate."""
    value, *how = process_value.split(", ")
    estimator = {"process_value": value, "pump_response": "identified" if how else "stated"}
    states = tables.pop("states", StatesConfig())
    assert isinstance(states, StatesConfig)
    return Config.model_validate(
        {
            "loop": LoopConfig(rate_hz=RATE_HZ),
            "shape": ShapeConfig(mode="track", track_rate_hz=RATE_HZ),
            "estimator": EstimatorConfig.model_validate(estimator),
            "twin": TwinConfig(
                scenario="quiet", start_error_um=-1.0, laser=process_value != "optics"
            ),
            "states": states.model_copy(update={"actuator_test": not how}),
            **tables,
        }
    )


def unspoiled(since_s: float, figure: ShapeEstimate) -> ShapeEstimate:
    return figure


@dataclass
class Bench:
    """A held mirror of which one sensor will fail."""

    config: Config
    settle_s: float
    spoil: Spoil = unspoiled
    exchange_s: float = math.inf  # how long the loop follows either of laser and estimate

    def __post_init__(self) -> None:
        self.bench = VirtualBench(Plant(self.config.twin, self.config.pump))
        self._figures = TruthShape(self.bench, self.config, 3, 0.036)
        self._failed_s = math.inf
        self.run = VirtualRun(self.config, self.bench, zernike_projection(), self._figure)
        self.ticks: list[VirtualTick] = []
        tick = self.run.run_tick((Command("hold", "a test"),))
        while tick is not None and State(int(tick.row.state)) != State.HOLD:
            tick = self.run.run_tick()
        self._pass(self.settle_s, lambda wrong, since_s: None)
        self.ticks.clear()

    def _figure(self, now_s: float) -> ShapeEstimate | None:
        figure = self._figures(now_s)
        if figure is None or now_s < self._failed_s:
            return figure
        return self.spoil(now_s - self._failed_s, figure)

    def _pass(self, seconds: float, fail: Fail) -> None:
        begins_s = self.run.now_s
        while self.run.now_s < begins_s + seconds - 1e-6 and self.run.finished is None:
            since_s = self.run.now_s - begins_s
            fail(self.bench.wrong, since_s)
            if math.isfinite(self.exchange_s):
                decision = self.run._supervisor._controller.memory.process_value
                decision.follows_estimate = since_s % (2 * self.exchange_s) < self.exchange_s
            tick = self.run.run_tick()
            assert tick is not None
            self.ticks.append(tick)

    def command(self, command: Command) -> None:
        """Give a command, and let it take effect."""
        tick = self.run.run_tick((command,))
        assert tick is not None
        self.run.run_tick()

    def fail(self, seconds: float, fail: Fail = lambda wrong, since_s: None) -> Bench:
        """Let the sensor fail for a while, or until the run ends; afterwards the outcome can be
        read.
        """
        self._failed_s = self.run.now_s
        self.start_um = self.bench.plant.truth().displacement_um
        self._pass(seconds, fail)
        return self

    @property
    def moved_um(self) -> float:
        """Largest distance of the true centre from where it was, until the pump was taken off."""
        moved_um = 0.0
        for tick in self.ticks:
            if tick.row.state == State.FAULT:
                break
            moved_um = max(moved_um, abs(tick.row.truth_displacement_um - self.start_um))
        return moved_um

    @property
    def state(self) -> State:
        """The last state."""
        return State(int(self.ticks[-1].row.state))

    def events_of(self, kind: type) -> list[object]:
        """The events of a kind."""
        return [event for tick in self.ticks for event in tick.events if isinstance(event, kind)]

    @property
    def faults(self) -> list[str]:
        """Names of the faults, in order."""
        return [event.name for event in self.events_of(Fault)]  # type: ignore[attr-defined]

    @property
    def notices(self) -> list[str]:
        """Names of the notices, in order."""
        return [event.name for event in self.events_of(Maintenance)]  # type: ignore[attr-defined]


_SETTLED = Originals[Bench]()


def settled(config: Config, spoil: Spoil = unspoiled, settle_s: float = 45.0) -> Bench:
    """A mirror that has been held for this long."""
    bench = _SETTLED.copy_of((config.model_dump_json(), settle_s), lambda: Bench(config, settle_s))
    bench.spoil = spoil
    return bench


def lose_laser(wrong: Wrong, since_s: float) -> None:
    wrong.no_light = True


def stick_laser(wrong: Wrong, since_s: float) -> None:
    wrong.laser_stuck = True


def drifting(um_per_s: float) -> Spoil:
    return lambda since_s, figure: replace(figure, sag_um=figure.sag_um + um_per_s * since_s)


def frozen() -> Spoil:
    """The first figure again and again, with fresh noise."""
    rng = np.random.default_rng(5)
    first: list[float] = []

    def spoil(since_s: float, figure: ShapeEstimate) -> ShapeEstimate:
        first.append(figure.sag_um)
        return replace(figure, sag_um=first[0] + 0.036 * rng.standard_normal())

    return spoil


@pytest.mark.parametrize("lose", [lose_laser, stick_laser], ids=["lost", "stuck"])
@pytest.mark.parametrize("flow_um_per_s", [5.0, 0.0])
def test_manual_flow_stays_within_its_range_when_the_laser_fails(
    lose: Fail, flow_um_per_s: float
) -> None:
    held = settled(config_of("estimate"))
    held.command(Command("manual", "a test", value=flow_um_per_s))
    held.fail(60.0, lose)
    assert held.moved_um < MANUAL_RANGE_UM + 10.0
    assert held.state in (State.INFLATE, State.SETTLE, State.HOLD)
    assert held.faults == []


@pytest.mark.parametrize("process_value", ["estimate", *AUTO, "optics"])
def test_manual_flow_with_frozen_figures_is_stopped_by_the_gauge(process_value: str) -> None:
    held = settled(config_of(process_value), frozen())
    held.command(Command("manual", "a test", value=5.0))
    held.fail(60.0, lose_laser)
    assert held.faults == ["laser_gauge_apart"]
    assert held.moved_um < 65.0


def test_the_displacement_limit_holds_by_the_optics_when_the_laser_is_lost() -> None:
    limits = LimitsConfig(displacement_max_um=30.0)
    held = settled(config_of("estimate", limits=limits))
    held.command(Command("manual", "a test", value=5.0))
    held.fail(40.0, lose_laser)
    assert held.faults == ["over_displacement"]
    assert held.moved_um < 36.0


@pytest.mark.parametrize("um_per_s", [-5.0, -1.0, -0.5, 1.0])
def test_drifting_optics_that_hold_without_a_laser_are_stopped_by_the_gauge(
    um_per_s: float,
) -> None:
    held = settled(config_of("estimate"), drifting(um_per_s)).fail(200.0, lose_laser)
    assert held.faults == ["laser_gauge_apart"]
    assert held.moved_um < 65.0
    assert held.notices[0] == "laser_lost"
    assert held.state == State.FAULT


def test_the_loss_of_the_laser_is_reported_at_once_and_its_return_too() -> None:
    def lose(wrong: Wrong, since_s: float) -> None:
        wrong.no_light = 5.0 < since_s < 20.0

    held = settled(config_of("estimate")).fail(40.0, lose)
    times_s = [
        t.row.mono_s - held.ticks[0].row.mono_s
        for t in held.ticks
        for e in t.events
        if isinstance(e, Maintenance)
    ]
    assert held.notices == ["laser_lost"]
    assert times_s[0] == pytest.approx(7.0, abs=0.3)
    (notice,) = held.events_of(Maintenance)
    assert notice.message.startswith("the laser is lost; optics and gauge are left")  # type: ignore[attr-defined]
    assert [event.name for event in held.events_of(MaintenanceOver)] == ["laser_lost"]  # type: ignore[attr-defined]
    assert held.faults == []


def test_short_laser_dropouts_are_not_reported() -> None:
    def blink(wrong: Wrong, since_s: float) -> None:
        wrong.no_light = since_s % 10.0 < 1.0

    assert settled(config_of("estimate")).fail(40.0, blink).notices == []


@pytest.mark.parametrize("process_value", ["laser", "estimate", *AUTO, "optics"])
def test_a_pause_with_frozen_sensors_ends_in_the_safe_state(process_value: str) -> None:
    """The weather moves the film after the pause; what the loop follows shows nothing of it."""
    held = settled(config_of(process_value, states=StatesConfig(pause_max_s=20.0)), frozen())
    held.command(Command("pause", "a test"))

    def fail(wrong: Wrong, since_s: float) -> None:
        wrong.no_light = process_value in ("estimate", *AUTO)
        wrong.pump_share = 0.5  # a pump that gives half of its flow, so that the film must sink
        if process_value == "laser":  # it shows its place with noise, whatever the film does
            wrong.laser_offset_um = held.start_um - held.bench.plant.truth().displacement_um

    held.fail(300.0, fail)
    assert held.moved_um < 65.0
    assert held.state == State.FAULT


@pytest.mark.parametrize(
    "spoil",
    [
        lambda since_s, figure: replace(figure, sag_change_sigma_um=math.nan),
        lambda since_s, figure: replace(figure, sag_change_sigma_um=1e3),
        lambda since_s, figure: replace(figure, sag_change_sigma_um=-1.0),
        lambda since_s, figure: replace(figure, time_s=math.nan),
        lambda since_s, figure: replace(figure, time_s=figure.time_s + 5.0),
        lambda since_s, figure: replace(figure, time_s=figure.time_s - 30.0),
        lambda since_s, figure: replace(figure, sag_um=math.nan),
    ],
    ids=["sigma nan", "sigma huge", "sigma negative", "time nan", "future", "late", "sag nan"],
)
@pytest.mark.parametrize("process_value", ["estimate", *AUTO, "optics"])
def test_a_figure_that_cannot_be_used_counts_as_missing(spoil: Spoil, process_value: str) -> None:
    held = settled(config_of(process_value), spoil).fail(40.0, lose_laser)
    first = "film_unseen" if process_value == "optics" else "displacement_missing"
    assert held.faults[0] == first
    assert held.moved_um < 10.0
    assert held.state == State.FAULT


@pytest.mark.parametrize("exchange_s", [0.1, 1.0, 7.0])
def test_no_protection_is_lost_while_laser_and_estimate_exchange_the_loop(
    exchange_s: float,
) -> None:
    def knock(wrong: Wrong, since_s: float) -> None:
        wrong.laser_offset_um = 15.0

    by_estimate = settled(config_of("estimate")).fail(60.0, knock)
    exchanged = settled(config_of("auto"))
    exchanged.exchange_s = exchange_s
    exchanged.fail(60.0, knock)
    assert exchanged.faults == by_estimate.faults == []
    assert exchanged.moved_um < by_estimate.moved_um + 1.0

    lost = settled(config_of("auto"))
    lost.exchange_s = exchange_s
    lost.fail(40.0, lose_laser)
    assert lost.faults == []
    assert lost.moved_um < 1.0

    blind = settled(config_of("auto"), lambda since_s, figure: None)
    blind.exchange_s = exchange_s
    blind.fail(40.0, lose_laser)
    assert blind.faults[0] == "displacement_missing"
    assert blind.state == State.FAULT
    assert blind.moved_um < 10.0


@pytest.mark.parametrize("um_per_s", [-0.05, pytest.param(0.05, marks=pytest.mark.campaign)])
def test_slow_drift_of_the_optics_is_outvoted_by_laser_and_gauge(um_per_s: float) -> None:
    held = settled(config_of("estimate"), drifting(um_per_s)).fail(1200.0)
    assert [event.faulty for event in held.events_of(Plausibility)] == ["optics"]  # type: ignore[attr-defined]
    assert held.moved_um < 40.0
    assert held.faults == []
    assert (
        abs(held.ticks[-1].row.truth_displacement_um - held.start_um) < 20.0
    )  # most of it is undone


def test_laser_and_optics_cannot_differ_by_more_than_the_trim_limit() -> None:
    shape = ShapeConfig(mode="track", track_rate_hz=RATE_HZ, trim_max_um=10.0)
    held = settled(config_of("estimate", shape=shape), drifting(0.03)).fail(700.0)
    assert "trim_limit" in held.notices
    assert held.moved_um < 14.0


def test_an_experiment_ends_when_the_laser_that_it_measures_with_is_lost() -> None:
    held = settled(config_of("estimate"))
    spec = ExperimentSpec(
        kind="relay", duration_s=60.0, limit_um=8.0, holding_flow_um_per_s=1.24, laser_um=1.0
    )
    held.command(Command("tune", "a test", experiment=spec))
    held.fail(20.0, lose_laser)
    (ended,) = held.events_of(ExperimentEnded)
    assert not ended.completed  # type: ignore[attr-defined]
    assert held.moved_um < 10.0
    assert held.state == State.HOLD


def test_gas_consumption_is_judged_while_only_the_optics_show_the_film_at_rest() -> None:
    limits = LimitsConfig(laser_gauge_apart_max_um=400.0)

    def fail(wrong: Wrong, since_s: float) -> None:
        wrong.no_light = True
        wrong.vent_stuck_fraction = 0.02  # the film takes 2 µm/s more

    held = settled(config_of("estimate", limits=limits), settle_s=130.0).fail(180.0, fail)
    assert held.faults == ["gas_excess"]


def test_a_hold_inflates_again_by_the_optics_after_manual_flow() -> None:
    held = settled(config_of("estimate"))
    held.command(Command("manual", "a test", value=0.0))
    held.fail(20.0, lose_laser)
    held.command(Command("hold", "a test"))
    held.ticks.clear()
    held._pass(40.0, lose_laser)
    assert held.state == State.HOLD
    assert held.ticks[-1].row.safe_level == SafeLevel.NONE
    assert abs(held.ticks[-1].row.truth_displacement_um - held.start_um) < 2.0


def stepping(um: float) -> Spoil:
    return lambda since_s, figure: replace(figure, sag_um=figure.sag_um + um)


RELAY = ExperimentSpec(
    kind="relay", duration_s=60.0, limit_um=8.0, holding_flow_um_per_s=1.24, laser_um=1.0
)
UNDERTAKINGS = {
    "hold": Command("mark", "a test", text="nothing"),
    "setpoint": Command("setpoint", "a test", value=40.0),
    "tune": Command("tune", "a test", experiment=RELAY),
    "manual": Command("manual", "a test", value=1.24),
    "pause": Command("pause", "a test"),
}


def _mark_every_other(*parameters: Iterable[object]) -> list[ParameterSet]:
    """All combinations: half of them, with each pair of the first and the last, run fast; the
    others belong to the campaign.
    """
    *first, last = (list(values) for values in parameters)
    found = []
    for number, chosen in enumerate(itertools.product(*first)):
        for place, value in enumerate(last):
            marks = () if (number + place) % 2 == 1 else (pytest.mark.campaign,)
            found.append(pytest.param(*chosen, value, marks=marks))
    return found


@pytest.mark.parametrize(
    ("undertaking", "spoil"),
    _mark_every_other(
        UNDERTAKINGS, [drifting(-5.0), drifting(1.0), stepping(-150.0), stepping(30.0)]
    ),
)
def test_wrong_optics_are_outvoted_whatever_the_hold_does(undertaking: str, spoil: Spoil) -> None:
    """Laser and gauge are sound; without a comparison while the film moves the loop follows the
    optics.
    """
    held = settled(config_of("estimate"), spoil)
    held.command(UNDERTAKINGS[undertaking])
    held.fail(90.0)
    assert "optics" in [event.faulty for event in held.events_of(Plausibility)]  # type: ignore[attr-defined]
    way_um = 40.0 if undertaking == "setpoint" else 0.0
    moved_um = np.array([tick.row.truth_displacement_um for tick in held.ticks]) - held.start_um
    assert moved_um.max() < way_um + 35.0
    assert moved_um.min() > -35.0
    assert held.faults == []


@pytest.mark.parametrize("process_value", ["laser", "estimate", *AUTO])
def test_a_wrong_laser_ends_an_experiment(process_value: str) -> None:
    held = settled(config_of(process_value))
    held.command(UNDERTAKINGS["tune"])

    def drift(wrong: Wrong, since_s: float) -> None:
        wrong.laser_offset_um = 2.0 * since_s

    held.fail(40.0, drift)
    assert held.events_of(ExperimentEnded)
    assert held.moved_um < 65.0


def test_an_experiment_ends_when_the_laser_that_it_measures_with_is_outvoted() -> None:
    """The laser moves slowly and within the experiment's own limit: only optics and gauge show it,
    and what it measures must not count.
    """
    held = settled(config_of("estimate"))
    slow = RELAY.model_copy(update={"duration_s": 200.0, "limit_um": 30.0})
    held.command(Command("tune", "a test", experiment=slow))

    def drift(wrong: Wrong, since_s: float) -> None:
        wrong.laser_offset_um = 0.3 * since_s

    held.fail(150.0, drift)
    assert "laser" in [event.faulty for event in held.events_of(Plausibility)]  # type: ignore[attr-defined]
    (ended,) = held.events_of(ExperimentEnded)
    assert ended.end == "reading_lost"  # type: ignore[attr-defined]
    assert held.faults == []


def test_figures_of_another_mirror_count_as_missing() -> None:
    held = settled(
        config_of("estimate"), lambda since_s, figure: replace(figure, sag_um=-figure.sag_um)
    ).fail(20.0)
    assert held.notices == ["optics_lost"]
    assert held.moved_um < 2.0


@pytest.mark.parametrize(
    ("process_value", "undertaking", "shape"),
    _mark_every_other(
        ["laser", "estimate", *AUTO],
        UNDERTAKINGS,
        [ShapeConfig(mode="track", track_rate_hz=RATE_HZ), ShapeConfig()],
    ),
)
def test_sensors_without_faults_never_contradict_each_other(
    process_value: str, undertaking: str, shape: ShapeConfig
) -> None:
    held = settled(config_of(process_value, shape=shape))
    held.command(UNDERTAKINGS[undertaking])
    held.fail(80.0)
    assert held.events_of(Plausibility) == []
    assert held.faults == []
    assert held.notices == []


def alternating(um: float, period_s: float) -> Spoil:
    def spoil(since_s: float, figure: ShapeEstimate) -> ShapeEstimate:
        return replace(figure, sag_um=figure.sag_um + um * (since_s % period_s < period_s / 2))

    return spoil


def outlying(um: float, one_in: int) -> Spoil:
    rng = np.random.default_rng(1)

    def spoil(since_s: float, figure: ShapeEstimate) -> ShapeEstimate:
        return replace(figure, sag_um=figure.sag_um + um * (rng.random() < 1 / one_in))

    return spoil


@pytest.mark.parametrize(
    "spoil", [alternating(10.0, 2.0), outlying(15.0, 6)], ids=["alternating", "1 in 6"]
)
def test_optics_that_jump_repeatedly_are_excluded(spoil: Spoil) -> None:
    """Each step looks like a knock of the laser; together they led the mirror by hundreds of
    micrometres.
    """
    held = settled(config_of("estimate"), spoil).fail(150.0)
    assert "optics_unsteady" in held.notices
    assert held.moved_um < 30.0
    assert held.faults == []


def test_a_repeatedly_displaced_laser_does_not_move_the_film() -> None:
    def knock(wrong: Wrong, since_s: float) -> None:
        wrong.laser_offset_um = 45.0 if since_s % 20.0 < 10.0 else 0.0

    held = settled(config_of("estimate")).fail(300.0, knock)
    assert held.moved_um < 20.0
    assert "laser" in [event.faulty for event in held.events_of(Plausibility)]  # type: ignore[attr-defined]


def leak_more(wrong: Wrong, since_s: float) -> None:
    wrong.no_light = True
    wrong.vent_stuck_fraction = 0.004


def test_optics_that_the_estimate_does_not_use_replace_no_laser() -> None:
    """With the shape loop off the loop would follow a dead reckoning, and only the optics would be
    judged.
    """
    held = settled(config_of("estimate"))
    held.command(Command("shape_off", "a test"))
    held.fail(60.0, leak_more)
    assert held.faults[0] == "displacement_missing"
    assert held.state == State.FAULT
    assert held.moved_um < 30.0


def test_optics_that_were_outvoted_replace_no_laser() -> None:
    def fail(wrong: Wrong, since_s: float) -> None:
        if since_s > 60.0:
            leak_more(wrong, since_s)

    held = settled(config_of("estimate"), stepping(18.0)).fail(120.0, fail)
    assert held.faults[0] == "displacement_missing"
    assert held.moved_um < 30.0


def test_an_intermittent_laser_counts_as_missing() -> None:
    ticks = 0

    def seldom(wrong: Wrong, since_s: float) -> None:
        nonlocal ticks
        ticks += 1
        wrong.no_light = ticks % 19 != 0

    held = settled(config_of("estimate"), drifting(-5.0)).fail(70.0, seldom)
    assert held.moved_um < 100.0
    assert held.state == State.FAULT


def test_a_figure_that_the_shape_loop_cannot_use_is_a_fault_and_no_exception() -> None:
    held = settled(
        config_of("estimate"),
        lambda since_s, figure: replace(figure, coeffs_um=figure.coeffs_um[:5]),
    ).fail(5.0)
    assert held.faults == ["tick_error"]


def noisy_with_a_small_sigma() -> Spoil:
    rng = np.random.default_rng(6)
    return lambda since_s, figure: replace(
        figure, sag_um=figure.sag_um + 2.0 * rng.standard_normal(), sag_change_sigma_um=1e-3
    )


@pytest.mark.parametrize("process_value", ["estimate", *AUTO, "optics"])
def test_optics_that_are_left_out_as_unsteady_count_as_missing_without_a_laser(
    process_value: str,
) -> None:
    held = settled(config_of(process_value), noisy_with_a_small_sigma()).fail(80.0, lose_laser)
    first = "film_unseen" if process_value == "optics" else "displacement_missing"
    assert held.faults[0] == first
    messages = {event.name: event.message for event in held.events_of(Maintenance)}  # type: ignore[attr-defined]
    assert "no laser" in messages["optics_unsteady"]
    assert held.moved_um < 65.0
    assert held.state == State.FAULT


def test_unsteady_optics_beside_a_laser_leave_the_mirror_to_the_laser() -> None:
    held = settled(config_of("estimate"), noisy_with_a_small_sigma()).fail(60.0)
    messages = {event.name: event.message for event in held.events_of(Maintenance)}  # type: ignore[attr-defined]
    assert "the mirror follows the laser" in messages["optics_unsteady"]
    assert held.faults == []
    assert held.moved_um < 10.0


def test_the_fault_of_unsteady_optics_without_a_laser_names_them() -> None:
    held = settled(config_of("optics"), noisy_with_a_small_sigma()).fail(60.0)
    fault = held.events_of(Fault)[0]
    assert "jumps again and again" in fault.sentence  # type: ignore[attr-defined]
    assert "laser reading" not in fault.sentence  # type: ignore[attr-defined]


@pytest.mark.parametrize("flow_um_per_s", [None, 0.0, 5.0])
def test_figures_with_late_times_never_leave_the_mirror_to_the_prediction_alone(
    flow_um_per_s: float | None,
) -> None:
    def late(since_s: float, figure: ShapeEstimate) -> ShapeEstimate:
        return replace(figure, time_s=figure.time_s - 0.5)

    held = settled(config_of("optics"), late)
    if flow_um_per_s is not None:
        held.command(Command("manual", "a test", value=flow_um_per_s))
    held.fail(200.0)
    assert held.moved_um < 65.0


def freeze_laser_with_noise(held: Bench) -> Fail:
    """Let the laser show where the mirror was when it failed, with 1 µm of noise."""
    rng = np.random.default_rng(7)

    def freeze_with_noise(wrong: Wrong, since_s: float) -> None:
        moved_um = held.bench.plant.truth().displacement_um - held.start_um
        wrong.laser_offset_um = rng.standard_normal() - moved_um

    return freeze_with_noise


def test_healthy_optics_end_manual_flow_while_the_laser_is_frozen() -> None:
    held = settled(config_of("estimate"))
    held.command(Command("manual", "a test", value=5.0))
    held.fail(60.0, freeze_laser_with_noise(held))
    assert held.moved_um < 65.0


def test_the_displacement_limit_holds_by_the_optics_while_the_laser_is_frozen() -> None:
    held = settled(config_of("estimate", limits=LimitsConfig(displacement_max_um=30.0)))
    held.command(Command("manual", "a test", value=5.0))
    held.fail(40.0, freeze_laser_with_noise(held))
    assert held.faults == ["over_displacement"]
    assert held.moved_um < 36.0
