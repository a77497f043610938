"""`climate`: minutes of a run, and what is printed of a fit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.metrology.film.climate_fit import ClimateFit, Expansion
from membrane_ctrl.review.statistics.climate_run import format_fit, read_minutes


def test_figures_are_averaged_in_the_minutes_of_the_sensors() -> None:
    coeffs_um = np.zeros((6, 36))
    coeffs_um[:, 10] = [1.0, 3.0, 100.0, 5.0, 7.0, 9.0]
    shapes = SimpleNamespace(
        time_s=np.array([5.0, 50.0, 55.0, 130.0, 150.0, 170.0]),
        coeffs_um=coeffs_um,
        verdict=np.array(["ok", "ok", "rejected", "ok", "ok", "degraded"]),
    )
    level = {
        "time_s": np.array([0.0, 60.0, 120.0]),
        "mean_film_temperature_c": np.array([21.0, 21.1, 21.2]),
        "mean_ring_temperature_c": np.array([20.0, 20.0, 20.0]),
        "mean_humidity_percent": np.full(3, np.nan),
    }
    run: Any = SimpleNamespace(shapes=lambda: shapes, level=lambda *_, **__: level)
    minutes = read_minutes(run)
    assert minutes["spherical_um"] == pytest.approx([2.0, np.nan, 7.0], nan_ok=True)
    assert minutes["film_c"] == pytest.approx([21.0, 21.1, 21.2])


def test_a_fit_is_printed_as_a_table_of_the_configuration() -> None:
    fit = ClimateFit(
        Expansion(18.2, 0.9), None, Expansion(7.4, 0.15), 1500.0, residual_um=0.02, explained=0.99
    )
    text = "\n".join(format_fit(fit))
    vague = replace(fit, film_per_percent=Expansion(1.1, 8.5))
    assert "# film_ppm_per_percent: not determined, 1.10 +- 8.50" in format_fit(vague)
    assert "film_sigma_relative = 0.05" in format_fit(vague)
    assert not any(line.startswith("film_follows") for line in format_fit(vague))
    assert "film_ppm_per_k = 18.20  # +- 0.90" in text
    assert "# ring_ppm_per_k: its cause has changed too little" in text
    assert "film_sigma_relative = 0.05" in text
    assert "film_follows_humidity_s = 1500" in text
