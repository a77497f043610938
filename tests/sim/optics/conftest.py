"""Small benches: the paper's geometry on a sensor with an eighth of the pixels a side."""

from __future__ import annotations

import pytest

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film


@pytest.fixture
def small_optics() -> OpticsConfig:
    """306 x 256 pixels, 8 bit, with noise."""
    return OpticsConfig(camera=CameraConfig(width_px=306, height_px=256, pixel_um=27.6))


@pytest.fixture
def clean_optics() -> OpticsConfig:
    """The same with 16 bit and no noise."""
    return OpticsConfig(
        camera=CameraConfig(width_px=306, height_px=256, pixel_um=27.6, bits=16, noise_adu=0.0)
    )


@pytest.fixture
def film() -> FilmShape:
    """A mounted film."""
    return typical_film(37.1, 500.0, seed=1)
