"""`film RUN...`: the twin's film gives way under a hold; its drift of tomorrow is known from its
own equations.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.errors import RejectedError
from membrane_ctrl.review.statistics import film_run
from membrane_ctrl.sim.stretched_film import solve_stretched_film

HOUR_S, RADIUS_MM, PRESTRAIN, POISSON = 3600.0, 500.0, 4e-4, 0.36


def stiffness_n_per_m(time_s: np.ndarray) -> np.ndarray:
    """E t of a film that was loaded three hours before the run."""
    return 2e5 * (1 - 4e-3 * np.log10(1 + time_s / (3 * HOUR_S)))


def sag_mm(pressure_pa: float, stiffness: float) -> float:
    """The twin's own answer, by bisection."""
    low, high = 30.0, 45.0
    for _ in range(50):
        middle = (low + high) / 2
        load = solve_stretched_film(middle / RADIUS_MM, PRESTRAIN, POISSON)[0]
        low, high = (
            (middle, high) if load * stiffness / (RADIUS_MM * 1e-3) < pressure_pa else (low, middle)
        )
    return low


def run_of(folder: Path, hours: float) -> SimpleNamespace:
    """A hold at one sag: the pressure falls as the film gives way."""
    time_s = np.linspace(0, hours * HOUR_S, 60)
    load = solve_stretched_film(37.0 / RADIUS_MM, PRESTRAIN, POISSON)[0]
    pressure_pa = load * stiffness_n_per_m(time_s) / (RADIUS_MM * 1e-3)
    pressure_pa += np.random.default_rng(1).normal(0, 0.02, time_s.size)
    shapes = SimpleNamespace(time_s=time_s, sag_um=np.full(60, 37e3), verdict=np.full(60, "ok"))
    level = {"time_s": time_s - 30.0, "mean_gauge_pressure_pa": pressure_pa}
    return SimpleNamespace(
        name="night",
        folder=folder,
        config=Config(),
        origin_utc=datetime(2026, 11, 1, tzinfo=UTC),
        shapes=lambda: shapes,
        level=lambda _window_s, names: level,
    )


def test_tomorrow_is_within_its_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(film_run, "open_run", lambda folder: run_of(folder, 48.0))
    assert film_run.film_run_command([tmp_path], PRESTRAIN, POISSON, None, True, True) == 0
    table = json.loads(capsys.readouterr().out)
    times_s = np.array([48.0, 72.0]) * HOUR_S
    pressure_pa = (
        solve_stretched_film(37.0 / RADIUS_MM, PRESTRAIN, POISSON)[0]
        * stiffness_n_per_m(times_s[:1])[0]
        / 0.5
    )
    now, then = (sag_mm(pressure_pa, float(stiffness)) for stiffness in stiffness_n_per_m(times_s))
    drift = table["tomorrow_um"]
    assert table["creeps"]
    assert drift["value"] == pytest.approx(1e3 * (then - now), abs=3 * drift["sigma"])
    assert 0 < drift["sigma"] < 0.5 * drift["value"]
    assert json.loads((tmp_path / "film" / "creep.json").read_text()) == table
    assert (tmp_path / "film" / "creep.png").stat().st_size > 5_000


def test_figures_without_a_gauge_are_left_out(tmp_path: Path) -> None:
    run = run_of(tmp_path, 48.0)
    level = run.level(60.0, names=())
    level["mean_gauge_pressure_pa"][20:40] = np.nan
    time_s, _, pressure_pa = film_run._read_cycles(run)  # type: ignore[arg-type]
    assert time_s.size == 40
    assert np.isfinite(pressure_pa).all()
    level["mean_gauge_pressure_pa"][:] = np.nan
    with pytest.raises(RejectedError, match="a gauge"):
        film_run._read_cycles(run)  # type: ignore[arg-type]


def test_an_hour_does_not_predict_a_day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film_run, "open_run", lambda folder: run_of(folder, 1.0))
    with pytest.raises(RejectedError, match="do not predict 24 h ahead"):
        film_run.film_run_command([tmp_path], PRESTRAIN, POISSON, None, False, False)
