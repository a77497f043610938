"""The page of figures so far."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import acquisition_events, events
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.telemetry import unpack_rows
from membrane_ctrl.recorder.summary_page import summary_page
from membrane_ctrl.run_files.summary import Summary
from tests.worlds.synthetic_run import rows_of, shape_of

FAULT = events.Fault(
    33, "board_fault", "a cause", "bits 0x4", "must be 0", "pump_off", True, "a remedy"
)


def page(summary: Summary, status: RunStatus) -> dict[str, str]:
    lines = summary_page(summary.as_dict({}, {}), status, Config()).splitlines()
    assert lines[1] == "|---|---|"
    return dict(
        line.strip("| ").split(" | ") for line in (lines[0].replace("|  |", "| - |"), *lines[2:])
    )


def test_before_anything_happened() -> None:
    text = page(Summary.for_config(Config()), RunStatus())
    assert text["not started"] == "-"
    assert text["faults"] == "none"
    assert "mean error" not in text


def test_figures_are_those_of_the_summary() -> None:
    summary = Summary.for_config(Config())
    summary.add_rows(unpack_rows([row.pack() for row in rows_of(30.0)]))
    summary.add_shape(shape_of(20.0, 1, verdict="rejected"))
    for event in (
        FAULT,
        acquisition_events.GeometryInUse("0f93", "bench.toml", "2026-11-21", ""),
    ):
        summary.add_event(event.to_dict())
    gains = dict(vars(Config().loop)) | {"kp_per_s": 0.8}
    status = RunStatus(why="inside +-2 µm | so far").after_event(
        events.CommandTaken("gains", "ann", "", value=60.0, loop=gains), 20.0
    )
    text = page(summary, status)
    held = summary.as_dict({}, {})["held"]
    assert text["hold"] == "inside ±2 µm / so far"
    assert text["std of 1 s means, true centre"] == f"{held['std_um']:.3g} µm"
    assert text["1 s means within ±2 µm"] == "100 %"
    assert np.isclose(held["held_s"], 19.0, atol=0.1)
    assert text["held"] == "0:00:19"
    assert (text["faults"], text["last fault"]) == ("1", "board_fault")
    assert text["shape cycles"] == "1, 1 rejected"
    assert text["geometry"] == "0f93, bench.toml, calibrated 2026-11-21"
    assert text["gains"].startswith("Kp 0.8 1/s, Ti 6.5 s, Td 0 s; on trial, reverted in 50 s")
