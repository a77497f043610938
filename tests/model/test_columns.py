"""The table of telemetry columns: consistent in itself, and the same as the row."""

import math
from collections import defaultdict
from dataclasses import fields

import pytest

from membrane_ctrl.model.columns import (
    COLUMNS,
    DRAWN,
    TRUE_ERROR_COLUMN,
    Aggregation,
    Group,
    Kind,
    TelemetryColumn,
    columns_of,
    plots_of,
    unit_of,
)
from membrane_ctrl.model.telemetry import FIELDS, TelemetryRow

EVERY = [*COLUMNS.values(), TRUE_ERROR_COLUMN]


def test_every_field_of_a_row_is_a_column_in_the_same_order() -> None:
    assert tuple(field.name for field in fields(TelemetryRow)) == tuple(COLUMNS) == FIELDS


def test_a_row_without_values_is_missing_everywhere() -> None:
    row = TelemetryRow.unpack(TelemetryRow().pack())
    assert all(math.isnan(getattr(row, name)) for name in COLUMNS)


def test_labels_and_descriptions_are_unique_enough_to_be_found() -> None:
    labels = [each.label for each in EVERY]
    assert len(set(labels)) == len(labels)
    for each in EVERY:
        assert each.description, each.name
        assert each.description[-1] != ".", f"{each.name}: a phrase, not a sentence"


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("error_um", "µm"),
        ("leak_um_per_s", "µm/s"),
        ("gauge_pressure_pa", "Pa"),
        ("gas_temperature_c", "°C"),
        ("lateness_ms", "ms"),
        ("dt_s", "s"),
        ("optics_innovation", "σ"),
        ("pump_fraction", ""),
        ("tick", ""),
    ],
)
def test_the_suffix_of_an_identifier_gives_the_unit(name: str, unit: str) -> None:
    assert unit_of(name) == unit
    assert COLUMNS[name].unit == unit


def test_columns_of_one_plot_have_one_unit() -> None:
    units = defaultdict(set)
    for each in EVERY:
        if each.plot.group in DRAWN:
            units[each.plot].add(each.unit)
    assert {plot.title: found for plot, found in units.items() if len(found) > 1} == {}


def test_columns_of_one_entity_are_in_one_plot_or_recorded_for_programs() -> None:
    plots = defaultdict(set)
    for each in EVERY:
        if each.plot.group in DRAWN:
            plots[each.entity].add(each.plot)
    assert all(len(found) == 1 for found in plots.values())
    assert [each.name for each in EVERY if not each.entity] == ["mono_s"], "the time axis alone"


def test_published_columns_are_in_the_overview_and_codes_have_no_mean() -> None:
    for each in EVERY:
        if each.published:
            assert each.aggregation is Aggregation.EXTREMES, each.name
        if each.kind is Kind.CODE:
            assert each.aggregation in (Aggregation.LAST, Aggregation.LARGEST), each.name
        if each.kind is not Kind.QUANTITY:
            assert each.decimals == 0, each.name


def test_colours_are_plain_rgb() -> None:
    for each in EVERY:
        assert len(each.colour) == 3
        assert all(isinstance(part, int) and 0 <= part <= 255 for part in each.colour)


def test_values_for_people() -> None:
    error, pump = COLUMNS["error_um"], COLUMNS["pump_fraction"]
    assert (error.title, error.legend) == ("error, µm", "error µm")
    assert (pump.title, pump.legend) == ("pump", "pump")
    assert error.format_value(1.005) == "1.00"
    assert error.format_value(-0.001) == "0.00", "no negative zero"
    assert pump.format_value(0.12345) == "0.123"
    assert (
        error.format_value(None)
        == error.format_value(math.nan)
        == error.format_value(math.inf)
        == "–"
    )


def test_a_column_without_a_unit_suffix_has_no_unit() -> None:
    assert (
        TelemetryColumn("gusts", "gusts", "count of gusts", TRUE_ERROR_COLUMN.plot, "/x").title
        == "gusts"
    )


def test_lines_of_one_plot_have_different_colours() -> None:
    for group in Group:
        if group is Group.RECORD:  # drawn by nobody
            continue
        for plot in plots_of(group):
            colours = [column.colour for column in columns_of(plot)]
            assert len(set(colours)) == len(colours), plot.title
