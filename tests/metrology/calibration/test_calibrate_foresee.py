"""The predicted uncertainty of sets against the claims of rendered sets of a rippled film."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.metrology.calibration.foresight import forecast_figure
from membrane_ctrl.metrology.rays.bench_parameters import prior_sigmas


# docs/how-to/calibration.md: claims of calibrations of the twin's film, sag and figure in µm
@pytest.mark.parametrize(("range_mm", "sag_um", "figure_um"), [(8.0, 4.2, 1.0), (2.0, 8.4, 2.0)])
def test_it_is_what_sets_of_a_mounted_film_claim(
    range_mm: float, sag_um: float, figure_um: float
) -> None:
    sags_mm = (37.0 + range_mm * np.linspace(-0.5, 0.5, 5)).tolist()
    claim = forecast_figure(OpticsConfig(), prior_sigmas(), sags_mm, 80.0, 1.0)
    assert claim.sag_um == pytest.approx(sag_um, rel=0.15)
    assert claim.figure_rms_um == pytest.approx(figure_um, rel=0.15)


def test_a_bench_that_shows_no_fringes_is_reported() -> None:
    optics = OpticsConfig(
        camera=CameraConfig(principal_px=(-9000.0, 1023.5))
    )  # looks past the mirror
    with pytest.raises(ValueError, match="sees no fringes in the mirror"):
        forecast_figure(optics, prior_sigmas(), [36.0, 38.0], 80.0, 1.0)
