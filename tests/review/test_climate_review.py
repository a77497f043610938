"""What the report shows of a run's climate."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.report_pages.blocks import PageFacts
from membrane_ctrl.review.report.figures import draw_climate
from membrane_ctrl.review.report.run_page import _list_climate
from membrane_ctrl.review.statistics.climate_review import review_climate

UNKNOWN = np.full(4, np.nan)
LEVEL = {
    "time_s": 60.0 * np.arange(4),
    "mean_film_temperature_c": np.array([np.nan, 22.0, 22.5, 23.0]),
    "mean_ring_temperature_c": UNKNOWN,
    "mean_humidity_percent": np.array([45.0, 45.5, 46.0, 46.0]),
    "mean_climate_figure_um": np.array([np.nan, 0.0, 2.0, 3.5]),
}


def run_of(film_ppm: float, ring_ppm: float) -> Any:
    block = {
        "film_strain_ppm": np.array([1.0, film_ppm]),
        "ring_strain_ppm": np.array([0.0, ring_ppm]),
        "climate_sigma_um": np.array([0.4, np.nan]),
    }
    return SimpleNamespace(config=Config(), tick_blocks=lambda *_: iter([block]))


def test_the_climate_of_a_run_is_shown_with_what_it_predicts() -> None:
    climate = review_climate(run_of(17.0, -3.0), LEVEL)
    assert climate is not None
    assert climate.spherical_um == pytest.approx(20 * 0.0822, rel=0.02)
    assert climate.last_sigma_um == 0.4
    facts = _list_climate(climate)[0]
    assert isinstance(facts, PageFacts)
    text = "\n".join(f"{name}: {value}" for name, value in facts.facts)
    assert "film: 22.00 to 23.00 °C, at the end 23.00" in text
    assert "ring: no sensor" in text
    assert "3.5 ± 0.4 µm RMS at the end" in text
    assert "notice beyond 3" in text
    assert "Relative humidity" in draw_climate(climate)


def test_a_bench_without_sensors_has_no_such_section() -> None:
    level = {"time_s": LEVEL["time_s"], "mean_film_temperature_c": UNKNOWN}
    assert review_climate(run_of(0.0, 0.0), level) is None


def test_a_run_without_ticks_shows_its_sensors_and_no_strains() -> None:
    run = SimpleNamespace(config=Config(), tick_blocks=lambda *_: iter([]))
    climate = review_climate(run, LEVEL)  # type: ignore[arg-type]
    assert climate is not None
    assert climate.film_c[-1] == 23.0
    assert np.isnan([climate.film_ppm, climate.ring_ppm, climate.spherical_um]).all()
