"""The recording's text about a cycle."""

from __future__ import annotations

from dataclasses import replace

from membrane_ctrl.recorder.rerun_streams import _legend
from tests.support.synthetic_run import shape_of


def test_both_error_bars_of_the_sag_are_told_apart() -> None:
    shape = shape_of(1.0, 3)
    assert "± 0.100 µm from noise\n" in _legend(shape, shape, {})  # nothing is stated of the geometry
    assert "± 0.100 µm from noise, ± 21.8 µm from geometry\n" in _legend(
        replace(shape, geometry_sag_sigma_um=21.84), shape, {}
    )
