"""The calibrate-display command: properties of a display, and their effect on the fringes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_acquisition_display_test import HEIGHT_PX, WIDTH_PX, Bench

from firmware_iface.display_response import RAMP_LEVELS, make_measured_response
from membrane_ctrl.acquisition.optical_bench import OpticalBench
from membrane_ctrl.calibration.display import (
    display_report,
    format_display_report,
    fringe_error_mm,
    measure_display,
)
from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.metrology.phase.screen_scale import mm_per_rad
from tests.worlds.panel import PanelResponse


class OpenedBench(Bench):
    def open(self) -> None:
        """Nothing to open."""


def power_law(gamma: float) -> np.ndarray:
    return 200.0 * (np.array(RAMP_LEVELS) / 255.0) ** gamma  # counts


def test_a_panel_is_measured_and_its_effect_reported() -> None:
    bench = OpenedBench(PanelResponse(tau_s=0.012), gamma=2.2)
    settling, response = measure_display(
        OpticalBench(bench, bench), bench.clock, WIDTH_PX, HEIGHT_PX
    )
    report = display_report(settling, response, PatternConfig())
    assert report["gamma"] == pytest.approx(2.2, rel=0.03)
    assert report["settle_ms"] == pytest.approx(1e3 * settling.settle_s)
    lines = format_display_report(report)
    assert f"settle_ms = {report['settle_ms']:.0f}" in lines
    assert lines[0].endswith("gamma 2.20")


def test_four_steps_take_the_third_harmonic_for_phase() -> None:
    # light ((1 + cos) / 2)^2 = 3/8 + cos / 2 + cos(2 phi) / 8: of its harmonics four steps are
    # blind to the second
    square = make_measured_response(RAMP_LEVELS, power_law(2.0))
    assert fringe_error_mm(square, PatternConfig(steps=4), corrected=False) < 0.05
    # to three steps it is a phase error of sin(3 phi) / 4
    expected_mm = mm_per_rad(PatternConfig(steps=3)) / 4 / np.sqrt(2)
    assert fringe_error_mm(square, PatternConfig(steps=3), False) == pytest.approx(
        expected_mm, rel=0.05
    )


def test_the_correction_leaves_the_rounding_of_levels() -> None:
    response = make_measured_response(RAMP_LEVELS, power_law(2.2))
    bare, corrected = (
        fringe_error_mm(response, PatternConfig(), linear) for linear in (False, True)
    )
    assert corrected < 0.5 * bare
    assert 1e3 * corrected == pytest.approx(
        20, abs=2
    )  # µm: the rounding to 256 levels, which bins average away


def test_a_configuration_without_a_screen_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "lab.toml").write_text("")
    assert run(["calibrate-display", str(tmp_path / "lab.toml")]) == 2
    assert "devices.camera and devices.screen are both needed" in capsys.readouterr().err
