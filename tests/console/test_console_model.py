"""What the console remembers of its input."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from console_feed import FAULT, HOLDING, event, rows, shape

from membrane_ctrl.config.schema import Config
from membrane_ctrl.console.model import TREND_S, ConsoleModel, Trend, describe_fault_state
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.telemetry import SETTLED_AFTER_S, SafeLevel, ShapeState, State


def model(duration_s: float | None = None) -> ConsoleModel:
    return ConsoleModel(Config(), duration_s)


def test_trend_is_the_mean_of_each_second_with_gaps() -> None:
    trend = Trend()
    assert all(math.isnan(mean) for mean in trend.mean_by_seconds())
    for mono_s, value in ((1.0, 1.0), (1.5, 3.0), (2.0, math.nan), (3.9, 5.0)):
        trend.add(mono_s, value)
    means = trend.mean_by_seconds()
    assert len(means) == TREND_S
    assert means[-3] == 2.0
    assert math.isnan(means[-2])
    assert means[-1] == 5.0
    assert trend.finite_values() == [1.0, 3.0, 5.0]


def test_trend_forgets_after_a_minute_even_across_a_gap() -> None:
    trend = Trend()
    trend.add(0.0, 1.0)
    trend.add(70.0, 2.0)
    assert trend.finite_values() == [2.0]
    assert [mean for mean in trend.mean_by_seconds() if math.isfinite(mean)] == [1.0, 2.0]
    assert all(math.isnan(mean) for mean in trend.mean_by_seconds()[-70:-1])


def test_last_minute_of_the_error() -> None:
    given = model()
    for row in rows(90.0):
        given.add_row(row)
    view = given.make_view(90.0)
    errors = [row.error_um for row in rows(90.0) if row.mono_s >= 30.0]
    mean = sum(errors) / len(errors)
    assert view.error_std_um == pytest.approx(
        math.sqrt(sum((e - mean) ** 2 for e in errors) / len(errors))
    )
    assert view.in_band_fraction == 1.0
    assert view.lateness_max_ms == max(row.lateness_ms for row in rows(90.0) if row.mono_s >= 30.0)


def test_before_the_first_tick_it_waits() -> None:
    view = model().make_view(0.5)
    assert view.row is None
    assert "no tick yet" in view.why
    assert view.held.seconds == 0
    assert math.isinf(view.left_s)


def test_time_in_the_state_and_time_left() -> None:
    given = model(duration_s=120.0)
    given.add_row(replace(HOLDING, mono_s=3.0, state=State.SETTLE))
    given.add_row(replace(HOLDING, mono_s=10.0))
    given.add_row(replace(HOLDING, mono_s=15.0))
    view = given.make_view(15.5)
    # the run's 120 s count from its first tick
    assert (view.state, view.state_age_s, view.left_s) == (State.HOLD, 5.5, 107.5)
    assert given.make_view(130.0).left_s == 0.0


def test_silent_control_loop_is_seen() -> None:
    given = model()
    given.add_row(replace(HOLDING, mono_s=3.0))
    assert given.make_view(3.9).silent_s == 0.0
    assert given.make_view(5.0).silent_s == 2.0


def test_fault_stands_until_it_is_cleared_and_is_counted() -> None:
    given = model()
    given.add_row(replace(HOLDING, safe_level=SafeLevel.HOLD_FLOW, fault=30.0))
    given.add_event(event(0.0, "fault", **FAULT))
    view = given.make_view(0.0)
    assert view.fault == "link lost: the link to the pump board is down (link down)"
    assert view.remedy.startswith("check cable")
    assert view.why == f"pump keeps its last mean flow: {view.fault}"
    given.add_event(event(1.0, "cleared", name="link_lost"))
    view = given.make_view(1.0)
    assert (view.fault, view.remedy, view.faults) == ("", "", 1)
    assert view.last_fault == "link lost: the link to the pump board is down (link down) at 0 s"


def test_the_reason_is_that_of_the_newest_state_or_why() -> None:
    given = model()
    given.add_row(replace(HOLDING, state=State.CHECK))
    given.add_event(event(0.0, "state", state="check", why="entering"))
    given.add_event(event(0.1, "why", why="checking the sensors: no gauge pressure"))
    given.add_event(event(0.2, "command", command="hold", why="not a reason for the pump"))
    assert given.make_view(0.2).why == "checking the sensors: no gauge pressure"


def test_too_tight_is_judged_after_half_a_minute_of_hold() -> None:
    given = model()
    given.add_row(replace(HOLDING, leak_um_per_s=0.3))
    assert not given.make_view(5.0).too_tight
    assert given.make_view(31.0).too_tight
    given.add_row(replace(HOLDING, leak_um_per_s=0.5))
    assert not given.make_view(31.0).too_tight
    given.add_row(replace(HOLDING, leak_um_per_s=math.nan))
    assert not given.make_view(31.0).too_tight


def test_sag_change_is_against_the_first_usable_shape_of_a_settled_hold() -> None:
    given = model()
    given.add_row(replace(HOLDING, state=State.SETTLE))
    given.add_shape(shape(sag_um=37000.0))
    assert math.isnan(given.make_view(0.0).shape.sag_change_um)
    given.add_row(HOLDING)
    settled_s = HOLDING.mono_s + SETTLED_AFTER_S
    given.add_shape(
        shape(time_s=settled_s + 0.5, sag_um=30000.0, verdict="rejected", reason="tracking lost")
    )
    given.add_shape(shape(time_s=settled_s - 0.5, sag_um=37098.9))  # the mirror still moved
    given.add_shape(shape(time_s=settled_s + 1.0, sag_um=37100.0))
    given.add_shape(shape(time_s=settled_s + 4.0, sag_um=37100.5))
    seen = given.make_view(settled_s + 6.0).shape
    assert (seen.sag_change_um, seen.reference_s) == (pytest.approx(0.5), settled_s + 1.0)
    assert seen.change_sigma_um == pytest.approx(math.sqrt(2) * shape().sag_change_sigma_um)
    assert (seen.cycles, seen.rejected, seen.age_s) == (5, 1, 2.0)


def test_the_note_names_the_fault_of_the_shape() -> None:
    given = model()
    given.add_row(HOLDING)
    given.add_shape(shape(verdict="degraded", reason="12 % saturated"))
    assert given.make_view(0.0).shape.note == "12 % saturated"
    given.add_row(replace(HOLDING, shape_state=ShapeState.SUSPENDED))
    given.add_event(event(0.0, "shape", state="suspended", reason="laser and shape disagree"))
    assert given.make_view(0.0).shape.note == "laser and shape disagree"
    given.add_event(event(0.0, "acquisition", state="retrying", message="camera: no trigger"))
    assert given.make_view(0.0).shape.note == "retrying: camera: no trigger"
    given.add_event(event(0.0, "acquisition", state="running", message="ok"))
    assert given.make_view(0.0).shape.note == "laser and shape disagree"


def test_end_event_ends() -> None:
    given = model()
    assert not given.has_ended
    given.add_event(event(0.0, "end", exit="done"))
    assert given.has_ended


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (FAULT, "link lost: the link to the pump board is down (link down)"),
        ({"name": "late"}, "late"),
        ({"cause": "because"}, "because"),
        ({}, "unnamed"),
    ],
)
def test_words_of_a_fault(given: dict[str, object], words: str) -> None:
    fault = from_dict({"kind": "fault", **given})
    assert isinstance(fault, Fault)
    assert describe_fault_state(fault) == words
    assert describe_fault_state(None) == ""


def test_gains_in_force_and_the_countdown_of_a_trial_are_shown() -> None:
    given = model()
    given.add_row(replace(HOLDING, mono_s=20.0))
    assert given.make_view(20.0).gains == "Kp 0.61 1/s, Ti 6.5 s, Td 0 s"
    asked = {"kind": "command", "command": "gains", "who": "tom", "why": "", "mono_s": 10.0}
    gains = Config().loop.model_dump()
    given.add_event(asked | {"loop": gains | {"kp_per_s": 9.0}, "refused": "no"})
    given.add_event(asked | {"loop": gains | {"kp_per_s": 0.5}, "value": 60.0})
    assert (
        given.make_view(20.0).gains
        == "Kp 0.5 1/s, Ti 6.5 s, Td 0 s; on trial, reverted in 50 s unless kept"
    )
    given.add_event({"kind": "command", "command": "keep", "who": "tom", "why": "", "mono_s": 30.0})
    given.add_event(asked | {"loop": gains | {"kp_per_s": 0.7}, "value": 60.0})
    given.add_event({"kind": "gains_reverted", "why": "nobody kept them", "mono_s": 70.0})
    assert given.make_view(70.0).gains == "Kp 0.5 1/s, Ti 6.5 s, Td 0 s"
    curve = {"curve_fraction": [0.1, 1.0], "curve_um_per_s": [0.0, 9.0]}
    given.add_event(
        asked | {"loop": gains | {"flow_max_um_per_s": 20.0, "pump": curve}, "value": 60.0}
    )
    assert given.make_view(80.0).flow_most_um_per_s == 9.0
    given.add_event({"kind": "gains_reverted", "why": "nobody kept them", "mono_s": 90.0})
    assert given.make_view(90.0).flow_most_um_per_s == 5.3
