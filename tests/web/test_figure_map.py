"""The map of the figure: its numbers are those of its terms, and what is removed is gone."""

from __future__ import annotations

import gzip
import json
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.web.figure_map import REMOVABLE, make_figure_map

RADIUS_MM = 500.0


def figure_of(**terms_um: float) -> ShapeEstimate:
    """A figure with some terms, such as `z6=1.0`; 37 mm of bowl besides."""
    coeffs_um = np.zeros(ZERNIKE_TERMS)
    coeffs_um[3] = 5000.0
    for name, value_um in terms_um.items():
        coeffs_um[int(name[1:]) - 1] += value_um
    covariance = np.diag(np.full(ZERNIKE_TERMS, 0.01**2))
    return ShapeEstimate(
        1.0, "full", coeffs_um, 0.0, covariance, 37e3, 0.01, 0.0, 1.0, 1.0, 100.0, 0.0, "ok"
    )


def shown(figure: ShapeEstimate, reference: ShapeEstimate | None, *removed: str) -> dict[str, Any]:
    made = make_figure_map(figure, reference, removed, Config())
    return dict(json.loads(gzip.decompress(made.data)))


def heights_um(data: dict[str, Any]) -> np.ndarray:
    steps = np.array([np.nan if step is None else step for step in data["steps"]], dtype=float)
    span_um = data["high_um"] - data["low_um"]
    grid = data["low_um"] + span_um * steps / data["steps_most"]
    return grid.reshape(data["size"], data["size"])


def test_a_change_of_astigmatism_has_its_orientation_and_its_size() -> None:
    """Z6 is positive along x and negative along y; orthonormal, so its RMS is its coefficient."""
    data = shown(figure_of(z6=1.0), figure_of())
    assert data["rms_um"] == pytest.approx(1.0, rel=0.02)
    assert data["pv_um"] == pytest.approx(2 * np.sqrt(6), rel=0.03)
    grid = heights_um(data)
    middle = data["size"] // 2
    assert grid[middle, -2] > 2.0, "right"
    assert grid[1, middle] < -2.0, "top"
    assert np.isnan(grid[0, 0]), "outside of the mirror"
    assert data["low_um"] == -data["high_um"], "zero has the middle colour"


def test_the_top_row_is_the_highest_y() -> None:
    grid = heights_um(shown(figure_of(z3=1.0), figure_of()))
    middle = len(grid) // 2
    assert grid[1, middle] > grid[-2, middle]


@pytest.mark.parametrize(
    ("name", "term"), [(name, group[0]) for name, group in REMOVABLE.items() if name != "piston"]
)
def test_a_term_that_is_removed_is_gone_and_others_stay(name: str, term: int) -> None:
    changed = figure_of(**{f"z{term}": 2.0, "z12": 0.5})
    assert shown(changed, figure_of())["rms_um"] > 1.9
    less = shown(changed, figure_of(), "piston", name)
    assert less["rms_um"] == pytest.approx(0.5, rel=0.05)
    assert name in less["title"]


def test_without_a_reference_it_is_the_height() -> None:
    data = shown(figure_of(), None)
    assert data["pv_um"] == pytest.approx(5000.0 * 2 * np.sqrt(3), rel=0.01)
    assert data["title"] == "height above the vertex, µm"


def test_words_for_a_screen_reader_have_the_figures() -> None:
    made = make_figure_map(figure_of(z6=1.0), figure_of(), ("tilt",), None)
    assert made.words.startswith("ok; change without tilt: PV 4.")
    assert "RMS 1" in made.words
    assert json.loads(gzip.decompress(made.data))["radius_mm"] is None
    bars, sigmas = made.terms["series"]
    assert bars["data"][2] == 1.0, "Z6"
    assert set(sigmas["data"]) == {0.01}


def test_the_words_state_focus_and_rms_with_error_bars() -> None:
    """1 µm RMS of spherical aberration over the whole film, 10 nm of noise a term."""
    made = make_figure_map(figure_of(z11=1.0), figure_of(), (), Config())
    assert "Vertex +0.000 ± 0.063 µm of sag; Focus " in made.words
    assert "RMS 0.8" in made.words
    assert "Focus" not in make_figure_map(figure_of(), figure_of(), (), None).words
