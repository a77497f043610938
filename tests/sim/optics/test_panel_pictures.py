"""The twin's camera sees the pixels of an emulated display as it sees
the pattern that they show.
"""

from __future__ import annotations

import numpy as np
import pytest

from firmware_iface.display_patterns import ScreenRaster, compute_pattern_light, make_checkerboard
from firmware_iface.display_response import make_linear_response
from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.optics import CameraConfig, DisturbancesConfig, OpticsConfig
from membrane_ctrl.config.schema import TwinConfig
from membrane_ctrl.metrology.phase.pattern_sequence import full_sequence
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.optics.camera import OpticsRenderer, TwinOptics
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.shade_panel import PanelPicture

OPTICS = OpticsConfig(
    camera=CameraConfig(width_px=204, height_px=171, pixel_um=41.4, noise_adu=0.0)
)
PATTERN = OPTICS.pattern
RASTER = ScreenRaster(1300, 1100, 0.4, PATTERN.periods, PATTERN.period_mm, centre_px=(640.2, 555.5))
EDGE = {
    "gray": 0.03,
    "sin": 0.01,
    "white": 0.01,
    "black": 0.0,
}  # share of pixels beside an edge of the picture


@pytest.fixture(scope="module")
def renderer() -> OpticsRenderer:
    return OpticsRenderer(OPTICS, typical_film(37.1, 500.0, seed=1))


def picture(pattern: Pattern) -> PanelPicture:
    return PanelPicture(
        make_linear_response().find_levels(compute_pattern_light(pattern, RASTER)), RASTER
    )


def seen(
    renderer: OpticsRenderer, shown: Pattern | PanelPicture, displacement_um: float
) -> FloatArray:
    return renderer.render_picture(shown, displacement_um).astype(np.float64)


@pytest.mark.parametrize("displacement_um", [0.0, 1234.0])
def test_each_pattern_looks_as_its_pixels(renderer: OpticsRenderer, displacement_um: float) -> None:
    for pattern in full_sequence(PATTERN):
        apart = np.abs(
            seen(renderer, pattern, displacement_um)
            - seen(renderer, picture(pattern), displacement_um)
        )
        assert np.mean(apart > 2.0) <= EDGE[pattern.role], pattern.name


def test_a_shifted_picture_is_seen_shifted(renderer: OpticsRenderer) -> None:
    """A driver that shows a picture elsewhere, or mirrored, does not go unnoticed."""
    levels = picture(Pattern("sin", "x", 0)).levels
    right = seen(renderer, PanelPicture(levels, RASTER), 0.0)
    for wrong in (np.roll(levels, 20, axis=1), np.ascontiguousarray(levels[:, ::-1])):
        assert np.abs(seen(renderer, PanelPicture(wrong, RASTER), 0.0) - right).max() > 10.0


def test_the_lens_does_not_resolve_a_checkerboard(renderer: OpticsRenderer) -> None:
    board = PanelPicture(make_checkerboard(RASTER.width_px, RASTER.height_px), RASTER)
    grey = PanelPicture(np.full((RASTER.height_px, RASTER.width_px), 127, np.uint8), RASTER)
    lit = seen(renderer, grey, 0.0) > 60.0
    assert np.mean(lit) > 0.3
    assert np.abs(seen(renderer, board, 0.0) - seen(renderer, grey, 0.0))[lit].max() < 3.0


def test_a_disturbed_bench_disturbs_the_pixels_as_well() -> None:
    disturbed = OpticsRenderer(
        OPTICS,
        typical_film(37.1, 500.0, seed=1),
        disturbances=DisturbancesConfig(ambient_fraction=0.1),
    )
    white = Pattern("white")
    apart = np.abs(seen(disturbed, white, 0.0) - seen(disturbed, picture(white), 0.0))
    assert np.mean(apart > 2.0) <= EDGE["white"]


class Still:
    displacement_um = 0.0
    sag_mm = 37.1

    def now(self) -> float:
        return 1.0


def test_an_emulated_camera_sees_a_dark_screen_before_the_first_picture() -> None:
    twin = TwinOptics(OPTICS, TwinConfig(), Still, Still())
    dark = twin.view()
    twin.screen.show_picture(picture(Pattern("white")).levels, RASTER)
    assert float(np.mean(twin.view())) > float(np.mean(dark)) + 50.0
