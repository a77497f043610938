"""Frames of other benches: several periods, Gray codes of any length, crossed fringes; and the
page's own example.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.metrology.phase import crossed_fringes, gray_code, multi_period
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.screen_face import Face
from tests.support.metrology_truth import TrueFilm, look

PLACE = np.random.default_rng(5).uniform(-210, 190, 4000)


def wrapped(periods: list[float], sigma: float = 0.0, seed: int = 1) -> np.ndarray:
    """Phases of the places, in (-pi, pi]."""
    turns = PLACE / np.array(periods)[:, None]
    return np.angle(np.exp(2j * np.pi * turns)) + np.random.default_rng(seed).normal(
        0, sigma, turns.shape
    )


def page_blocks() -> list[str]:
    """The code of docs/how-to/library.md, block by block."""
    page = Path(__file__).parents[3] / "docs" / "how-to" / "library.md"
    return re.findall("```python\n(.*?)```", page.read_text(), re.S)


@pytest.mark.parametrize(
    "periods", [[420.5, 49.8], [17.0, 19.0, 23.0], [13.3, 40.0, 131.0, 401.0], [61.3, 37.9]]
)
def test_any_periods_give_the_place(periods: list[float]) -> None:
    found = multi_period.places_mm(wrapped(periods), periods, (-210, 190), sigma_rad=0.02)
    np.testing.assert_allclose(found.place_mm, PLACE, atol=1e-9)
    assert found.misfit.max() < 1e-9


def test_noise_gives_no_wrong_order_and_the_misfit_that_it_should() -> None:
    periods = [17.0, 19.0, 23.0]
    found = multi_period.places_mm(wrapped(periods, 0.03), periods, (-210, 190), sigma_rad=0.03)
    is_resolved = np.isfinite(found.place_mm)
    assert is_resolved.mean() > 0.9
    assert np.abs(found.place_mm - PLACE)[is_resolved].max() < 1.0
    assert found.misfit.mean() == pytest.approx(2, rel=0.1)
    expected = 0.03 / (2 * np.pi) / np.sqrt(np.sum(1 / np.square(periods)))
    assert np.std((found.place_mm - PLACE)[is_resolved]) == pytest.approx(expected, rel=0.1)


def test_places_that_two_orders_explain_are_not_given() -> None:
    found = multi_period.places_mm(wrapped([30.0, 60.0]), [30.0, 60.0], (-210, 190), sigma_rad=0.05)
    assert np.isnan(found.place_mm).all()  # repeats every 60 mm
    broken = wrapped([420.5, 49.8])
    broken[0] += 0.39  # half of the shorter period
    given = np.isfinite(multi_period.places_mm(broken, [420.5, 49.8], (-210, 190), 0.02).place_mm)
    assert given.mean() < 0.01  # 26 mm beyond one end looks like the other end, 420 mm away


def test_places_refuse_invalid_phases_and_periods() -> None:
    for periods, span in (
        ([10.0], (0, 1)),
        ([10.0, 20.0, 30.0], (0, 1)),
        ([10.0, 0.0], (0, 1)),
        ([1.0, 2.0], (1, 1)),
    ):
        with pytest.raises(ValueError, match="at least two"):
            multi_period.places_mm(np.zeros((2, 3) if len(periods) > 1 else (1, 3)), periods, span)


@pytest.mark.parametrize("bits", [2, 4, 7])
def test_a_gray_code_of_any_length(bits: int) -> None:
    half = np.arange(2**bits)
    code = half ^ (half >> 1)
    k1, k2 = gray_code.code_orders((code >> np.arange(bits)[::-1, None]) & 1 == 1)
    np.testing.assert_array_equal(k1, half // 2)
    np.testing.assert_array_equal(k2, (half + 1) // 2)


def test_crossed_fringes_of_x_and_y_are_separated() -> None:
    random = np.random.default_rng(2)
    phi_x, phi_y = random.uniform(-np.pi, np.pi, (2, 500))
    steps = 2 * np.pi * np.arange(5) / 5
    frames = [100 + 40 * np.cos(phi_x + d) + 30 * np.cos(phi_y + 2 * d) for d in steps]
    x, y = crossed_fringes.crossed_phasors(frames, steps, 2 * steps)
    np.testing.assert_allclose(x, 40 * np.exp(1j * phi_x), atol=1e-10)
    np.testing.assert_allclose(y, 30 * np.exp(1j * phi_y), atol=1e-10)
    with pytest.raises(ValueError, match="crossed fringes"):
        crossed_fringes.crossed_phasors(frames, steps, steps)


def test_the_blocks_of_the_page_run_alone() -> None:
    names: dict[str, Any] = {}
    for block in page_blocks():
        exec(block, names)
    assert names["known"].mean() > 0.99
    assert names["fit"].converged
    assert names["fit"].surface.sag_mm == pytest.approx(37.1, abs=0.02)
    assert np.median(names["residual_urad"]) < 100


def test_the_example_of_the_page_measures_another_bench() -> None:
    """A camera and a screen side by side before a 1.7 m sphere; fringes of two periods in five
    steps. The first block of the page makes its own frames and is left out.
    """
    _, *code = page_blocks()
    camera, screen = np.array([120.0, 30.0, 1650.0]), np.array([-140.0, 10.0, 1700.0])
    forward = -camera / np.linalg.norm(camera)
    right = np.cross(forward, [0, 1, 0]) / np.linalg.norm(np.cross(forward, [0, 1, 0]))
    rotation = np.stack([right, np.cross(forward, right), forward])
    truth = TrueFilm(0.0, {4: 21.2, 5: 0.2, 8: -0.1})
    s_x, s_y = np.array([-1.0, 0, 0]), np.array([0.0, 1, 0])
    bench = Geometry(
        camera, rotation, 3000.0, (319.5, 239.5), (), screen, s_x, s_y, Face.from_config(None)
    )
    columns, rows = (
        a.ravel().astype(float) for a in np.meshgrid(np.arange(640.0)[::4], np.arange(480.0)[::4])
    )
    seen = look(bench, truth, columns, rows, radius_mm=110.0)
    periods, shifts = [36.0, 25.0], 2 * np.pi * np.arange(5) / 5
    random = np.random.default_rng(3)
    frames = np.array(
        [
            [
                [
                    100 + 80 * np.cos(2 * np.pi * s / p + d) + random.normal(0, 0.5, s.size)
                    for d in shifts
                ]
                for p in periods
            ]
            for s in seen.screen_mm
        ]
    )
    in_camera = rotation @ seen.rays
    column, row = 3000 * in_camera[:2] / in_camera[2] + [[319.5], [239.5]]
    names = {
        "np": np,
        "Geometry": Geometry,
        "frames": frames,
        "shifts_rad": shifts,
        "periods_mm": periods,
        "sigma_rad": 0.05,
        "camera_mm": camera,
        "rotation": rotation,
        "focal_px": 3000.0,
        "principal_px": (319.5, 239.5),
        "screen_mm": screen,
        "s_x": s_x,
        "s_y": s_y,
        "column": column,
        "row": row,
        "radius_mm": 115.0,
        "range_mm": (float(seen.screen_mm.min()) - 5, float(seen.screen_mm.max()) + 5),
    }
    for part in code:
        exec(part, names)
    surface = names["fit"].surface
    x, y = seen.film_mm[:2]
    off = surface.height(x, y) - truth.height(x, y)
    assert names["known"].all()
    assert np.std(off) < 2e-4
    assert names["residual_urad"] < 60
