"""Short losses of the laser, and ticks that queue while a session computes, end no session."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.control.experiments.experiment import ExperimentEnd
from membrane_ctrl.control.experiments.spec import ExperimentSpec, PumpStep
from membrane_ctrl.controller.command import Command
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sessions.live_hold import HoldError, News
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_bench, foreign_config
from tuning.identification.pump_run import PumpRun
from tuning.identification.pump_survey import PumpSurvey
from tuning.rigs.hold_rig import HoldRig
from tuning.steps.identify import describe_gaps, describe_losses
from tuning.twin_hold import TwinHold

RATE_HZ = 50.0
STEPS = (
    PumpStep(fraction=0.0, duration_s=4.0),
    PumpStep(fraction=0.7, duration_s=2.0),
    PumpStep(fraction=0.0, duration_s=3.0),
)


class LossyHold(TwinHold):
    """A hold on a bench of the second world; the laser loses its reading in the given intervals,
    by the time since `begin_losses`.
    """

    def __init__(self, losses_s: list[tuple[float, float]]) -> None:
        self.losses_s = losses_s
        self.begin_s = math.inf
        plant = ForeignPlant(ForeignPump(), seed=5, weather=0.3)
        super().__init__(foreign_config(rate_hz=RATE_HZ), bench=foreign_bench(plant))

    def begin_losses(self) -> None:
        self.begin_s = self.bench.plant.time_s

    def _advance(self, ticks: int) -> News:
        found = News((), (), ())
        for _ in range(ticks):
            since_s = self.bench.plant.time_s - self.begin_s
            self.bench.wrong.no_light = any(low <= since_s < high for low, high in self.losses_s)
            more = super()._advance(1)
            found = News(
                found.rows + more.rows, found.events + more.events, found.shapes + more.shapes
            )
        return found


def make_spec(kind: str, duration_s: float, steps: tuple[PumpStep, ...] = ()) -> ExperimentSpec:
    return ExperimentSpec.model_validate(
        {
            "kind": kind,
            "duration_s": duration_s,
            "limit_um": 10.0,
            "holding_flow_um_per_s": 1.24,
            "laser_um": 1.0,
            "steps": steps,
        }
    )


def settled(losses_s: list[tuple[float, float]]) -> tuple[LossyHold, HoldRig]:
    link = LossyHold(losses_s)
    rig = HoldRig(link, "tester")
    rig.hold(20.0)
    link.begin_losses()
    return link, rig


@pytest.mark.parametrize("kind", ["relay", "doublets", "steps", "multisine", "pump_map"])
def test_80_ms_without_the_laser_end_no_experiment(kind: str) -> None:
    _, rig = settled([(2.0, 2.08), (4.0, 4.08), (6.5, 6.58)])
    steps = STEPS if kind == "pump_map" else ()
    rows, finished = rig.perform_ticks(make_spec(kind, 9.0 if kind != "pump_map" else 60.0, steps))
    assert finished.completed, finished
    assert rig.repeated == 0
    tune = [row for row in rows if row.state == State.TUNE]
    missing = [row for row in tune if math.isnan(row.filtered_um)]
    assert len(missing) >= 9
    # the experiment's own flow continues while nothing is read
    if kind == "pump_map":
        assert {round(row.pump_fraction, 6) for row in tune[1:]} <= {0.0, 0.7}


@pytest.mark.parametrize("kind", ["relay", "doublets", "steps", "multisine", "pump_map"])
def test_an_experiment_may_begin_in_a_tick_without_a_reading(kind: str) -> None:
    """Its command must be a number from the first tick on: another one latches a fault."""
    link, rig = settled([(0.0, 0.08)])
    steps = STEPS if kind == "pump_map" else ()
    rows, finished = rig.perform_ticks(make_spec(kind, 9.0 if kind != "pump_map" else 60.0, steps))
    assert finished.completed, finished
    first = next(row for row in rows if row.state == State.TUNE)
    assert math.isnan(first.filtered_um)
    assert all(math.isfinite(row.pump_fraction) for row in rows)
    assert link.rows[-1].state == State.HOLD


def test_an_experiment_whose_reading_was_lost_is_repeated_without_a_gap() -> None:
    link, rig = settled([(3.0, 4.5)])
    first = len(link.rows)
    rows, finished = rig.perform_ticks(make_spec("steps", 8.0))
    assert finished.completed
    assert rig.repeated == 1
    assert [row.tick for row in rows] == [row.tick for row in link.rows[first:]][: len(rows)]
    record = rig.record(rows)
    assert record.gaps_s == pytest.approx([1.5], abs=0.05)
    lossy = describe_losses(record, by_optics=False)
    assert lossy.startswith("the laser had no reading 1 times in ")
    assert f"{record.gaps_s[0]:.2f} s at the longest" in lossy
    assert np.isnan(record.displacement_um).sum() == pytest.approx(1.5 * RATE_HZ, abs=2)


def test_a_laser_that_is_lost_again_and_again_is_repeated_three_times() -> None:
    _, rig = settled([(8.0 * number, 8.0 * number + 0.6) for number in range(30)])
    _, finished = rig.perform_ticks(make_spec("relay", 30.0))
    assert finished.end is ExperimentEnd.READING_LOST
    assert rig.repeated == 3
    assert "check the laser" in finished.reason


def test_an_experiment_that_is_refused_during_a_loss_begins_after_it() -> None:
    link, rig = settled([(0.0, 1.2)])
    rig.ticks(0.6)  # in steps of half a second
    assert link.rows[-1].safe_level > 0
    _, finished = rig.perform_ticks(make_spec("steps", 5.0))
    assert finished.completed


def test_a_refusal_for_another_reason_stays_one() -> None:
    _, rig = settled([])
    with pytest.raises(HoldError, match="limit"):
        rig.perform_ticks(make_spec("steps", 5.0).model_copy(update={"limit_um": 0.5}))


class ComputingHold(LossyHold):
    """A hold whose ticks go on for a while before each experiment, as while a session fits."""

    def send_command(self, command: Command) -> None:
        if command.kind == "tune":
            self._early = self._advance(round(40.0 * RATE_HZ))
        super().send_command(command)


def test_ticks_that_queued_before_the_request_do_not_count_as_waiting() -> None:
    """40 s of hold at 50 Hz are 2000 ticks, four times as many as an answer may take."""
    link = ComputingHold([])
    rig = HoldRig(link, "tester")
    rig.hold(20.0)
    first = rig.ticks(0.02)[0].tick + 1
    rows, finished = rig.perform_ticks(make_spec("steps", 5.0))
    assert finished.completed
    assert rows[0].tick == first
    ticks = np.array([row.tick for row in rows])
    assert np.all(np.diff(ticks) == 1)


class DeafHold(LossyHold):
    """A hold that accepts experiments and begins none."""

    def send_command(self, command: Command) -> None:
        if command.kind != "tune":
            super().send_command(command)


def test_an_experiment_that_does_not_begin_is_reported() -> None:
    rig = HoldRig(DeafHold([]), "tester")
    rig.hold(2.0)
    with pytest.raises(HoldError, match="did not begin"):
        rig.perform_ticks(make_spec("steps", 5.0))


def test_a_record_without_a_gap_names_no_sensor() -> None:
    _, rig = settled([])
    assert describe_losses(rig.hold(1.0), by_optics=False) == ""


def test_a_rig_counts_the_losses_of_all_that_it_has_seen() -> None:
    """`tune pump` names a lossy sensor from them; its rounds are no record."""
    _, rig = settled([(1.0, 1.08), (3.0, 3.2), (8.0, 8.08)])
    assert rig.gaps_s == []
    before_s = rig.held_s
    rig.hold(2.0)
    rig.perform_ticks(make_spec("steps", 5.0))
    rig.hold(3.0)
    assert rig.gaps_s == pytest.approx([0.08, 0.2, 0.08], abs=0.021)
    assert rig.held_s - before_s == pytest.approx(10.0, abs=1.0)
    lossy = describe_gaps(rig.gaps_s, rig.held_s - before_s, by_optics=False)
    assert lossy.startswith("the laser had no reading 3 times in 1")
    assert describe_gaps([], 10.0, by_optics=False) == ""


def make_run(duration_s: float, ends_dark: bool) -> PumpRun:
    size = round(duration_s * 20.0)
    displacement_um = np.linspace(0.0, -1.24 * duration_s, size)
    if ends_dark:
        displacement_um[-8:] = np.nan
    return PumpRun(0.05, np.zeros(size), displacement_um, np.full(size, np.nan))


def test_a_survey_counts_only_runs_that_a_lost_laser_cut_short() -> None:
    survey = PumpSurvey(0.3)
    for _ in range(4):
        survey.add_run(make_run(40.0, ends_dark=True), completed=False)
    assert survey.dark == 0
    for _ in range(3):
        survey.add_run(make_run(2.0, ends_dark=True), completed=False)
    assert survey.dark == 3
    survey.add_run(make_run(2.0, ends_dark=False), completed=True)
    assert survey.dark == 0
