"""The history chart: named numbers with units, a panel for each signal, one cursor."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.service.feed import Series
from membrane_ctrl.web.history_chart import ChartLine, make_history_chart
from membrane_ctrl.web.shared_views import parse_removed, parse_signals

SERIES = Series(np.array([10.0, 11.0]), np.array([-1.0, 0.0]), np.zeros(2), np.array([2.0, 0.5]))


def test_each_point_has_its_minimum_mean_and_maximum_by_name() -> None:
    options = make_history_chart([("error_um", SERIES)], utc=True)
    named = [each for each in options["series"] if "name" in each]
    (error,) = named
    assert (error["name"], error["unit"]) == ("error", "µm")
    assert error["data"][0] == [10_000.0, 0.0, -1.0, 2.0], "time, mean, minimum, maximum"
    width = options["series"][1]
    assert width["data"][0] == [10_000.0, 3.0]
    assert "name" not in width, "the width of the band is no reading: no name, not in the tooltip"


def test_several_signals_share_the_time_axis_and_the_cursor() -> None:
    signals = ["error_um", "pump_fraction", "gauge_pressure_pa"]
    options = make_history_chart([(signal, SERIES) for signal in signals], utc=True)
    assert len(options["grid"]) == len(options["xAxis"]) == len(options["yAxis"]) == 3
    assert options["axisPointer"]["link"] == [{"xAxisIndex": "all"}]
    assert all(zoom["xAxisIndex"] == [0, 1, 2] for zoom in options["dataZoom"])
    assert [axis["name"] for axis in options["yAxis"]] == [COLUMNS[each].title for each in signals]
    named = [each for each in options["series"] if "name" in each]
    assert [each["id"] for each in named] == signals
    assert [each["yAxisIndex"] for each in named] == [0, 1, 2]
    # only the lowest panel labels the times, only the first the marks
    assert [axis["axisLabel"].get("show", True) for axis in options["xAxis"]] == [False] * 2 + [
        True
    ]
    assert [each["markLine"]["label"]["show"] for each in named] == [True, False, False]
    # the panels do not overlap
    edges = [(float(g["top"][:-1]), float(g["height"][:-1])) for g in options["grid"]]
    assert all(a + h < b for (a, h), (b, _) in itertools.pairwise(edges))


def test_an_alarm_differs_from_a_mark() -> None:
    moments = [ChartLine(10.2, "door"), ChartLine(10.5, "laser lost", is_alarm=True)]
    options = make_history_chart([("error_um", SERIES)], utc=True, moments=moments)
    mark, alarm = options["series"][2]["markLine"]["data"]
    assert mark["lineStyle"] != alarm["lineStyle"]
    assert alarm["name"] == "laser lost"


@pytest.mark.parametrize("text", ["", "error_um,", "absent", "error_um;x", "state"])
def test_signals_of_a_browser_are_checked(text: str) -> None:
    with pytest.raises(ValueError, match="one to 4 of"):
        parse_signals(text)


def test_more_signals_than_a_screen_shows_are_refused() -> None:
    names = "error_um,pump_fraction,flow_um_per_s,leak_um_per_s"
    assert len(parse_signals(names)) == 4
    with pytest.raises(ValueError, match="one to 4"):
        parse_signals(f"{names},trim_um")


def test_terms_of_a_browser_are_checked() -> None:
    assert parse_removed("") == ()
    assert parse_removed("tilt,piston,tilt") == ("piston", "tilt")
    with pytest.raises(ValueError, match="some of piston"):
        parse_removed("tilt,evil")
