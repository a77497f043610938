"""summary.json against the same figures computed with NumPy over the whole run at once."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import plain_json
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.state_tree import decode_state, encode_state
from membrane_ctrl.model.telemetry import (
    SETTLED_AFTER_S,
    Rows,
    State,
    TelemetryRow,
    get_column,
    unpack_rows,
)
from membrane_ctrl.run_files.hold_parts import held_at
from membrane_ctrl.run_files.summary import SCHEMA, Summary
from tests.worlds.synthetic_run import RATE_HZ, rows_of, shape_of

HOLD_FROM_S = 6.0


def table(rows: list[TelemetryRow]) -> Rows:
    return unpack_rows([row.pack() for row in rows])


def summary_of(rows: list[TelemetryRow], batch: int = 50) -> dict[str, object]:
    summary = Summary.for_config(Config())
    values = table(rows)
    for start in range(0, len(values), batch):
        summary.add_rows(values[start : start + batch])
    return summary.as_dict({"telemetry": 0}, {})


@pytest.mark.parametrize("batch", [1, 33, 50, 5000])
def test_true_figures_agree_with_numpy(batch: int) -> None:
    rows = rows_of(40.0)
    values = table(rows)
    found = summary_of(rows, batch)
    settled = values[get_column(values, "mono_s") >= HOLD_FROM_S + SETTLED_AFTER_S]
    true_um = get_column(settled, "target_um") - get_column(settled, "truth_displacement_um")
    per_second = true_um[: len(true_um) // 50 * 50].reshape(-1, 50).mean(axis=1)
    assert found["true_std_um"] == pytest.approx(true_um.std(), rel=1e-9)
    assert found["true_bias_um"] == pytest.approx(true_um.mean(), rel=1e-6, abs=1e-12)
    assert found["in_band_1s_fraction"] == 1.0
    assert found["sag_error_um"]["start"] == pytest.approx(per_second[0])  # type: ignore[index]
    assert found["band_1s_windows"] in (len(per_second), len(per_second) - 1)
    reading_um = get_column(settled, "displacement_um") - get_column(settled, "setpoint_um")
    assert found["reading_std_um"] == pytest.approx(reading_um.std(), rel=1e-9)


def test_counters_states_and_lateness() -> None:
    rows = rows_of(20.0)
    found = summary_of(rows)
    lateness = get_column(table(rows), "lateness_ms")
    assert found["schema"] == SCHEMA
    assert found["ticks"] == 20 * RATE_HZ
    assert found["states"] == [
        {"state": "standby", "mono_s": 0.0},
        {"state": "settle", "mono_s": 1.0},
        {"state": "hold", "mono_s": 6.0},
    ]
    assert found["lateness_ms"]["max"] == lateness.max()  # type: ignore[index]
    assert found["lateness_ms"]["p99"] == pytest.approx(np.quantile(lateness, 0.99), rel=0.02)  # type: ignore[index]
    assert found["leak_um_per_s"] == 1.24
    assert found["duration_s"] == rows[-1].mono_s


def test_dropped_rows_are_ticks_too() -> None:
    summary = Summary.for_config(Config())
    summary.add_rows(table(rows_of(1.0)))
    assert summary.as_dict({"inputs": 7}, {})["ticks"] == 57


def test_a_real_bench_has_no_true_figures() -> None:
    found = json.loads(plain_json.dumps(summary_of(rows_of(20.0, truth=False))))
    assert found["true_std_um"] is None
    assert found["true_bias_um"] is None
    assert found["in_band_1s_fraction"] is None
    assert found["sag_error_um"] == {"start": None, "end": None}
    assert found["reading_std_um"] == pytest.approx(1.0, rel=0.1)


def test_rows_of_a_setpoint_ramp_do_not_count() -> None:
    rows = rows_of(40.0)
    # target jumps by 100 µm at 20 s, the ramp takes until 25 s, the truth follows the ramp
    moved = [
        replace(
            row,
            target_um=row.target_um + 100.0,
            setpoint_um=row.setpoint_um + min(100.0, (row.mono_s - 20.0) * 20.0),
            truth_displacement_um=row.truth_displacement_um
            + min(100.0, (row.mono_s - 20.0) * 20.0),
        )
        if row.mono_s >= 20.0
        else row
        for row in rows
    ]
    found = summary_of(moved)
    values = table(rows)
    time_s = get_column(values, "mono_s")
    counted = values[((time_s >= 11.0) & (time_s < 20.0)) | (time_s >= 25.0 + SETTLED_AFTER_S)]
    true_um = get_column(counted, "truth_displacement_um") - get_column(counted, "target_um")
    assert found["true_std_um"] == pytest.approx(true_um.std(), rel=0.02)
    assert found["in_band_1s_fraction"] == 1.0


def test_out_of_band_seconds_are_counted() -> None:
    rows = [
        replace(row, truth_displacement_um=row.truth_displacement_um + 5.0)
        if 20.0 <= row.mono_s < 22.0
        else row
        for row in rows_of(41.02)
    ]
    found = summary_of(rows)
    assert found["in_band_1s_fraction"] == pytest.approx(28 / 30)


def test_leaving_hold_ends_the_settled_rows() -> None:
    rows = [
        replace(row, state=float(State.LOWER), truth_displacement_um=-500.0)
        if row.mono_s >= 30.0
        else row
        for row in rows_of(40.0)
    ]
    found = summary_of(rows)
    assert found["true_std_um"] < 0.2  # type: ignore[operator]
    assert found["states"][-1] == {"state": "lower", "mono_s": 30.0}  # type: ignore[index]


def test_events_and_cycles() -> None:
    summary = Summary.for_config(Config())
    fault = {"kind": "fault", "mono_s": 3.0, "cause": "over_pressure"}
    for event in ({"kind": "state"}, fault, {"kind": "end", "mono_s": 9.5, "exit": "safety_trip"}):
        summary.add_event(event)
    latencies_s = np.linspace(0.02, 0.12, 40)
    for k, latency_s in enumerate(latencies_s):
        summary.add_shape(
            replace(
                shape_of(float(k), k, "rejected" if k < 3 else "ok"), latency_s=float(latency_s)
            )
        )
    found = summary.as_dict({}, {})
    assert (found["faults"], found["fault_count"], found["exit"]) == ([fault], 1, "safety_trip")
    assert found["duration_s"] == 9.5
    assert (found["cycles"], found["cycles_rejected"]) == (40, 3)
    assert found["cycle_latency_ms"]["p50"] == pytest.approx(
        np.quantile(latencies_s, 0.5) * 1e3, rel=0.05
    )


def test_the_fault_in_which_a_run_ends_is_named_and_survives_a_restart_of_the_recorder() -> None:
    summary = Summary.for_config(Config())
    fault = Fault(
        14,
        "laser_implausible",
        "the laser is wrong",
        "laser +9 µm",
        "limits.x",
        "hold_flow",
        False,
        "look",
    )
    summary.add_event({"mono_s": 1.0, **fault.to_dict()})
    restored = decode_state(encode_state(summary), Summary, 1_000_000)
    for each in (summary, restored):
        each.add_event({"kind": "end", "mono_s": 2.0, "exit": "safety_trip"})
        assert each.as_dict({}, {})["ended_in"] == fault.to_dict()
    summary.add_event({"kind": "state", "state": "standby", "from": "fault", "why": "acknowledged"})
    assert summary.as_dict({}, {})["ended_in"] is None


def test_lists_do_not_grow_with_a_flickering_state() -> None:
    summary = Summary.for_config(Config())
    rows = table(rows_of(60.0))
    rows = rows.copy()
    get_column(rows, "state")[:] = np.arange(len(rows)) % 2
    summary.add_rows(rows)
    for _ in range(3000):
        summary.add_event({"kind": "fault"})
    found = summary.as_dict({}, {})
    assert (len(found["states"]), found["transitions"]) == (1000, 3000)
    assert (len(found["faults"]), found["fault_count"]) == (1000, 3000)


def test_an_empty_run_has_a_summary_of_nulls() -> None:
    found = json.loads(plain_json.dumps(Summary.for_config(Config()).as_dict({}, {})))
    assert (found["ticks"], found["exit"], found["lateness_ms"]["p99"]) == (0, None, None)


def test_json_has_null_for_what_is_not_a_number() -> None:
    text = plain_json.dumps({"a": math.nan, "b": [math.inf, 1.0], "c": {"d": (-math.inf,)}})
    assert json.loads(text) == {"a": None, "b": [None, 1.0], "c": {"d": [None]}}


def test_the_geometry_that_was_measured_with_is_named() -> None:
    summary = Summary.for_config(Config())
    assert summary.as_dict({}, {})["geometry"] == {}
    origin = {"hash": "12ab", "file": "g.toml", "calibrated_utc": "2026-01-02"}
    summary.add_event({"kind": "geometry", **origin, "message": "", "mono_s": 3.0})
    assert summary.as_dict({}, {})["geometry"] == origin


@pytest.mark.parametrize("window_s", [1.0, 10.0])
def test_a_cycle_counts_once_the_hold_has_settled(window_s: float) -> None:
    starts_s = np.arange(0.0, 60.0, window_s)
    state = np.where(starts_s >= 20.0, State.HOLD, State.SETTLE)
    seen = held_at({"time_s": starts_s, "state": state}, np.array([3.0, 20.5, 24.9, 25.1, 59.0]))
    assert list(seen) == [False, False, False, True, True]
    assert list(
        held_at({"time_s": starts_s, "state": state * 0 + State.HOLD}, np.array([3.0]))
    ) == [True]
