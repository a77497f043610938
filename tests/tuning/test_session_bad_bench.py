"""Sessions on benches with something wrong: detected, named with what would help, and the mirror
stays held.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Sequence
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import Config, LoopConfig, ShapeConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.model.errors import Exit, RejectedError
from membrane_ctrl.model.telemetry import ShapeState, State
from membrane_ctrl.sessions.folder import create_session
from membrane_ctrl.sessions.live_hold import HoldError, News
from membrane_ctrl.sim.bench_events import AmbientChange, BenchEvent
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_bench, foreign_config
from tuning import twin_hold
from tuning.identification import shape_loop_fit
from tuning.identification.experiments import (
    ExperimentError,
    fit_experiments,
    make_spec,
    run_experiments,
)
from tuning.rigs.hold_rig import HoldRig
from tuning.steps.characterise import run_characterise
from tuning.twin_hold import TwinHold


def held(events: Sequence[BenchEvent] = (), **twin: object) -> tuple[TwinHold, HoldRig]:
    settings = TwinConfig.model_validate({"scenario": "quiet", "start_error_um": -3.0, **twin})
    loop = LoopConfig(rate_hz=20.0, feedforward_barometer=False, feedforward_temperature=False)
    link = TwinHold(Config(twin=settings, shape=ShapeConfig(enabled=False), loop=loop), events)
    return link, HoldRig(link, "tester")


def still_held(link: TwinHold) -> bool:
    for _ in range(80):
        link.read_news()
    return link.rows[-1].state == State.HOLD and all(
        abs(row.truth_displacement_um) < 2.0 for row in link.rows[-250:]
    )


@pytest.mark.campaign
def test_a_door_in_the_first_relay_costs_that_relay_only() -> None:
    link, rig = held([AmbientChange(120.0, -20.0)])
    done = fit_experiments(run_experiments(rig))
    assert done.quality.verdict != "refused"
    assert done.identified.model.gain == pytest.approx(1.0, abs=0.06)
    assert max(abs(row.truth_displacement_um) for row in link.rows[3000:]) < 10.0 + 7.2  # the door
    assert still_held(link)


@pytest.mark.campaign
def test_a_laser_lost_for_three_seconds_repeats_the_relay() -> None:
    link, rig = held()
    rig.hold(20.0)
    around = rig.around(rig.hold(20.0), 10.0)
    news, seen = link.read_news, []

    def dark_later():  # type: ignore[no-untyped-def]
        seen.append(news())
        link.bench.wrong.no_light = 20 <= len(seen) < 26
        return seen[-1]

    link.read_news = dark_later  # type: ignore[method-assign]
    record, finished = rig.perform(make_spec("relay", around, 60.0))
    assert finished.completed
    assert rig.repeated == 1
    assert record.gaps_s == pytest.approx([3.0], abs=0.6)
    assert record.duration_s > 65.0
    assert still_held(link)


def test_a_pump_that_ceases_in_the_relay_is_named() -> None:
    link, rig = held()
    rig.hold(20.0)
    around = rig.around(rig.hold(20.0), 10.0)
    link.bench.wrong.pump_share = 0.0
    _, finished = rig.perform(make_spec("relay", around, 60.0))
    assert not finished.completed
    assert "stopped at -" in finished.reason


def test_for_a_mirror_too_tight_the_advice_is_to_open_the_bleed(tmp_path: Path) -> None:
    link, rig = held(leak_time_constant_s=8e4, scenario="calm", laser_noise_um=0.3)
    folder = create_session(tmp_path, "tight", "tester", link.name, link.config, rig.loop)
    with pytest.raises(RejectedError, match="open the bleed"):
        run_characterise(folder, rig)
    assert link.rows[-1].state == State.HOLD


def test_a_fault_in_a_session_names_the_state_of_the_hold() -> None:
    link, rig = held()
    rig.hold(5.0)
    link.bench.wrong.gauge_offset_pa = 500.0
    with pytest.raises(HoldError, match="not held"):
        rig.hold(20.0)


def test_a_refused_command_is_an_error_with_the_reason() -> None:
    _, rig = held()
    with pytest.raises(HoldError, match="outside the limits"):
        rig.set_gains(rig.loop, "test", 5.0, setpoint_step_um=5000.0)


class Outer(TwinHold):
    """What `tune outer` works on: the connection is lost, or Ctrl-C comes, a time after a trial
    begins.
    """

    last: Outer
    when = (0, 0.0)  # trials before it, seconds after its begin
    lost = False  # the connection; else Ctrl-C

    def __init__(self, *given: object) -> None:
        super().__init__(*given)  # type: ignore[arg-type]
        Outer.last, self.trials, self.begun_s, self.gone = self, 0, math.inf, False

    def send_command(self, command: Command) -> None:
        """Counts the trials of the session."""
        if self.gone and self.lost:
            raise HoldError("the connection is lost")
        super().send_command(command)
        self.trials += math.isfinite(command.value)
        if self.trials > self.when[0]:
            self.begun_s = min(self.begun_s, self.rows[-1].mono_s)

    def read_news(self) -> News:
        """No more of them once the connection is lost."""
        if not self.gone and self.rows[-1].mono_s > self.begun_s + self.when[1]:
            self.gone = True
            if not self.lost:
                signal.raise_signal(signal.SIGINT)
        if self.gone and self.lost:
            raise HoldError("the connection is lost")
        return super().read_news()

    def close(self) -> None:
        """The hold outlives its session."""


@pytest.mark.parametrize(
    ("when", "lost", "back_s"),
    [
        ((1, 20.0), False, 12.0),
        ((1, 20.0), True, 45.0),
        ((3, 5.0), False, 3.0),
        ((3, 5.0), True, 155.0),
    ],
    ids=[
        "Ctrl-C, setpoint stepped",
        "lost, setpoint stepped",
        "Ctrl-C, on trial",
        "lost, on trial",
    ],
)
def test_an_interrupted_outer_restores_setpoint_shape_loop_and_time_constant(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    when: tuple[int, float],
    lost: bool,
    back_s: float,
) -> None:
    monkeypatch.setattr(twin_hold, "TwinHold", Outer)
    monkeypatch.setattr(Outer, "when", when)
    monkeypatch.setattr(Outer, "lost", lost)
    monkeypatch.setattr(shape_loop_fit, "_LEVEL_S", 20.0)
    (tmp_path / "lab.toml").write_text("[loop]\nrate_hz = 10.0\n[twin]\nstart_error_um = -3.0\n")
    words = ["--observe", "20s", "--verify", "30s", "--yes", "--config", f"{tmp_path}/lab.toml"]
    code = run(["tune", "outer", "--twin", *words, "--logs", str(tmp_path)])
    assert code == (Exit.DEVICE_FAILED if lost else Exit.INTERRUPTED)
    hold = Outer.last
    setpoint_um = hold.config.loop.setpoint_um
    assert (abs(hold.rows[-1].setpoint_um - setpoint_um) > 4.0) == (when[0] == 1)
    assert time_constant_s(hold) != hold.config.shape.time_constant_s or when[0] == 1
    until_s = hold.rows[-1].mono_s + back_s
    while hold.rows[-1].mono_s < until_s:
        hold._advance(5)
    assert hold.rows[-1].setpoint_um == pytest.approx(
        setpoint_um, abs=0.4
    )  # of a step of 5; the shape loop trims it
    assert time_constant_s(hold) == hold.config.shape.time_constant_s
    assert hold.rows[-1].shape_state in (ShapeState.WAITING, ShapeState.TRACKING)


def time_constant_s(hold: TwinHold) -> float:
    """The shape loop's, now."""
    return hold._run._supervisor._controller._shape._time_constant_s


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("pump", "at_most_s", "words"),
    [
        (ForeignPump("quadratic", 6.0, 1.0, 0.2, 0.22, 0.2), 200.0, "below the holding flow"),
        (ForeignPump("root", 5.0, 0.2, 0.2), 200.0, "much stronger than configured"),
    ],
    ids=["bent", "too strong to complete a relay"],
)
def test_the_first_relay_that_shows_the_need_requests_the_map(
    pump: ForeignPump, at_most_s: float, words: str
) -> None:
    link = TwinHold(
        foreign_config(rate_hz=20.0), bench=foreign_bench(ForeignPlant(pump, 4, 0.6, laser_um=0.5))
    )
    rig, before_s = HoldRig(link, "tester"), link.rows[-1].mono_s
    try:
        refusal_text = "; ".join(fit_experiments(run_experiments(rig)).quality.reasons)
    except ExperimentError as error:
        refusal_text = str(error)
    assert words in refusal_text
    assert refusal_text.endswith("run `tune pump`")
    assert link.rows[-1].mono_s - before_s < at_most_s
