"""The display measured by a camera that sees an emulated panel, in virtual time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from acquisition_fakes import VirtualClock

from firmware_iface.optical_roles import Frame
from membrane_ctrl.acquisition.display_test import DisplayTest
from membrane_ctrl.acquisition.optical_bench import format_finding
from tests.worlds.panel import EmulatedPanel, PanelResponse

EXPOSURE_S, TRANSFER_S = 0.01, 0.005
WIDTH_PX, HEIGHT_PX = 320, 240


class Bench:
    """Camera and panel; the camera sees the screen in a part of its picture."""

    def __init__(
        self, response: PanelResponse, gamma: float = 2.2, white_adu: float = 200.0
    ) -> None:
        self.clock = VirtualClock()
        self.panel: EmulatedPanel[Any] = EmulatedPanel(response, self.clock.now)
        self.gamma, self.white_adu = gamma, white_adu
        self.generator = np.random.default_rng(5)

    def show_levels(self, levels: Any) -> None:
        self.panel.send(float(np.mean((levels / 255.0) ** self.gamma)))

    def grab(self) -> Frame:
        time_s = self.clock.now()
        light = sum(share * image for share, image in self.panel.lit(EXPOSURE_S))
        pixels = np.full((128, 128), 5.0)
        pixels[32:96, 32:96] += self.white_adu * light
        pixels += self.generator.normal(0, 0.5, pixels.shape)
        self.clock.sleep(EXPOSURE_S + TRANSFER_S)
        return Frame(np.clip(np.rint(pixels), 0, 255).astype(np.uint8), time_s)


def display_test(bench: Bench) -> DisplayTest:
    return DisplayTest(bench, bench, bench.clock, WIDTH_PX, HEIGHT_PX)


@pytest.mark.parametrize("tau_s", [0.006, 0.012, 0.02])
def test_settle_time_is_enough_and_not_much_more(tau_s: float) -> None:
    response = PanelResponse(tau_s=tau_s)
    found = display_test(Bench(response)).measure_settling()
    earliest_s = response.latency_s + tau_s * math.log(256)
    worst_s = earliest_s + 1 / response.refresh_hz
    # gamma makes a first-order panel slower upwards and faster downwards
    assert 0.9 * earliest_s < found.settle_s < 1.4 * worst_s


def test_response_is_the_panels() -> None:
    assert display_test(
        Bench(PanelResponse(), gamma=1.9)
    ).measure_response().gamma == pytest.approx(1.9, rel=0.03)


def test_findings_name_what_they_are_about() -> None:
    dark = display_test(Bench(PanelResponse(), white_adu=20.0))
    assert format_finding("camera", lambda: dark.check_exposure(255, 20.0)).startswith(
        "camera: white gives only 2"
    )
    bright = display_test(Bench(PanelResponse(), white_adu=400.0))
    assert "saturated" in format_finding("camera", lambda: bright.check_exposure(255, 20.0))
    right = display_test(Bench(PanelResponse()))
    assert format_finding("camera", lambda: right.check_exposure(255, 20.0)) == ""
    assert format_finding("screen", right.check_checkerboard) == ""
    nothing = display_test(Bench(PanelResponse(), white_adu=0.0))
    assert format_finding("screen", lambda: str(nothing.measure_response())).startswith(
        "screen: the camera sees no ramp"
    )
