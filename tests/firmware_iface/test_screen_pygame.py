"""The display under a real X server: what a screenshot shows is the pattern, byte for byte."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_iface import display_conformance
from firmware_iface.display_patterns import ScreenRaster, compute_pattern_light, make_checkerboard
from firmware_iface.display_response import DisplayResponse
from firmware_iface.drivers.screen_pygame import PygameDisplay
from firmware_iface.optical_roles import DriverClock, Pattern
from firmware_iface.pattern_screen import PatternScreen
from firmware_iface.roles import DeviceRefusedError, LinkError
from firmware_iface.settings import PygameScreenConfig
from tests.support.virtual_display import screenshot, virtual_display

pytestmark = pytest.mark.real_time

WIDTH_PX, HEIGHT_PX = 341, 257  # odd on purpose: a scaler or a padded line would show
RASTER = ScreenRaster(WIDTH_PX, HEIGHT_PX, 0.25, periods=4, period_mm=14.0)
PATTERNS = [
    *(Pattern("sin", axis, k, k * np.pi / 2) for axis in "xy" for k in range(4)),
    *(Pattern("gray", axis, bit) for axis in "xy" for bit in range(1, 5)),
    Pattern("white"),
    Pattern("black"),
]


class Time:
    def __init__(self) -> None:
        self.now_s = 0.0

    def now(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s


@pytest.fixture(scope="module")
def framebuffer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with virtual_display(tmp_path_factory.mktemp("x"), WIDTH_PX, HEIGHT_PX) as file:
        yield file


def made(time: Time, raster: ScreenRaster = RASTER, display: int = 0) -> PatternScreen:
    """The display as the cycle uses it."""
    size = {"width_px": raster.width_px, "height_px": raster.height_px, "pixel_mm": raster.pixel_mm}
    shown = PygameDisplay(PygameScreenConfig(**size, display=display))
    return PatternScreen(
        shown, raster, PATTERNS, DriverClock(time.now, time.sleep), "screen pygame"
    )


class PhotographedDisplay(PygameDisplay):
    """A display whose pixels are read back after every picture."""

    def __init__(
        self, config: PygameScreenConfig, framebuffer: Path, light: Callable[[np.ndarray], None]
    ) -> None:
        super().__init__(config)
        self._framebuffer, self._light = framebuffer, light

    def show(self, picture: Any) -> None:
        super().show(picture)
        self._light(screenshot(self._framebuffer)[:, :, 1])


class Bench(display_conformance.DisplayBench):
    width_px, height_px = WIDTH_PX, HEIGHT_PX

    def __init__(self, framebuffer: Path) -> None:
        super().__init__()
        self._framebuffer = framebuffer

    def make(self, width_px: int, height_px: int) -> PhotographedDisplay:
        config = PygameScreenConfig(width_px=width_px, height_px=height_px, pixel_mm=0.25)
        return PhotographedDisplay(config, self._framebuffer, self.light)


@pytest.mark.parametrize(
    "check", display_conformance.list_checks(Bench), ids=lambda check: check.__name__
)
def test_conformance(check: display_conformance.Check, framebuffer: Path) -> None:
    check(Bench(framebuffer))


@pytest.fixture
def screen(framebuffer: Path) -> Iterator[PatternScreen]:
    shown = made(Time())
    yield shown
    shown.close()


def levels(pattern: Pattern) -> np.ndarray:
    return np.rint(255 * compute_pattern_light(pattern, RASTER).astype(np.float64)).astype(np.uint8)


def test_every_pattern_is_on_the_screen_byte_for_byte(
    screen: PatternScreen, framebuffer: Path
) -> None:
    screen.open()
    for pattern in PATTERNS:
        screen.show(pattern)
        seen = screenshot(framebuffer)
        assert seen.shape == (HEIGHT_PX, WIDTH_PX, 3)
        assert np.array_equal(seen, np.repeat(levels(pattern)[:, :, None], 3, axis=2)), pattern.name


def test_a_checkerboard_is_not_scaled(screen: PatternScreen, framebuffer: Path) -> None:
    screen.show_levels(make_checkerboard(WIDTH_PX, HEIGHT_PX))
    assert np.array_equal(screenshot(framebuffer)[:, :, 1], make_checkerboard(WIDTH_PX, HEIGHT_PX))


def test_light_is_made_linear(screen: PatternScreen, framebuffer: Path) -> None:
    ramp = np.linspace(0, 255, 65)
    screen.open()
    screen.linearise(DisplayResponse(ramp, (ramp / 255) ** 2.2))
    pattern = PATTERNS[1]
    screen.show(pattern)
    light = (screenshot(framebuffer)[:, :, 0] / 255.0) ** 2.2
    assert (
        np.abs(light - compute_pattern_light(pattern, RASTER)).max() < 0.01
    )  # half a level at the steepest is 0.0043
    assert not np.array_equal(screenshot(framebuffer)[:, :, 0], levels(pattern))


def test_show_waits_until_it_is_settled(framebuffer: Path) -> None:
    time = Time()
    screen = made(time)
    screen.settle_s = 0.08
    screen.open()
    screen.show(PATTERNS[0])
    assert time.now_s == pytest.approx(0.08)
    screen.begin(PATTERNS[1])
    time.now_s += 0.05  # something useful meanwhile
    screen.wait()
    assert time.now_s == pytest.approx(0.16)
    time.now_s += 1.0
    screen.wait()
    assert time.now_s == pytest.approx(1.16)
    screen.close()


@pytest.mark.parametrize("size", [(WIDTH_PX - 1, HEIGHT_PX), (WIDTH_PX, HEIGHT_PX + 2), (680, 512)])
def test_another_size_is_refused_in_one_line(framebuffer: Path, size: tuple[int, int]) -> None:
    raster = ScreenRaster(*size, 0.25, periods=4, period_mm=14.0)
    screen = made(Time(), raster)
    with pytest.raises(DeviceRefusedError) as refused:
        screen.open()
    message = str(refused.value)
    assert f"is {WIDTH_PX} x {HEIGHT_PX}" in message
    assert f"states {size[0]} x {size[1]}" in message
    assert "without scaling" in message
    assert "\n" not in message


def test_what_is_missing_is_named(framebuffer: Path, screen: PatternScreen) -> None:
    with pytest.raises(LinkError, match="there are 1 displays"):
        made(Time(), display=3).open()
    with pytest.raises(LinkError, match="'x_sin_9' was not prepared"):
        screen.begin(Pattern("sin", "x", 9))


def test_no_display_names_the_remedy(framebuffer: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":9999")
    with pytest.raises(LinkError, match="DISPLAY"):
        made(Time()).open()


def test_without_pygame_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(LinkError, match=r"membrane-ctrl\[screen\]"):
        made(Time()).open()


def test_it_opens_again_after_it_was_closed(screen: PatternScreen, framebuffer: Path) -> None:
    screen.show(PATTERNS[0])
    screen.close()
    screen.close()
    screen.show(PATTERNS[2])
    assert np.array_equal(screenshot(framebuffer)[:, :, 2], levels(PATTERNS[2]))
