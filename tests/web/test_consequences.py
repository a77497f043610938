"""Buttons by consequence; ranges, prices, and what Enter confirms."""

from __future__ import annotations

import math

import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.service.access import ACTIONS, STOP, UNLOCK
from membrane_ctrl.service.action_button import ActionButton
from membrane_ctrl.web.action_dialog import explain_input
from membrane_ctrl.web.consequences import (
    Consequence,
    describe_price,
    find_consequence,
    find_range,
)
from membrane_ctrl.web.page import changes_something

ROW = {"leak_um_per_s": 1.24, "target_um": 12.0, "flow_um_per_s": 1.2345678}


def action(name: str) -> ActionButton:
    return next(each for each in (*ACTIONS, STOP, UNLOCK) if each.do == name)


def test_every_button_has_its_consequence() -> None:
    by_consequence = {each: set() for each in Consequence}
    for each in (*ACTIONS, STOP, UNLOCK):
        by_consequence[find_consequence(each)].add(each.do)
    assert by_consequence[Consequence.NOTHING] == {"mark", "capture", "keep", "quiet"}
    assert by_consequence[Consequence.COSTS_HOURS] == {"lower", "vent", "latch", "stop"}


def test_a_setpoint_has_its_present_value_and_its_range() -> None:
    found = find_range(action("setpoint"), ROW, Config())
    assert found is not None
    assert found.words == "now 12 µm; allowed: -2000 to 500 µm"
    assert explain_input(action("setpoint"), "501", found) == "501 µm is outside of -2000 to 500 µm"
    assert explain_input(action("setpoint"), "-2000", found) == ""
    assert "number" in explain_input(action("setpoint"), "ten", found)


def test_a_flow_has_the_pump_s_range() -> None:
    found = find_range(action("manual"), ROW, Config())
    assert found is not None
    assert (found.low, found.now) == (0.0, pytest.approx(1.23, abs=0.01))
    assert found.high == Config().loop.flow_most_um_per_s(Config().pump)


def test_venting_states_the_hours_until_it_holds_again() -> None:
    config = Config()
    config = config.model_copy(update={"devices": None})
    price = describe_price(action("vent"), ROW, config)
    assert price.startswith(("Venting: ", "The leak lowers"))
    slow = describe_price(action("stop"), ROW, config)
    assert slow.startswith("The leak lowers the mirror by 0.074 mm/min, to ")
    assert "filling it from flat takes " in slow
    tight = describe_price(action("stop"), ROW | {"leak_um_per_s": 100.0}, config)
    assert "too large to fill it from flat" in tight


@pytest.mark.parametrize("name", ["mark", "hold", "setpoint"])
def test_what_costs_nothing_has_no_price(name: str) -> None:
    assert describe_price(action(name), ROW, Config()) == ""


def test_nothing_is_claimed_without_the_configuration_or_the_leak() -> None:
    assert describe_price(action("vent"), ROW, None) == ""
    assert describe_price(action("vent"), {"leak_um_per_s": math.nan}, Config()) == ""
    assert find_range(action("setpoint"), ROW, None) is None


def test_a_mark_needs_a_text() -> None:
    assert explain_input(action("mark"), "  ", None) == "enter a text"
    assert explain_input(action("latch"), "", None) == ""


def test_a_button_that_changes_nothing_is_off() -> None:
    tracking = {"shape": "tracking", "paused": False, "locks": []}
    assert not changes_something(action("shape_on"), tracking)
    assert changes_something(action("shape_off"), tracking)
    assert changes_something(action("pause"), tracking)
    assert not changes_something(action("resume"), tracking)
    assert not changes_something(action("unlock"), tracking)
    assert changes_something(action("unlock"), {"locks": [{}]})
    assert not changes_something(action("keep"), tracking | {"trial_left_s": None})
    assert changes_something(action("keep"), tracking | {"trial_left_s": 12.5})
    assert not changes_something(action("quiet"), tracking)
    locked = {"locks": [{"word": "bofa1", "text": "hands inside"}]}
    assert changes_something(action("quiet"), tracking | locked)
