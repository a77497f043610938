"""Sessions on benches with something wrong: detected, named with what would help, and the mirror stays held."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from membrane_ctrl.config.schema import Config, LoopConfig, ShapeConfig, TwinConfig
from membrane_ctrl.model.errors import RejectedError
from membrane_ctrl.model.states import State
from membrane_ctrl.sessions.folder import create_session
from membrane_ctrl.sessions.live_hold import HoldError
from membrane_ctrl.sim.bench_events import AmbientChange
from membrane_ctrl.sim.plant import BenchEvent
from tuning import session
from tuning.identification.characterise import characterise, spec_of
from tuning.opening import TwinHold
from tuning.rig import HoldRig


def held(events: Sequence[BenchEvent] = (), **twin: object) -> tuple[TwinHold, HoldRig]:
    settings = TwinConfig.model_validate({"scenario": "quiet", "start_error_um": -3.0, **twin})
    loop = LoopConfig(feedforward_barometer=False, feedforward_temperature=False)
    link = TwinHold(Config(twin=settings, shape=ShapeConfig(enabled=False), loop=loop), events)
    return link, HoldRig(link, "tester")


def still_held(link: TwinHold) -> bool:
    for _ in range(80):
        link.news()
    return link.rows[-1].state == State.HOLD and all(abs(row.truth_displacement_um) < 2.0 for row in link.rows[-250:])


@pytest.mark.campaign
def test_a_door_in_the_first_relay_costs_that_relay_only() -> None:
    link, rig = held([AmbientChange(120.0, -20.0)])
    done = characterise(rig)
    assert done.quality.verdict != "refused"
    assert done.identified.model.gain == pytest.approx(1.0, abs=0.06)
    assert max(abs(row.truth_displacement_um) for row in link.rows[3000:]) < 10.0 + 7.2  # the door
    assert still_held(link)


@pytest.mark.campaign
def test_a_lost_laser_ends_the_relay_by_name() -> None:
    link, rig = held()
    rig.hold(20.0)
    around = rig.around(rig.hold(20.0), 10.0)
    news, seen = link.news, []

    def dark_later():  # type: ignore[no-untyped-def]
        seen.append(news())
        link.bench.wrong.no_light = 20 <= len(seen) < 26
        return seen[-1]

    link.news = dark_later  # type: ignore[method-assign]
    record, finished = rig.perform(spec_of("relay", around, 60.0))
    assert not finished.completed
    assert "laser" in finished.reason or "safety table" in finished.reason
    assert record.duration_s < 15.0
    assert still_held(link)


def test_a_pump_that_ceases_in_the_relay_is_named() -> None:
    link, rig = held()
    rig.hold(20.0)
    around = rig.around(rig.hold(20.0), 10.0)
    link.bench.wrong.pump_share = 0.0
    _, finished = rig.perform(spec_of("relay", around, 60.0))
    assert not finished.completed
    assert "stopped at -" in finished.reason


def test_a_mirror_too_tight_is_told_to_open_the_bleed(tmp_path: Path) -> None:
    link, rig = held(leak_time_constant_s=8e4, scenario="calm", laser_noise_um=0.3)
    folder = create_session(tmp_path, "tight", "tester", link.name, link.config, rig.loop)
    with pytest.raises(RejectedError, match="open the bleed"):
        session.characterise_step(folder, rig)
    assert link.rows[-1].state == State.HOLD


def test_a_fault_in_a_session_says_what_the_hold_is_in() -> None:
    link, rig = held()
    rig.hold(5.0)
    link.bench.wrong.gauge_offset_pa = 500.0
    with pytest.raises(HoldError, match="not held"):
        rig.hold(20.0)


def test_a_refused_command_is_an_error_with_the_reason() -> None:
    _, rig = held()
    with pytest.raises(HoldError, match="outside the limits"):
        rig.set_gains(rig.loop, "test", 5.0, setpoint_step_um=5000.0)
