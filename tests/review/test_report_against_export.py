"""The figures of a report against plain sums over the exported columns, with nothing of the review
in them.
"""

from __future__ import annotations

import json
import tomllib
from math import factorial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from membrane_ctrl.cli import run as command
from membrane_ctrl.model.zernike_terms import NOLL_INDICES, ZERNIKE_DEGREE
from tests.support.review_runs import written
from tests.support.undrawn import undrawn_figures
from tests.worlds.nights import Planted

RATE_HZ = 10.0
SETTLED_AFTER_S = 5.0
POINTS = {"A": (0.0, 0.3), "B": (-0.52, -0.3), "C": (0.74, -0.43)}
COVARIANCE_UM2 = 0.02**2  # of every term of these nights


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = written(tmp_path_factory.mktemp("export"), 0.4, [Planted("pressure step", 700.0, 15.0)])
    with undrawn_figures():
        assert command(["report", str(run)]) == 0
    assert command(["export", str(run), "--format", "parquet"]) == 0
    return run


@pytest.fixture(scope="module")
def report(folder: Path) -> dict[str, Any]:
    table = json.loads((folder / "report" / "report.json").read_text())
    assert isinstance(table, dict)
    return table


def columns(folder: Path, name: str) -> dict[str, np.ndarray]:
    table: pa.Table = pyarrow.parquet.read_table(folder / "export" / f"{name}.parquet")
    return {
        field: table.column(field).to_numpy() for field in table.column_names if field != "verdict"
    }


def errors(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Times and values of the settled ticks: by the laser, and of the true centre."""
    ticks = columns(folder, "ticks")
    time_s = ticks["time_s"]
    settled = time_s - time_s[0] >= SETTLED_AFTER_S
    series = {
        "reading": ticks["setpoint_um"] - ticks["displacement_um"],
        "true": ticks["target_um"] - ticks["truth_displacement_um"],
    }
    return {name: (time_s[settled], values[settled]) for name, values in series.items()}


def means(time_s: np.ndarray, values: np.ndarray, window_s: int) -> tuple[np.ndarray, np.ndarray]:
    """Middles and means of the windows with nine tenths of their ticks."""
    number = np.floor(time_s / window_s).astype(int)
    whole = [n for n in np.unique(number) if (number == n).sum() >= 0.9 * window_s * RATE_HZ]
    return (np.array(whole) + 0.5) * window_s, np.array([values[number == n].mean() for n in whole])


@pytest.mark.parametrize("name", ["reading", "true"])
def test_windows(folder: Path, report: dict[str, Any], name: str) -> None:
    for place, window_s in enumerate((1, 4, 60)):
        _, mean_um = means(*errors(folder)[name], window_s)
        reported = report[name]["windows"][place]
        expected = {
            "count": mean_um.size,
            "mean_um": mean_um.mean(),
            "std_um": mean_um.std(),
            "max_um": np.abs(mean_um).max(),
            "p99_7_um": np.quantile(np.abs(mean_um), 0.997),
            "in_band": (np.abs(mean_um) <= report["band_um"]).mean(),
        }
        assert {key: reported[key] for key in expected} == pytest.approx(
            expected, rel=1e-6, abs=1e-9
        )


def test_slope_and_its_interval(folder: Path, report: dict[str, Any]) -> None:
    middle_s, mean_um = means(*errors(folder)["true"], 1)
    hours = middle_s / 3600
    (rate, _), covariance = np.polyfit(hours, mean_um, 1, cov=True)
    reported = report["true"]["drift_um_per_hour"]
    assert reported["per_hour"] == pytest.approx(rate, abs=1e-7)
    # the means of a second are correlated over some seconds, so the interval is wider than that of
    # independent ones
    independent = 2 * 1.96 * np.sqrt(covariance[0, 0])
    assert independent < reported["high"] - reported["low"] < 6 * independent


def zernike(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(terms, points) orthonormal Noll terms, from the formula with factorials; piston sees to the
    vertex.
    """
    orders = [
        (n, m)
        for n in range(ZERNIKE_DEGREE + 1)
        for m in sorted({abs(m) for m in range(-n, n + 1, 2)})
        for _ in range(1 + (m > 0))
    ]
    rho, theta, terms = np.hypot(x, y), np.arctan2(y, x), []
    for j, (n, m) in enumerate(orders, 1):
        radial = np.zeros_like(rho)
        for k in range((n - m) // 2 + 1):
            parts = factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k)
            factor = (-1) ** k * factorial(n - k) / parts
            radial += factor * rho ** (n - 2 * k)
        angular = (
            np.ones_like(rho)
            if m == 0
            else np.sqrt(2) * (np.cos(m * theta) if j % 2 == 0 else np.sin(m * theta))
        )
        terms.append(np.sqrt(n + 1) * radial * angular)
    return np.array(terms)


def area(folder: Path) -> np.ndarray:
    """Terms at random points of the analysis area."""
    mirror = tomllib.loads((folder / "config.toml").read_text())["optics"]["mirror"]
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 20_000))
    inside = np.hypot(x, y) <= mirror["analysis_radius_mm"] / mirror["radius_mm"]
    return zernike(x[inside], y[inside])


def test_figure_at_the_points_over_the_area_and_between_pairs(
    folder: Path, report: dict[str, Any]
) -> None:
    shapes, reported = columns(folder, "shapes"), report["shape"]
    coeffs = np.column_stack([shapes[f"z{j}_um"] for j in NOLL_INDICES])
    assert reported["used"] == len(coeffs)
    for name, (x, y) in POINTS.items():
        height_um = coeffs @ zernike(np.array([x]), np.array([y]))[:, 0]
        assert reported["points_sd_um"][name] == pytest.approx(height_um.std(), rel=1e-6)
    terms = area(folder)
    assert reported["mean_sd_um"] == pytest.approx(
        (coeffs @ terms).std(axis=0, ddof=1).mean(), rel=0.01
    )
    for pair, cycles in zip(reported["pairs"], (15, 150), strict=True):
        change_um = (coeffs[cycles:] - coeffs[:-cycles]) @ terms
        assert (pair["pairs"], pair["lag_s"]) == (
            len(change_um),
            pytest.approx(4 * cycles, abs=0.01),
        )
        assert pair["all_pairs_rms_um"] == pytest.approx(np.sqrt((change_um**2).mean()), rel=0.01)
        first = int(np.argmin(np.abs(shapes["time_s"] - pair["first_s"])))
        assert pair["rms_um"] == pytest.approx(np.sqrt((change_um[first] ** 2).mean()), rel=0.02)
        sigma_um = np.sqrt(2 * COVARIANCE_UM2 * (terms**2).sum(axis=0))
        assert pair["mean_sigma_um"] == pytest.approx(sigma_um.mean(), rel=0.01)


def test_drift_of_a_term(folder: Path, report: dict[str, Any]) -> None:
    shapes = columns(folder, "shapes")
    rate = np.polyfit(shapes["time_s"] / 3600, shapes["z5_um"], 1)[0]
    assert report["shape"]["drift_um_per_hour"]["Z5"]["per_hour"] == pytest.approx(rate, rel=1e-6)
