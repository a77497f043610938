"""Sessions on a hold without a laser: figures, each of a moment before it arrives, instead of
readings.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config, EstimatorConfig, PumpConfig, ShapeConfig
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import FIELDS, TelemetryRow
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sessions.folder import SessionFolder, create_session
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_bench, foreign_config
from tuning import estimator_levels
from tuning.identification import experiments
from tuning.identification.record import Record
from tuning.rigs.hold_rig import HoldRig
from tuning.rigs.ticks_by_figures import TicksByFigures
from tuning.steps import characterise, identify, map_pump, observe
from tuning.twin_hold import TwinHold

SIGMA_UM = 0.036


def figure(time_s: float, sag_um: float, number: int = 0) -> ShapeEstimate:
    return ShapeEstimate(
        time_s,
        "track",
        np.full(ZERNIKE_TERMS, sag_um / 100),
        0.0,
        SIGMA_UM**2 * np.eye(ZERNIKE_TERMS),
        sag_um,
        SIGMA_UM,
        math.nan,
        1.0,
        1.0,
        80.0,
        0.0,
        "ok",
        cycle=number,
    )


class LateFigures:
    """Figures of a bench of the second world, each of a moment ago."""

    def __init__(self, plant: ForeignPlant, seed: int, late_s: float) -> None:
        self._plant, self._rng, self._late_s = plant, np.random.default_rng(seed), late_s
        self._kept: deque[ShapeEstimate] = deque()
        self._number = 0

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        self._number += 1
        sag_um = (
            37_100.0 + self._plant.truth().displacement_um + SIGMA_UM * self._rng.standard_normal()
        )
        self._kept.append(figure(now_s, float(sag_um), self._number))
        return self._kept.popleft() if self._kept[0].time_s <= now_s - self._late_s + 1e-9 else None


def by_optics(
    figures_hz: float, full_um_per_s: float = 5.3, weather_sensors: bool = True, **loop: float
) -> Config:
    feed = {"feedforward_barometer": weather_sensors, "feedforward_temperature": weather_sensors}
    config = foreign_config(**{"flow_max_um_per_s": full_um_per_s, **feed, **loop})
    changed = {
        "estimator": EstimatorConfig(process_value="optics"),
        "shape": ShapeConfig(mode="track", track_rate_hz=figures_hz),
        "pump": PumpConfig(flow_full_um_per_s=full_um_per_s),
    }
    return config.model_copy(update=changed)


def started(
    tmp_path: Path, config: Config, plant: ForeignPlant, late_s: float
) -> tuple[TwinHold, HoldRig, SessionFolder]:
    link = TwinHold(config, bench=foreign_bench(plant), figures=LateFigures(plant, 3, late_s))
    folder = create_session(tmp_path, "optics", "tester", link.name, link.config, config.loop)
    return link, HoldRig(link, "tester"), folder


def test_the_pump_is_identified_by_figures_that_come_late(tmp_path: Path) -> None:
    """Counted from their arrival, the delay would be 0.12 s longer, 7 standard errors."""
    plant = ForeignPlant(ForeignPump(delay_s=0.3, lag_s=0.2), 2, 0.7)
    link, rig, folder = started(tmp_path, by_optics(20.0, rate_hz=25.0), plant, 0.12)
    characterise.run_characterise(folder, rig, plan=experiments.SHORT)
    found = identify.run_identify(folder).identified
    observe.run_observe(folder, rig)
    assert found.sigma.delay_s < 0.025
    assert found.model.delay_s == pytest.approx(0.5, abs=0.05)
    assert abs(found.model.gain - 1) < 4 * found.sigma.gain + 0.03
    assert max(abs(row.truth_displacement_um) for row in link.rows[500:]) < 10.0
    saved = estimator_levels.derive_estimator_levels(folder)
    assert saved["pump_delay_s"] + saved["pump_lag_s"] == pytest.approx(0.5, abs=0.05)
    assert "laser_noise_um" not in saved  # there is none, and a figure states its own


def row(time_s: float) -> TelemetryRow:
    return replace(TelemetryRow(*[0.0] * len(FIELDS)), mono_s=time_s, displacement_um=math.nan)


@pytest.fixture
def ticks() -> TicksByFigures:
    return TicksByFigures(by_optics(20.0))


def test_a_tick_waits_for_the_figure_after_it_and_has_what_both_show(ticks: TicksByFigures) -> None:
    assert ticks.add_rows([row(1.00), row(1.02)], [figure(0.99, 37_100.0)]) == []
    early, late = ticks.add_rows([row(1.04)], [figure(1.03, 37_104.0)])
    assert (early.mono_s, late.mono_s) == (1.00, 1.02)
    assert [early.displacement_um, late.displacement_um] == pytest.approx([1.0, 3.0])
    assert [
        tick.displacement_um for tick in ticks.add_rows([], [figure(1.05, 37_100.0)])
    ] == pytest.approx([2.0])


@pytest.mark.parametrize("kind", ["full", "rejected", "older", "none"])
def test_a_figure_that_does_not_show_the_mirror_is_not_used(
    ticks: TicksByFigures, kind: str
) -> None:
    wrong = figure(1.03, 37_150.0)
    spoilt = {
        "full": [replace(wrong, kind="full")],
        "rejected": [replace(wrong, verdict="rejected")],
        "older": [replace(wrong, time_s=0.98)],
        "none": [],
    }[kind]
    assert ticks.add_rows([row(1.02)], [figure(0.99, 37_100.0), *spoilt]) == []
    (tick,) = ticks.add_rows([], [figure(1.05, 37_106.0)])
    assert tick.displacement_um == pytest.approx(3.0)


def test_ticks_that_no_figure_shows_are_lost_readings_and_not_a_straight_line(
    ticks: TicksByFigures,
) -> None:
    taken = ticks.add_rows([row(0.9), row(1.0)], [figure(0.95, 37_100.0)])
    assert math.isnan(taken[0].displacement_um)  # before the first figure
    dark = ticks.add_rows([row(1.0 + 0.02 * n) for n in range(1, 100)], [])
    assert dark  # nothing waits for ever
    assert all(math.isnan(tick.displacement_um) for tick in dark)
    rest = ticks.add_rows([row(2.99)], [figure(2.985, 37_100.0), figure(3.035, 37_110.0)])
    assert [math.isnan(tick.displacement_um) for tick in rest[-2:]] == [True, False]
    assert rest[-1].displacement_um == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("asked_hz", "comes_s", "expected_s"),
    [(20.0, 0.05, 0.05), (20.0, 0.11, 0.11), (5.0, 0.02, 0.2)],
)
def test_readings_have_the_interval_of_the_figures(
    asked_hz: float, comes_s: float, expected_s: float
) -> None:
    ticks = TicksByFigures(by_optics(asked_hz))
    ticks.add_rows([], [figure(comes_s * n, 37_100.0 + n) for n in range(1, 20)])
    assert ticks.interval_s == pytest.approx(expected_s)


def test_a_record_of_every_third_reading_has_the_mean_flow_between_them() -> None:
    flow, read = np.array([1.0, 2.0, 3.0, 4.0, 4.0, 4.0, 9.0]), np.arange(7.0)
    third = Record(0.02, flow, read, read + 10, read + 20).every(3)
    assert third.dt_s == pytest.approx(0.06)
    assert third.flow_um_per_s.tolist() == [2.0, 4.0]
    assert [column.tolist() for column in (third.displacement_um, third.ambient_pressure_pa)] == [
        [0, 3],
        [10, 13],
    ]


# Random benches of the second world.


def held_std_um(config: Config, plant: ForeignPlant, late_s: float) -> float:
    """Of the true centre in five minutes of hold."""
    link = TwinHold(config, bench=foreign_bench(plant), figures=LateFigures(plant, 5, late_s))
    while link.rows[-1].mono_s < link.rows[0].mono_s + 340.0:
        link.read_news()
    return float(
        np.std(
            [tick.truth_displacement_um for tick in link.rows[round(40.0 * config.loop.rate_hz) :]]
        )
    )


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(12))
def test_a_bench_of_which_nothing_is_known_is_held_better_by_what_was_identified(
    seed: int, tmp_path: Path
) -> None:
    """Delays up to 1.1 s, which are not those of the configuration; 5 to 25 figures a second, up to
    0.15 s late.
    """
    rng = np.random.default_rng(900 + seed)
    full_um_per_s, delay_s, lag_s = rng.uniform((4, 0.03, 0.05), (8, 0.6, 0.5)).tolist()
    figures_hz, weather = np.exp(rng.uniform(np.log((5, 0.3)), np.log((25, 2)))).tolist()
    late_s, leak_um_per_s = rng.uniform((0.02, 0.9), (0.15, 2.0)).tolist()
    gusts = bool(rng.random() < 0.3)

    def plant(seed: int) -> ForeignPlant:
        pump = ForeignPump(full_um_per_s=full_um_per_s, delay_s=delay_s, lag_s=lag_s)
        return ForeignPlant(pump, seed, weather, leak_um_per_s, gusts)

    config = by_optics(figures_hz, full_um_per_s)
    link, rig, folder = started(tmp_path, config, plant(seed), late_s)
    characterise.run_characterise(folder, rig)
    found = identify.run_identify(folder)
    if found.quality.verdict == "refused":
        assert found.quality.pump_unknown  # which is true: its curve is not straight
        folder = map_pump.map_pump(folder, rig)[1]
        config = folder.config
        characterise.run_characterise(folder, rig)
        found = identify.run_identify(folder)
    observe.run_observe(folder, rig)
    identified = found.identified
    assert identified.model.delay_s == pytest.approx(
        delay_s + lag_s, abs=max(0.03, 3 * identified.sigma.delay_s)
    )
    assert max(abs(tick.truth_displacement_um) for tick in link.rows[2000:]) < 10.0
    configured = EstimatorConfig.model_validate(
        config.estimator.model_dump() | estimator_levels.derive_estimator_levels(folder)
    )
    before_um = held_std_um(config, plant(seed + 50), late_s)
    after_um = held_std_um(
        config.model_copy(update={"estimator": configured}), plant(seed + 50), late_s
    )
    assert after_um < 1.1 * before_um
