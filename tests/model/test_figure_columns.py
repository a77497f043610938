"""The table of columns of measured figures: complete, and of one unit and entity a plot."""

from __future__ import annotations

import pytest

from membrane_ctrl.model import figure_columns, shape_estimate
from membrane_ctrl.model.columns import Plot
from membrane_ctrl.run_files import streams, table_specs

PLOTS = tuple(dict.fromkeys(each.plot for each in figure_columns.DRAWN_COLUMNS))


def test_each_recorded_number_has_a_column() -> None:
    assert tuple(figure_columns.RECORDED_COLUMNS) == shape_estimate.NUMBERS


def test_the_tables_state_description_and_unit() -> None:
    for spec in (table_specs.SHAPES, table_specs.TRACKED):
        for name, each in figure_columns.RECORDED_COLUMNS.items():
            metadata = spec.schema.field(name).metadata
            assert metadata[b"description"].decode() == each.description
            assert metadata.get(b"unit", b"").decode() == each.unit
    residual = table_specs.SHAPES.schema.field("slope_residual_urad")
    assert residual.metadata[b"unit"].decode() == "µrad"


@pytest.mark.parametrize("plot", PLOTS, ids=lambda plot: plot.title)
def test_the_columns_of_a_plot_share_entity_and_unit(plot: Plot) -> None:
    shown = figure_columns.figure_columns_of(plot)
    assert len({each.entity for each in shown}) == 1
    assert len({each.unit for each in shown}) == 1


def test_the_legend_of_the_viewer_is_that_of_the_table() -> None:
    assert [line.name for line in streams.SAG.lines] == ["sag change ± 1σ µm", "laser change µm"]
    assert streams.RESIDUAL.lines[0].name == "slope residual µrad"
    assert streams.CHANGE.lines[0].name == "defocus Z4 µm"
    assert streams.ZERNIKE.lines[0].name == "Z1 µm"
    assert [line.name for line in streams.QUALITY.lines] == ["valid fraction", "saturated fraction"]
    title = figure_columns.figure_plot_title(figure_columns.SAG_CHANGE, "trim")
    assert title == "Sag change by camera and laser, trim, µm"
