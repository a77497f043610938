"""The pump's curve on actuators of an unstated product: second world, defaults in the
configuration.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig, StatesConfig
from membrane_ctrl.config.toml_file import dump_toml, load_toml
from membrane_ctrl.control.experiments import operating_point
from membrane_ctrl.control.experiments.spec import ExperimentSpec, PumpStep
from membrane_ctrl.control.pump_curve import PumpCurve
from membrane_ctrl.controller.cross_check import cross_check
from membrane_ctrl.model.errors import Exit, RejectedError
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sessions.folder import SessionFolder, create_session, open_session
from tests.studies.pump_curve_error import worst_share
from tests.worlds.foreign_plant import (
    CURVES,
    ForeignPlant,
    ForeignPump,
    foreign_bench,
    foreign_config,
)
from tuning import twin_hold
from tuning.identification import experiments, fit_quality, plant_fit, pump_survey
from tuning.identification.closed_loop import Gains
from tuning.identification.curve_shape import Branch, find_first_jump, smooth_flows
from tuning.identification.margins import compute_margins
from tuning.identification.plant_model import PlantModel
from tuning.identification.pump_fit import FlowAt, PumpFit, fit_pump
from tuning.identification.pump_map import PumpMap
from tuning.identification.pump_run import Level, PumpRun
from tuning.identification.pump_survey import PumpSurvey
from tuning.rigs.hold_rig import HoldRig
from tuning.steps import map_pump
from tuning.twin_hold import TwinHold

DT_S = 0.1


def measured_run(
    pump: ForeignPump, commands: list[tuple[float, float]], seed: int = 1, leak: float = 1.2
) -> PumpRun:
    """What a mirror without weather shows of a series of (command, seconds); the pump held it
    before.
    """
    rng = np.random.default_rng(seed)
    pump.balance(leak)
    given = np.repeat([c for c, _ in commands], [round(s / DT_S) for _, s in commands])
    height, heights = 0.0, []
    for command in given:
        heights.append(height)
        height += sum(pump.step(command) - leak for _ in range(10)) * 0.01
    return PumpRun(
        DT_S,
        given,
        np.array(heights) + 0.3 * rng.standard_normal(given.size),
        np.full(given.size, math.nan),
    )


@pytest.mark.parametrize(("delay_s", "lag_s"), [(0.1, 0.1), (0.9, 0.4), (1.5, 0.5)])
def test_the_flow_at_each_command_behind_any_dead_time_and_lag(
    delay_s: float, lag_s: float
) -> None:
    pump = ForeignPump("quadratic", 7.0, delay_s, lag_s)
    cycle = [
        (0.0, 5.0),
        (0.8, 1.5),
        (0.0, 4.0),
        (0.6, 3.0),
        (0.0, 3.0),
        (0.4, 4.0),
        (1.0, 1.0),
        (0.0, 4.0),
    ]
    found = fit_pump([measured_run(pump, 4 * cycle, seed) for seed in (1, 2)])
    for command in (0.4, 0.6, 0.8, 1.0):
        at = found.levels[Level(command)]
        assert at.flow_um_per_s == pytest.approx(
            pump.settled(command), abs=max(4 * at.sigma_um_per_s, 0.1)
        )
        assert at.sigma_um_per_s < 0.15
    assert found.leak_um_per_s == pytest.approx(1.2, abs=0.1)
    assert found.delay_s + found.lag_s == pytest.approx(delay_s + lag_s, abs=0.1)


def test_a_level_reached_from_above_is_another_one() -> None:
    pump = ForeignPump("hysteretic", 6.0, play=0.05)
    cycle = [(0.0, 4.0), (0.5, 3.0), (0.0, 4.0), (0.8, 0.5), (0.5, 2.0)]
    found = fit_pump([measured_run(pump, 6 * cycle)])
    more = found.levels[Level(0.5, False)].flow_um_per_s - found.levels[Level(0.5)].flow_um_per_s
    assert more == pytest.approx(pump.settled(0, 0.55) - pump.settled(0, 0.45), abs=0.2)


def test_runs_without_readings_are_refused() -> None:
    with pytest.raises(ValueError, match="without readings"):
        fit_pump([PumpRun(DT_S, np.full(100, 0.3), np.full(100, math.nan), np.full(100, math.nan))])


def started(
    tmp_path: Path, plant: ForeignPlant, tests_actuators: bool = True, **loop: float
) -> tuple[TwinHold, HoldRig, SessionFolder]:
    """A session on a bench of the second world, in a hold with the default configuration."""
    config = foreign_config(**{"rate_hz": 20.0, **loop})
    states = StatesConfig(actuator_test=tests_actuators)
    link = TwinHold(config.model_copy(update={"states": states}), bench=foreign_bench(plant))
    rig = HoldRig(link, "tester")
    return (
        link,
        rig,
        create_session(tmp_path, "foreign", "tester", link.name, link.config, rig.loop),
    )


def mapped(tmp_path: Path, plant: ForeignPlant) -> tuple[PumpMap, TwinHold]:
    """A session's pump map."""
    link, rig, folder = started(tmp_path, plant)
    done, folder = map_pump.map_pump(folder, rig)
    assert (folder.head.before, folder.config.pump) == (rig.loop, done.found.pump)
    return done.found, link


@pytest.mark.campaign
def test_a_late_quadratic_pump_is_mapped(tmp_path: Path) -> None:
    """It stopped both the relay's fit ("stalls at small flows") and the former map ("too tight, or
    no pump").
    """
    pump = ForeignPump("quadratic", 7.0, 0.9, 0.3, start=0.2, stall=0.2)
    found, link = mapped(tmp_path, ForeignPlant(pump, laser_um=0.5, weather=0.5))
    assert worst_share(found, pump) < 0.03
    assert found.pump.curve_fraction[-1] == 1.0
    assert found.delay_s + found.lag_s == pytest.approx(1.2, abs=0.1)
    held = [row for row in link.rows if row.state in (State.HOLD, State.TUNE)]
    assert max(abs(row.truth_displacement_um) for row in held[2000:]) < 12.0
    assert (tmp_path / "tuning").exists()


@pytest.mark.campaign
def test_a_weak_pump_that_starts_steeply_is_mapped(tmp_path: Path) -> None:
    """The spline carried the certainty of no flow at command 0 into the dead zone: 0.3 µm/s where
    there is none.
    """
    pump = ForeignPump("root", 3.1, 0.22, 0.09)
    found, _ = mapped(tmp_path, ForeignPlant(pump, 20, 2.36, 2.1, laser_um=1.34))
    assert worst_share(found, pump) < 0.03


@pytest.mark.campaign
def test_a_pump_whose_first_percent_holds_the_mirror_is_mapped(tmp_path: Path) -> None:
    """The curve began at 0.06 with 0.85 µm/s, more than the leak, and the session was told to open
    the bleed.
    """
    pump = ForeignPump("root", 6.74, 0.45, 1.38)
    found, _ = mapped(tmp_path, ForeignPlant(pump, 141, 0.41, 0.57, laser_um=0.11))
    assert PumpCurve(found.pump).least_flow_um_per_s < 0.2
    assert worst_share(found, pump) < 0.03


@pytest.mark.campaign
def test_a_survey_holds_the_mirror_on_the_curve_so_far(tmp_path: Path) -> None:
    """With the line of the defaults the hold of a pump 15 times its leak swings by 20 µm, and was
    not surveyed. Its flow is 6 times what the defaults state, which the start test refuses.
    """
    pump = ForeignPump("root", 29.4, 0.25, 0.45)
    plant = ForeignPlant(pump, 25, 1.0, 2.0, laser_um=0.4)
    link, rig, _ = started(tmp_path, plant, tests_actuators=False)
    map_pump._calm_hold(rig, 10.0)
    assert worst_share(map_pump._survey_pump(rig, 10.0), pump) < 0.03
    late = [
        row for row in link.rows[len(link.rows) // 2 :] if row.state in (State.HOLD, State.TUNE)
    ]
    assert max(abs(row.truth_displacement_um) for row in late) < 12.0


@pytest.mark.campaign
@pytest.mark.parametrize("gusts", [False, True])
@pytest.mark.parametrize("shape", sorted(CURVES))
def test_every_actuator_is_mapped(tmp_path: Path, shape: str, gusts: bool) -> None:
    stiction = {"start": 0.22, "stall": 0.15} if shape == "straight" else {}
    pump = ForeignPump(
        shape, 6.0, 0.3, 0.2, play=0.04 if shape == "hysteretic" else 0.0, **stiction
    )
    found, _ = mapped(tmp_path, ForeignPlant(pump, gusts=gusts))
    assert worst_share(found, pump) < (0.05 if gusts else 0.03)
    assert bool(found.pump.curve_falling_um_per_s) == (shape == "hysteretic")


class ForeignHold(TwinHold):
    """What `--twin` starts: a hold on this plant; the bench of the last one can be broken."""

    plant: ForeignPlant
    last: ForeignHold
    stuck_fraction = math.nan

    def __init__(self, config: Config) -> None:
        super().__init__(config, bench=foreign_bench(self.plant))
        ForeignHold.last = self
        for _ in range(40):
            self.read_news()
        self.bench.wrong.pump_stuck_fraction = self.stuck_fraction

    def close(self) -> None:
        """The hold outlives its session."""


def tuned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    """Exit code of `tune` on that hold."""
    monkeypatch.setattr(twin_hold, "TwinHold", ForeignHold)
    config = tmp_path / "foreign.toml"
    config.write_text(dump_toml(foreign_config(rate_hz=20.0)))
    return run(["tune", *words, "--twin", "--config", str(config), "--logs", str(tmp_path)])


def test_a_stuck_pump_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It continues to give what holds the mirror, whatever is commanded."""
    ForeignHold.plant = ForeignPlant(ForeignPump("straight", 5.3), laser_um=0.5, weather=0.3)
    monkeypatch.setattr(ForeignHold, "stuck_fraction", 0.31)
    assert tuned(tmp_path, monkeypatch, "pump") == Exit.REJECTED
    message = capsys.readouterr().err
    assert "moves the same at every command" in message
    assert "Traceback" not in message
    link = ForeignHold.last
    assert link.rows[-1].state == State.HOLD
    link.bench.wrong.pump_stuck_fraction = math.nan
    for _ in range(240):
        link.read_news()
    assert all(
        abs(row.truth_displacement_um) < 3.0 for row in link.rows[-400:]
    )  # with the former gains and curve


def survey_of(
    fractions: list[float], flows: list[float], leak: float, delay_s: float = 0.1
) -> PumpSurvey:
    """A survey that has found these flows at these commands, to 3 % and 0.05 µm/s."""
    found = PumpSurvey(0.15, runs=[PumpRun(DT_S, *np.zeros((3, 1)))])
    sigmas = [0.03 * flow + 0.05 for flow in flows]
    levels = {Level(f): FlowAt(*at) for f, *at in zip(fractions, flows, sigmas, strict=True)}
    found.fit = PumpFit(levels, np.diag(np.square(sigmas)), leak, delay_s, 0.1, 0.9)
    columns = ([0.0, *fractions], [0.0, *flows], [0.001, *sigmas])
    branch = Branch(*(np.array(column) for column in columns))
    found._branches = {True: branch, False: Branch(*np.zeros((3, 1)))}
    return found


def test_a_pump_that_starts_with_several_leaks_is_distinguished_from_one_of_unknown_flow() -> None:
    message = (
        "rises from 0.1 µm/s at a command of 0.25 to 17.0 µm/s at 0.35, and the mirror loses 1.8 "
        "µm/s: throttle"
    )
    with pytest.raises(ValueError, match=message):
        survey_of([0.25, 0.35], [0.1, 17.0], 1.8).make_map()
    with pytest.raises(
        ValueError, match=r"beyond a command of 0\.25 is not known"
    ):  # what is between may hold it
        survey_of([0.25, 0.55], [0.1, 17.0], 1.8).make_map()
    with pytest.raises(
        ValueError, match=r"beyond a command of 0\.25 is not known"
    ):  # a hold at 4.5 is possible
        survey_of([0.25, 0.35], [0.1, 17.0], 4.5).make_map()


@pytest.mark.parametrize(
    ("leak", "delay_s", "least_um"), [(2.4, 1.9, -0.7), (0.5, 0.1, -5.4), (6.0, 1.9, 0.0)]
)
def test_a_visit_ends_while_the_hold_can_still_catch_the_mirror(
    leak: float, delay_s: float, least_um: float
) -> None:
    survey = survey_of([0.3, 0.6], [leak - 0.2, leak + 0.2], leak, delay_s)
    steps = survey._plan_visit(Level(0.6))
    run = next(i for i, step in enumerate(steps) if step.fraction == 0.6 and step.until_um is None)
    assert {step.fraction for step in steps[run + 1 :]} == {0.0}
    assert steps[-1].until_um == pytest.approx(least_um)


def furthest_um(
    steps: list[PumpStep], full: float, leak: float, delay_s: float
) -> tuple[float, float]:
    """Lowest and highest point of a mirror that follows `steps` behind a dead time, on a linear
    pump.
    """
    dt_s, at_um, heights, left = 0.01, 0.0, [0.0], list(steps)
    sent = [leak / full] * round(delay_s / dt_s)
    since_s = 0.0
    while left:
        now = left[0]
        met = now.until_um is not None and (
            at_um <= now.until_um if now.fraction == 0 else at_um >= now.until_um
        )
        if met or since_s > now.duration_s:
            left.pop(0)
            since_s = 0.0
            continue
        sent.append(now.fraction)
        since_s += dt_s
        at_um += (full * sent[len(sent) - 1 - round(delay_s / dt_s)] - leak) * dt_s
        heights.append(at_um)
    return min(heights), max(heights)


@pytest.mark.parametrize("delay_s", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("known", [True, False])
def test_visits_in_a_row_wait_for_the_gas_of_each_other(delay_s: float, known: bool) -> None:
    """The next run began while the mirror still sank: three at once lifted it by 12 µm."""
    full, leak, high = 13.0, 2.7, 0.55
    fractions = [0.1, 0.25, high, 1.0][: 4 if known else 3]
    survey = survey_of(fractions, [full * f for f in fractions], leak, delay_s)
    lowest_um, highest_um = furthest_um(4 * survey._plan_visit(Level(1.0)), full, leak, delay_s)
    assert lowest_um > -7.0
    assert highest_um < 7.0


def test_while_no_command_lifts_the_mirror_first_pulses_continue() -> None:
    """With nothing known to lift it, it was to rise by 21 µm at the full command."""
    survey = survey_of([0.3, 0.6], [1.0, 1.9], 2.3, 1.5)
    assert max(step.duration_s for step in survey.steps() if step.fraction > 0) <= 2.4
    assert max(step.until_um or 0.0 for step in survey.steps()) <= 2.0
    survey._rounds = 40 - 1  # in the end it looks further all the same, but waits for nothing
    survey._wanted = {Level(0.3)}
    assert [step.duration_s for step in survey._plan_visit(Level(0.3)) if step.fraction > 0.6] == [
        2.4
    ]
    assert max(step.until_um or 0.0 for step in survey._plan_visit(Level(0.3))) <= 3.0


@pytest.mark.parametrize(
    ("shape", "share"),
    [("root", 0.95), ("dead zone", 0.95), ("top unreachable", 0.9), ("quadratic", 0.95)],
)
def test_errors_of_the_smoothed_flows_match_their_error_bars(shape: str, share: float) -> None:
    """All flows share the leak's error, and a dead zone must not be smoothed away with it."""
    commands = np.array([0.0, 0.015, 0.03, 0.06, 0.09, 0.12, 0.18, 0.25, 0.37, 0.49, 0.6, 0.8, 1.0])
    true = np.array([ForeignPump(shape, 3.1).settled(d) for d in commands])
    noise = np.diag([1e-6, *[0.04**2] * 12])
    noise[1:, 1:] += 0.06**2
    rng = np.random.default_rng(5)
    off = []
    for _ in range(40):
        flows = true + np.linalg.cholesky(noise) @ rng.standard_normal(true.size)
        mean, covariance = smooth_flows(commands, flows, noise)
        off.append((mean - true)[1:] / np.hypot(np.sqrt(np.diag(covariance))[1:], 0.005))
    assert np.mean(np.abs(off) < 2) > share
    assert np.max(np.abs(off)) < 3.6


def test_first_pulses_are_longer_and_at_once_after_a_fall_and_shorter_after_a_rise() -> None:
    def pulses_s(end_um: float, completed: bool, times: int = 1) -> list[float]:
        survey = PumpSurvey(0.5)
        run = PumpRun(DT_S, *np.array([np.zeros(10), np.linspace(0.0, end_um, 10), np.zeros(10)]))
        for _ in range(times):
            survey.add_run(run, completed)
        steps = survey.steps()
        assert (steps[0].fraction > 0) == (end_um < 0 and not completed)
        return [step.duration_s for step in steps if step.fraction > 0]

    as_planned = pulses_s(-5.0, completed=True)
    assert pulses_s(-5.0, completed=False) == pytest.approx([2 * s for s in as_planned])
    assert pulses_s(+5.0, completed=False) == pytest.approx([s / 2 for s in as_planned])
    assert min(pulses_s(+5.0, completed=False, times=4)) >= 0.05  # bounds of an experiment's step
    assert max(pulses_s(-5.0, completed=False, times=4)) <= 20.0


def test_the_levels_with_the_largest_errors_are_visited_first() -> None:
    survey = survey_of([0.2, 0.4, 0.6, 0.8], [0.5, 1.0, 1.5, 2.0], 0.9)
    survey._branches[True].sigmas[1:] = [
        0.05,
        0.05,
        0.30,
        0.06,
    ]  # of the smaller ones that of the leak
    survey._wanted = set(survey.fit.levels)
    assert [level.fraction for level in survey._plan_visits()[:2]] == [0.6, 0.8]


@pytest.mark.parametrize(
    ("flows", "finer"),
    [
        ([0.0, 0.7, 1.4], True),  # of a leak of 0.57: no command known so far gives less
        ([0.0, 0.2, 1.4], False),
    ],
)
def test_a_rise_through_the_leak_is_followed_further_than_one_below_it(
    flows: list[float], finer: bool
) -> None:
    assert (
        0.053 in survey_of([0.045, 0.061, 0.2], flows, 0.57)._list_finer_fractions(True)
    ) == finer


@pytest.mark.parametrize(("leak", "finer"), [(0.4, True), (12.0, False)])
def test_a_kink_that_the_hold_detects_is_followed(leak: float, finer: bool) -> None:
    """A dead zone ends at 0.31, hidden within 2 % of the full flow; but a hold on that curve saw k
    = 1.2.
    """
    survey = survey_of([0.242, 0.322, 0.422, 0.567, 1.0], [0.0, 0.226, 2.106, 4.83, 13.0], leak)
    survey._branches[True].sigmas[1:] = 0.02
    assert (0.282 in survey._list_finer_fractions(True)) == finer


@pytest.mark.parametrize(
    ("before", "high", "jump"),
    [
        (0.0, 0.088, True),
        (0.142, 0.088, True),
        (0.6, 0.088, False),
        (0.0, 0.13, True),
        (0.142, 0.13, False),
    ],
)
def test_a_start_behind_noise_is_a_jump_and_a_slope_is_none(
    before: float, high: float, jump: bool
) -> None:
    """A level below the start read 2.4 % of the full flow in gusts, and the start was taken for a
    steep rise.
    """
    branch = Branch(
        np.array([0.0, 0.087, high]), np.array([0.0, before, 1.4]), np.array([0.001, 0.25, 0.03])
    )
    assert find_first_jump(branch, 6.0) == ((0.087, high) if jump else None)


@pytest.mark.parametrize("late_s", [0.1, 0.9])
def test_the_guard_of_a_round_allows_for_the_delay_of_the_pump(
    monkeypatch: pytest.MonkeyPatch, late_s: float
) -> None:
    """It looked 0.4 s ahead of a pump that answers after 1.1 s, and the mirror sank by 10.8 µm."""
    survey = survey_of([0.2, 0.4], [0.5, 3.5], 1.2, delay_s=late_s)
    monkeypatch.setattr(pump_survey, "PumpSurvey", lambda *given: survey)
    monkeypatch.setattr(map_pump, "_brought_back", lambda rig: True)
    given: list[ExperimentSpec] = []

    def perform_ticks(spec: ExperimentSpec) -> None:
        given.append(spec)
        raise ValueError("enough")

    rig = SimpleNamespace(
        hold=lambda seconds: None,
        around=lambda held, limit_um: operating_point.OperatingPoint(1.2, 0.3, 5.0, 0.5),
        pump=PumpConfig(),
        perform_ticks=perform_ticks,
    )
    with pytest.raises(ValueError, match="enough"):
        map_pump._survey_pump(rig, 10.0)  # type: ignore[arg-type]
    assert given[0].late_s == pytest.approx(max(0.4, late_s + 0.1))


def test_slow_gains_begin_at_the_mean_flow_of_a_loop_that_swings(tmp_path: Path) -> None:
    """From the flow of a moment they carried the mirror 13 µm away."""
    pump = ForeignPump("dead zone", 13.1, 1.0, 0.1)
    _, rig, _ = started(tmp_path, ForeignPlant(pump, 3161, 1.0, 2.7, laser_um=0.3))
    for _ in range(3):  # at any moment of the swing
        rig.hold(11.3)
        map_pump._calm_hold(rig, 10.0)
        rows = rig.ticks(20.0)
        assert rig.loop.kp_per_s == map_pump._CAUTIOUS["kp_per_s"]
        assert max(abs(row.truth_displacement_um) for row in rows) < 10.0
        rig.restore_good_gains()


@pytest.mark.parametrize(("last", "up"), [(1.0, 0.55), (3.5, 0.4)])
def test_a_weak_pump_gets_more_than_the_largest_command_so_far(last: float, up: float) -> None:
    """Which did not lift the mirror: it sank until its guard ended the round, nine times."""
    assert survey_of([0.2, 0.4], [0.5, last], 1.2)._lifting_fraction() == pytest.approx(up)


class Standing:
    """A rig whose mirror follows its setpoint's ramp, or stays where it is."""

    dt_s = 0.1

    def __init__(self, from_um: float, ramp_um_per_s: float) -> None:
        self.at_um, self.ramp_um_per_s, self.time_s = from_um, ramp_um_per_s, 0.0

    def ticks(self, duration_s: float) -> list[SimpleNamespace]:
        self.time_s += duration_s
        rows = []
        for _ in range(round(duration_s / self.dt_s)):
            self.at_um = min(0.0, self.at_um + self.ramp_um_per_s * self.dt_s)
            here_um = 5.0 + 1.5 + self.at_um
            rows.append(
                SimpleNamespace(
                    target_um=5.0, trim_um=1.5, setpoint_um=here_um, displacement_um=here_um
                )
            )
        return rows

    def record(self, rows: list[SimpleNamespace]) -> SimpleNamespace:
        return SimpleNamespace(
            filled_displacement_um=lambda: np.array([row.displacement_um for row in rows])
        )


def test_a_round_begins_only_when_the_mirror_is_back_at_the_end_of_its_ramp() -> None:
    back = Standing(-9.0, 0.5)
    assert map_pump._wait_for_return(back)  # type: ignore[arg-type]
    assert back.at_um > -2.0
    assert not map_pump._wait_for_return(Standing(-9.0, 0.0))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("full", "least", "holds"), [(5.0, 0.3, True), (3.9, 0.3, False), (5.0, 2.5, False)]
)
def test_a_curve_that_ends_near_the_leak_does_not_hold_the_mirror_meanwhile(
    full: float, least: float, holds: bool
) -> None:
    pump = PumpConfig.model_validate(
        {"curve_fraction": [0.1, 0.9], "curve_um_per_s": [least, full]}
    )
    assert map_pump._reaches_leak(replace(flat_map(pump), leak_um_per_s=2.46)) == holds


@pytest.mark.parametrize(("above_um", "back"), [(5.0, True), (-5.0, False)])
def test_a_mirror_that_slow_gains_leave_above_gets_its_own(above_um: float, back: bool) -> None:
    """In strong weather slow gains left it 8 µm high for three minutes, and a sound pump was
    refused.
    """
    own = LoopConfig(kp_per_s=0.5, ti_s=8.0)
    given: list[LoopConfig] = []

    class Rig(Standing):
        loop, good = (
            own.model_copy(update={"kp_per_s": 0.12, "flow_max_um_per_s": 3.0}),
            (own, PumpConfig()),
        )

        def ticks(self, duration_s: float) -> list[SimpleNamespace]:
            here_um = 6.5 if given else 6.5 + above_um
            return [SimpleNamespace(target_um=5.0, trim_um=1.5, displacement_um=here_um)] * round(
                duration_s / 0.1
            )

        def set_gains(self, loop: LoopConfig, *_: object) -> None:
            given.append(loop)

    assert map_pump._brought_back(Rig(0.0, 0.0)) == back  # type: ignore[arg-type]
    assert [(loop.kp_per_s, loop.flow_max_um_per_s) for loop in given] == [(0.5, 3.0)] * back


@pytest.mark.parametrize(
    ("seen", "lasted_s", "kept"),
    [
        ([(1.1, 0.02, False)], [120.0], True),
        ([(2.5, 0.5, True), (1.2, 0.15, False)], [120.0, 240.0], True),
        ([(0.7, 0.05, False), (1.0, 0.05, False)], [120.0, 240.0], True),
        ([(2.5, 0.05, False)] * 3, [120.0, 240.0, 480.0], False),
        ([(2.5, 0.5, True)] * 3, [120.0, 240.0, 480.0], False),
        ([(0.7, 0.3, False)] * 3, [120.0, 240.0, 480.0], True),
    ],
)
def test_steps_that_show_little_or_contradict_the_curve_are_repeated_for_longer(
    monkeypatch: pytest.MonkeyPatch,
    seen: list[tuple[float, float, bool]],
    lasted_s: list[float],
    kept: bool,
) -> None:
    done_s, left = [], list(seen)
    record = SimpleNamespace(followed_by=lambda more: left.pop(0))
    rig = SimpleNamespace(
        hold=lambda seconds: record,
        around=lambda held: operating_point.OperatingPoint(1.2, 0.3, 5.0, 0.5),
        perform=lambda seconds: (done_s.append(seconds) or record, None),
    )
    monkeypatch.setattr(map_pump, "_wait_for_return", lambda rig: True)
    monkeypatch.setattr(operating_point, "require_room", lambda around: None)
    monkeypatch.setattr(experiments, "make_spec", lambda kind, around, seconds: seconds)
    bent = {gain: expected for gain, _, expected in seen}
    monkeypatch.setattr(
        plant_fit,
        "identify_plant",
        lambda at: SimpleNamespace(
            model=SimpleNamespace(gain=at[0]), sigma=SimpleNamespace(gain=at[1])
        ),
    )
    monkeypatch.setattr(
        fit_quality, "find_bent_curve", lambda record, found: ["bent"] * bent[found.model.gain]
    )
    if kept:
        assert map_pump._measure_gain(rig, 0.3) == seen[-1][:2]  # type: ignore[arg-type]
    else:
        with pytest.raises(ValueError, match="contradict the curve"):
            map_pump._measure_gain(rig, 0.3)  # type: ignore[arg-type]
    assert done_s == lasted_s


@pytest.mark.parametrize(
    ("fractions", "flows", "message"),
    [
        ([0.03, 0.22], [2.4, 4.8], r"to 2\.4 µm/s at 0\.03, .* larger by 0\.026"),
        ([0.23, 0.42], [12.6, 14.8], "did not come back"),
        ([0.03, 0.22], [0.0, 4.8], "did not come back to its setpoint .* steadier weather"),
    ],
)
def test_a_mirror_that_does_not_return_is_reported(
    fractions: list[float], flows: list[float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        survey_of(fractions, flows, 1.0).make_map(held=False)


@pytest.mark.parametrize(
    ("white", "worse", "seconds", "message"),
    [
        (0.9995, 1.1, 1200.0, "--limit-um 20"),
        (0.9995, 1.5, 1200.0, "--limit-um 30"),
        (0.9995, 4.0, 1200.0, "steadier"),
        (0.9, 1.1, 1200.0, "steadier"),
        (0.9, 1.1, 20.0, "--limit-um 20"),
    ],
)
def test_a_larger_limit_is_requested_only_where_it_helps(
    white: float, worse: float, seconds: float, message: str
) -> None:
    """In a random walk, or with errors far too large, it would be refused again."""
    survey = survey_of([0.25, 0.55], [0.1, 17.0], 1.8)
    survey.fit = replace(survey.fit, share_white=white)
    survey._branches[True].sigmas[1:] = [0.01, worse * 0.02 * survey.full_um_per_s]
    survey.runs = [PumpRun(DT_S, *np.zeros((3, round(seconds / DT_S))))]
    with pytest.raises(ValueError, match=f"not known to 2% .*{message}"):
        survey.make_map()


def flat_map(pump: PumpConfig) -> PumpMap:
    return PumpMap((0.1, 1.0), (0.0, 5.0), (0.0, 0.1), pump, 1.24, 0.1, 0.1, 600.0, True)


@pytest.mark.parametrize("strength", [1.0, 2.0])
@pytest.mark.campaign
def test_only_a_curve_that_steps_of_the_flow_confirm_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strength: float
) -> None:
    """The pump is as strong as this, and so is the map; another time the map says twice as much."""
    link, rig, folder = started(
        tmp_path,
        ForeignPlant(ForeignPump("straight", 5.0), laser_um=0.4, weather=0.3),
        rate_hz=10.0,
    )
    full = 5.0 * strength
    wrong = PumpConfig(
        curve_fraction=(0.1, 1.0), curve_um_per_s=(0.0, full), flow_full_um_per_s=full
    )
    monkeypatch.setattr(map_pump, "_survey_pump", lambda rig, limit_um: flat_map(wrong))
    before = rig.loop, rig.pump
    if strength == 1.0:
        done, _ = map_pump.map_pump(folder, rig)
        assert done.gain == pytest.approx(1.0, abs=0.1)
        assert done.before == before[1]
        assert rig.pump == wrong
    else:
        with pytest.raises(
            RejectedError, match=r"steps of the flow contradict the curve .* run `tune pump` again"
        ):
            map_pump.map_pump(folder, rig)
        assert (rig.loop, rig.pump) == before
        assert not map_pump.has_pump_map(folder)
        assert open_session(folder.path).config == link.config
    rig.hold(40.0)
    assert all(abs(row.truth_displacement_um) < 3.0 for row in link.rows[-400:])


def test_gains_too_fast_for_the_measured_actuator_become_slower() -> None:
    loop = LoopConfig(feedforward_barometer=False)
    quick, late = flat_map(PumpConfig()), replace(flat_map(PumpConfig()), delay_s=1.2, lag_s=0.3)
    assert map_pump._make_safe_gains(loop, quick) == loop
    safe = map_pump._make_safe_gains(loop, late)
    model = PlantModel(1.0, 1.2, 0.3, 1.24)
    assert compute_margins(Gains.from_config(safe), model, 0.02).ms < 1.75
    assert not compute_margins(Gains.from_config(loop), model, 0.02).ms < 1.75


@pytest.mark.parametrize(
    ("limit", "rate_limit", "full", "after"),
    [
        (5.3, 20.0, 15.9, 15.9),
        (6.0, 20.0, 2.0, 2.0),
        (5.3, 20.0, 60.0, 40.0),
        (3.0, 20.0, 15.9, 3.0),
    ],
)
def test_the_limit_of_the_flow_comes_with_the_curve_unless_somebody_set_a_lower_one(
    limit: float, rate_limit: float, full: float, after: float
) -> None:
    loop = LoopConfig(flow_max_um_per_s=limit, flow_rate_limit_um_per_s2=rate_limit)
    pump = PumpConfig(curve_fraction=(0.1, 1.0), curve_um_per_s=(0.0, full))
    freed = map_pump._free_flow_limit(loop, PumpConfig(), pump)
    assert freed == loop.model_copy(update={"flow_max_um_per_s": after})
    found = cross_check(Config(loop=freed, pump=pump))
    assert not [each for each in found if each.severity == "error" and "flow" in each.field]


@pytest.mark.campaign
def test_a_leak_above_the_configured_flow_is_held_on_the_measured_curve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pump is three times as strong as configured: the leak seems to be 2.2 µm/s until there is
    a curve.
    """
    plant = ForeignPlant(
        ForeignPump("straight", 15.9), laser_um=0.4, weather=0.3, leak_um_per_s=6.5
    )
    link, rig, folder = started(tmp_path, plant, rate_hz=10.0)
    true = PumpConfig(
        curve_fraction=(0.1, 1.0),
        curve_um_per_s=(0.0, 15.9),
        start_fraction=0.1,
        stall_fraction=0.1,
    )
    rig.pump = rig.pump.model_copy(update={"probe_um": 0.1, "change_max": 0.3})
    monkeypatch.setattr(map_pump, "_survey_pump", lambda rig, limit_um: flat_map(true))
    done, folder = map_pump.map_pump(folder, rig)
    assert (done.found.pump.probe_um, done.found.pump.change_max) == (0.1, 0.3)
    assert folder.config.loop.flow_max_um_per_s == rig.loop.flow_max_um_per_s == 15.9
    rig.hold(60.0)
    assert all(abs(row.truth_displacement_um) < 3.0 for row in link.rows[-400:])


@pytest.mark.campaign
def test_a_whole_session_on_an_unknown_pump(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A quadratic diaphragm that starts at 0.22, 1.2 s late: from the defaults to verified gains,
    by one command.
    """
    pump = ForeignPump("quadratic", 6.0, 1.0, 0.2, start=0.22, stall=0.2)
    ForeignHold.plant = ForeignPlant(pump, seed=4, laser_um=0.5, weather=0.6)
    assert tuned(tmp_path, monkeypatch, "run", "--yes") == Exit.DONE
    message = capsys.readouterr().err
    assert "run `tune pump`" in message  # the relay saw the bend, and the session went on by itself
    assert "verify: kept" in message
    assert all(abs(row.truth_displacement_um) < 3.0 for row in ForeignHold.last.rows[-6000:])
    config = tmp_path / "foreign.toml"
    assert (
        run(["tune", "save", "--config", str(config), "--logs", str(tmp_path), "--yes"])
        == Exit.DONE
    )
    saved = load_toml(config, Config)
    flow = PumpCurve(saved.pump)
    assert all(abs(flow.flow(d) - pump.settled(d)) < 0.03 * 6.0 for d in np.linspace(0.25, 1.0, 50))


@pytest.mark.campaign
def test_a_straight_pump_is_tuned_without_a_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ForeignHold.plant = ForeignPlant(
        ForeignPump("straight", 5.3, start=0.22, stall=0.15), laser_um=0.5
    )
    assert tuned(tmp_path, monkeypatch, "run", "--yes") == Exit.DONE
    assert "pump:" not in capsys.readouterr().err
    assert ForeignHold.last.rows[-1].mono_s < 1700.0
