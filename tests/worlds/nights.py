"""Simulated nights with known events, much faster than the twin, for tests of the review.

The film as an integrator of pump flow, leak, air pressure and gas temperature with the numbers of
docs/explanation/physics.md and of the twin's scenarios; a 10 Hz PI loop with filter, feed-forward,
dead time and pump lag; laser noise, quantisation; Ornstein-Uhlenbeck weather. A night of eight
hours takes a quarter of a second. Written by the recorder's own code.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from membrane_ctrl.config import toml_file as config_file
from membrane_ctrl.config.schema import Config, LoopConfig
from membrane_ctrl.controller.tick_assembler import TickBatch
from membrane_ctrl.controller.tick_codec import RECORD, TICK
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import COLUMN, FIELDS, Rows, ShapeState, State
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.run_files.run_tables import RunTables
from membrane_ctrl.run_files.table_fields import ROW_COLUMNS

RATE_HZ = 10.0
CONFIG = Config(loop=LoopConfig(rate_hz=RATE_HZ))
STARTED_UTC = datetime(2026, 11, 21, 18, 0, 0, tzinfo=UTC)
# Standard deviation and correlation time of air pressure and air temperature
# (docs/explanation/physics.md).
WEATHER = {
    "quiet": (0.2, 30.0, 0.010, 300.0),
    "typical": (1.2, 30.0, 0.050, 300.0),
    "gusty": (4.0, 20.0, 0.100, 300.0),
}
LEAK_UM_PER_S = 1.24
SHAPE_PERIOD_S = 4.0
_SYNC_MINUTES = 10
DOOR, LEAK, GLITCH, LOST, LATE, JUMP = (
    "pressure step",
    "flow step",
    "laser glitch",
    "laser lost",
    "lateness burst",
    "shape jump",
)


@dataclass(frozen=True, slots=True)
class Planted:
    """An event put into a night: `size` in Pa, per cent, µm, s, ms or µm of figure."""

    kind: str
    time_s: float
    size: float


def planted(rng: np.random.Generator, hours: float, share: float = 1.0) -> list[Planted]:
    """A night's worth of events, ten minutes or more apart; `share` of them for a calmer one."""
    slots = rng.permutation(
        np.arange(1, int(hours * 6))
    )  # ten minutes each, the first one left alone
    kinds = [DOOR] * 4 + [LEAK] * 2 + [GLITCH] * 4 + [LOST] * 2 + [LATE] * 2 + [JUMP]
    kinds = [kind for kind in kinds if rng.random() < share]
    events = []
    leaks: list[float] = []
    for kind in kinds:
        free = next(
            (s for s in slots if kind != LEAK or all(abs(s - other) >= 3 for other in leaks)), None
        )
        if free is None:
            break
        slots = slots[slots != free]
        if kind == LEAK:
            leaks.append(float(free))
        events.append(
            Planted(kind, 600.0 * float(free) + float(rng.uniform(100, 500)), _size(kind, rng))
        )
    return sorted(events, key=lambda event: event.time_s)


def _size(kind: str, rng: np.random.Generator) -> float:
    sign = float(rng.choice([-1.0, 1.0]))
    sizes = {
        DOOR: sign * rng.uniform(10, 30),
        LEAK: rng.uniform(30, 120) if sign > 0 else rng.uniform(-50, -30),
        GLITCH: sign * rng.uniform(8, 45),
        LOST: rng.uniform(0.5, 5),
        LATE: rng.uniform(15, 80),
        JUMP: sign * rng.uniform(1, 4),
    }
    return float(sizes[kind])


def night(
    seed: int, hours: float, scenario: str, events: list[Planted], start_s: float = 0.0
) -> tuple[Rows, list[ShapeEstimate]]:
    """Telemetry rows and shapes of a night (or of a part of a run that begins at `start_s`)."""
    rng = np.random.default_rng(seed)
    count = round(hours * 3600 * RATE_HZ)
    time_s = start_s + np.arange(count) / RATE_HZ
    rows = np.zeros((count, len(FIELDS)))
    leak = np.full(count, LEAK_UM_PER_S)
    spikes, lost = np.zeros(count), np.zeros(count)
    pressure_sd, pressure_tau, air_sd, air_tau = WEATHER[scenario]
    pressure = _wander(rng, count, pressure_sd, pressure_tau)
    air = _wander(rng, count, air_sd, air_tau)
    lateness = 0.5 + rng.exponential(0.3, count)
    for event in events:
        k = int(np.searchsorted(time_s, event.time_s))
        if event.kind == DOOR:
            pressure[k:] += event.size
        elif event.kind == LEAK:
            leak[k:] *= 1 + event.size / 100
        elif event.kind == GLITCH:
            spikes[k] = event.size
        elif event.kind == LOST:
            lost[k : k + max(1, round(event.size * RATE_HZ))] = 1.0
        elif event.kind == LATE:
            late = np.arange(k, k + 60, 6)
            lateness[late] += event.size * rng.uniform(0.6, 1.0, late.size)
    loop = CONFIG.loop
    noise = rng.normal(size=count)
    columns = _closed_loop(
        pressure, air, leak, noise, spikes, lost, loop.kp_per_s, loop.ti_s, 1 / RATE_HZ
    )
    for name, values in zip(_LOOP_COLUMNS, columns.T, strict=True):
        rows[:, COLUMN[name]] = values
    rows[:, COLUMN["mono_s"]] = time_s + 1e-3 * lateness
    rows[:, COLUMN["tick"]] = np.rint(time_s * RATE_HZ)
    rows[:, COLUMN["dt_s"]] = 1 / RATE_HZ
    rows[:, COLUMN["lateness_ms"]] = lateness
    rows[:, COLUMN["state"]] = State.HOLD
    rows[:, COLUMN["shape_state"]] = ShapeState.TRACKING
    rows[:, COLUMN["pump_fraction"]] = 0.1 + 0.9 * rows[:, COLUMN["flow_um_per_s"]] / 5.3
    rows[:, COLUMN["ambient_pressure_pa"]] = 101_325 + pressure + 0.05 * rng.normal(size=count)
    rows[:, COLUMN["air_temperature_c"]] = 21 + air + 0.002 * rng.normal(size=count)
    rows[:, COLUMN["gauge_pressure_pa"]] = 600 + 0.5 * rng.normal(size=count)
    rows[:, COLUMN["displacement_quality"]] = 3 * lost
    rows[:, COLUMN["sample_counter"]] = rows[:, COLUMN["tick"]]
    rows[:, COLUMN["device_time_s"]] = time_s
    return rows, list(_shapes(rng, time_s, rows, events))


def batch_of(rows: Rows) -> TickBatch:
    """Ticks with these rows, and their inputs as far as the rows give them."""
    records = np.zeros(len(rows), dtype=RECORD)
    for name, column in ROW_COLUMNS.items():
        values = rows[:, COLUMN[column]]
        records[name] = np.nan_to_num(values) if records[name].dtype.kind in "iu" else values
    return TickBatch(records, rows, {}, {})


def messages_of(rows: Rows) -> list[bytes]:
    """These ticks as they cross to the recorder."""
    batch = batch_of(rows)
    return [
        TICK + record.tobytes() + row.tobytes()
        for record, row in zip(batch.records, rows, strict=True)
    ]


def _wander(rng: np.random.Generator, count: int, sd: float, tau_s: float) -> NDArray[np.float64]:
    """An Ornstein-Uhlenbeck process, exact at the ticks."""
    return _first_order(rng.normal(size=count), float(np.exp(-1 / (RATE_HZ * tau_s))), sd)


@njit(cache=True)
def _first_order(noise: NDArray[np.float64], keep: float, sd: float) -> NDArray[np.float64]:
    value = sd * noise[0]
    for k in range(noise.size):
        value = keep * value + sd * np.sqrt(1 - keep * keep) * noise[k]
        noise[k] = value
    return noise


_LOOP_COLUMNS = (
    "displacement_um",
    "filtered_um",
    "error_um",
    "p_um_per_s",
    "i_um_per_s",
    "feedforward_um_per_s",
    "flow_wanted_um_per_s",
    "flow_um_per_s",
    "leak_um_per_s",
    "truth_displacement_um",
)


@njit(cache=True)
def _closed_loop(
    pressure: NDArray[np.float64],
    air: NDArray[np.float64],
    leak: NDArray[np.float64],
    noise: NDArray[np.float64],
    spikes: NDArray[np.float64],
    lost: NDArray[np.float64],
    kp: float,
    ti: float,
    dt: float,
) -> NDArray[np.float64]:
    """(n, 10) columns of `_LOOP_COLUMNS`; a tick of dead time, 0.15 s pump lag,
    filters of 0.2 s.
    """
    out = np.empty((pressure.size, 10))
    true = filtered = ff = 0.0
    integral = flow = leak_seen = leak[0]
    pumped = leak[0]
    gas = air[0]
    for k in range(pressure.size):
        before = k - 1 if k > 0 else 0
        warmed = (air[k] - gas) * (1 - np.exp(-dt / 12.0))
        gas += warmed
        pumped += (flow - pumped) * (1 - np.exp(-dt / 0.15))
        step = pressure[k] - pressure[before]
        true += (pumped - leak[k]) * dt - 0.358 * step + 123.0 * warmed
        reading = np.round((true + noise[k] + spikes[k]) * 10) / 10
        if lost[k] == 0.0:
            filtered += (reading - filtered) * (1 - np.exp(-dt / 0.2))
        error = -filtered
        ff += ((0.358 * step - 123.0 * warmed) / dt - ff) * (1 - np.exp(-dt / 0.2))
        proportional = kp * error if lost[k] == 0.0 else 0.0
        wanted = proportional + integral + ff
        flow = min(max(wanted, 0.0), 5.3)
        if lost[k] == 0.0:
            integral += dt * (kp / ti * error + (flow - wanted) / ti)
            integral = min(max(integral, 0.0), 5.3)
        leak_seen += (flow - ff - leak_seen) * dt / 60.0
        out[k, 0] = reading if lost[k] == 0.0 else np.nan
        out[k, 1] = filtered
        out[k, 2] = error
        out[k, 3] = proportional
        out[k, 4] = integral
        out[k, 5] = ff
        out[k, 6] = wanted
        out[k, 7] = flow
        out[k, 8] = leak_seen
        out[k, 9] = true
    return out


def _shapes(
    rng: np.random.Generator, time_s: NDArray[np.float64], rows: Rows, events: list[Planted]
) -> Iterator[ShapeEstimate]:
    """A figure with 20 nm of noise a term, an astigmatism that creeps, and jumps in it."""
    covariance = np.diag(np.full(ZERNIKE_TERMS, 0.02**2))
    jumps = [(event.time_s, event.size) for event in events if event.kind == JUMP]
    every = round(SHAPE_PERIOD_S * RATE_HZ)
    true_um = rows[:, COLUMN["truth_displacement_um"]]
    for k in range(every // 2, time_s.size, every):
        now_s = float(time_s[k])
        coeffs = 0.02 * rng.normal(size=ZERNIKE_TERMS)
        sag = 37_100.0 + true_um[k] + 0.05 * rng.normal()
        coeffs[[0, 3]] += sag / 2, sag / (2 * np.sqrt(3))
        coeffs[4] += 900 + 0.02 * now_s / 3600
        coeffs[5] += 400 + sum(size for at_s, size in jumps if now_s >= at_s)
        yield ShapeEstimate(
            time_s=now_s,
            kind="fringes",
            coeffs_um=coeffs,
            hencky_um=0.0,
            covariance_um2=covariance,
            sag_um=float(sag),
            sag_change_sigma_um=0.05,
            displacement_um=float(true_um[k] + 0.1 * rng.normal()),
            slope_residual_urad=3.1,
            valid_fraction=0.99,
            modulation_median_adu=81.0,
            saturated_fraction=0.0,
            verdict="ok",
            latency_s=0.05,
            cycle=k // every,
        )


def write_run(folder: Path, parts: Iterator[tuple[Rows, list[ShapeEstimate]]]) -> None:
    """A run folder as the recorder leaves it, without Rerun segments: batches of a minute, as they
    come in a run.
    """
    folder.mkdir(parents=True)
    (folder / "config.toml").write_text(config_file.dump_toml(CONFIG), encoding="utf-8")
    tables = RunTables(folder)
    end_s = 0.0
    minute = round(60 * RATE_HZ)
    for rows, shapes in parts:
        for first in range(0, len(rows), minute):
            tables.add_ticks(batch_of(rows[first : first + minute]))
            if first // minute % _SYNC_MINUTES == 0:
                tables.sync_tables()
                tables.seal_full_journal()
        for estimate in shapes:
            tables.add_shape(estimate)
        end_s = float(rows[-1, COLUMN["mono_s"]])
    tables.close()
    events = [
        {"mono_s": 0.0, "kind": "start"},
        {
            "mono_s": 0.0,
            "kind": "state",
            "state": "hold",
            "from": "settle",
            "why": "inside the band",
        },
        {"mono_s": end_s, "kind": "end", "exit": "done", "exit_code": 0},
    ]
    lines = [
        json.dumps({"time_utc": (STARTED_UTC + timedelta(seconds=e["mono_s"])).isoformat(), **e})
        for e in events
    ]
    (folder / "events.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    summary = {"schema": "membrane-summary/2", "exit": "done", "duration_s": end_s}
    (folder / "summary.json").write_text(json.dumps(summary) + "\n", encoding="utf-8")
