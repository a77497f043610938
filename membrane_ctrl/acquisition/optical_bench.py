"""Camera and screen of a run: the twin's, or those of the configuration."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface import display, roles, settings
from firmware_iface.drivers import camera_aravis, camera_folder, camera_uvc, screen_pygame
from membrane_ctrl.acquisition.exposures import CycleClock
from membrane_ctrl.config.schema import Config
from membrane_ctrl.metrology.phase import full_sequence

# Before the first cycle: exposure, checkerboard, settle time and response of the display, seen by the camera.


# Longer than any display takes that is fit for this
LONG_S = 0.5
# One frame after the other for this long, three times for each direction: refresh and exposure are not in step
_FOLLOWED_S = 0.35
_TIMES = 3


class DisplayTest:
    """Measures a display through the camera that looks at it, both open.

    Before a still picture it waits `settle_s`, which `settling` lowers.
    """

    def __init__(
        self,
        screen: screen_pygame.PygameScreen,
        camera: roles.Camera,
        clock: CycleClock,
        width_px: int,
        height_px: int,
    ) -> None:
        self._screen, self._camera, self._clock = screen, camera, clock
        self._size = (height_px, width_px)
        self.settle_s = LONG_S

    def exposure(self, full_scale_adu: int, exposure_ms: float) -> str:
        """What is wrong with the camera's exposure; empty when nothing is."""
        white, black = self._still(self._grey(255)), self._still(self._grey(0))
        return display.exposure_problem(white, black, full_scale_adu, exposure_ms)

    def checkerboard(self) -> str:
        """Whether the screen shows pixel for pixel; empty when it does."""
        white, black = self._still(self._grey(255)), self._still(self._grey(0))
        return display.checkerboard_problem(
            self._still(display.checkerboard(self._size[1], self._size[0])), white, black
        )

    def settling(self) -> display.Settling:
        """Time from a command to the light, over steps both ways between black, white and two greys.

        The greys are there because panels are slowest between them. Raises ValueError if the display never settles.
        """
        delays_s: list[float] = []
        left: list[float] = []
        noise = 0.0
        for one, other in ((0, 255), (64, 160)):
            pictures = {level: _thin(self._still(self._grey(level))) for level in (one, other)}
            again = _thin(self._still(self._grey(one)))
            noise = max(noise, display.share_left(again, pictures[other], pictures[one]))
            for before, after in ((one, other), (other, one)) * _TIMES:
                self._still(self._grey(before))
                for delay_s, pixels in list(self._follow(self._grey(after))):  # looked at afterwards
                    delays_s.append(delay_s)
                    left.append(display.share_left(pixels, pictures[before], pictures[after]))
        found = display.settling(delays_s, left, noise)
        self.settle_s = found.settle_s
        return found

    def response(self) -> display.DisplayResponse:
        """Light against level. Raises ValueError if the camera sees no ramp."""
        frames = [self._still(self._grey(level)) for level in display.RAMP_LEVELS]
        swing = frames[-1].astype(np.float64) - frames[0]
        lit = swing > 0.5 * np.quantile(swing, 0.99)
        return display.measured_response(display.RAMP_LEVELS, [float(np.mean(frame[lit])) for frame in frames])

    def _still(self, levels: roles.Levels) -> roles.Pixels:
        self._screen.show_levels(levels)
        self._clock.sleep(self.settle_s)
        return self._camera.grab().pixels

    def _follow(self, levels: roles.Levels) -> Iterator[tuple[float, roles.Pixels]]:
        """roles.Pixels one after the other, each with the time from the command to the start of its exposure."""
        self._screen.show_levels(levels)
        begun_s = self._clock.now()
        while self._clock.now() - begun_s < _FOLLOWED_S:
            frame = self._camera.grab()
            yield frame.time_s - begun_s, _thin(frame.pixels)

    def _grey(self, level: int) -> roles.Levels:
        return np.full(self._size, level, np.uint8)


def _thin(pixels: roles.Pixels) -> roles.Pixels:
    """Every fourth pixel both ways (of a Bayer sensor always the same colour): enough for means over blocks."""
    return pixels[::4, ::4].copy()


def told(name: str, measure: Callable[[], str]) -> str:
    """A finding with its subject; empty for none. A failed measurement is a finding."""
    try:
        problem = measure()
    except ValueError as error:
        problem = str(error)
    return f"{name}: {problem}" if problem else ""


@dataclass(frozen=True, slots=True)
class OpticalBench:
    """A camera and what it looks at."""

    camera: Any
    screen: Any

    def close(self) -> None:
        """Release both. Never raises."""
        self.camera.close()
        self.screen.close()


def configured_bench(config: Config, clock: CycleClock) -> OpticalBench:
    """The drivers that `[devices.camera]` and `[devices.screen]` name, not yet open.

    Raises LinkError if the configuration names none, or patterns that do not fit on the screen.
    """
    devices = config.devices
    if devices is None or devices.camera is None:
        raise roles.LinkError("no camera: name one in [devices.camera], or set shape.enabled = false")
    camera = _camera(config, devices.camera, clock)
    if devices.screen is None:
        return OpticalBench(camera, camera)  # a folder of frames is both
    screen, pattern = devices.screen, config.optics.pattern
    try:
        raster = display.ScreenRaster(
            screen.width_px, screen.height_px, screen.pixel_mm, pattern.periods, pattern.period_mm, screen.centre_px
        )
    except ValueError as error:
        raise roles.LinkError(f"devices.screen: {error}") from None
    shown = screen_pygame.ScreenSettings(raster, full_sequence(pattern), screen.display)
    return OpticalBench(camera, screen_pygame.PygameScreen(shown, now=clock.now, sleep=clock.sleep))


def _camera(config: Config, section: settings.CameraConfig, clock: CycleClock) -> Any:
    size_px = config.optics.camera.width_px, config.optics.camera.height_px
    match section:
        case settings.AravisCameraConfig():
            return camera_aravis.AravisCamera(section, *size_px, clock.now, clock.sleep)
        case settings.UvcCameraConfig():
            return camera_uvc.UvcCamera(section, *size_px, clock.now)
        case settings.FolderCameraConfig():
            return camera_folder.FolderCamera(Path(section.folder).expanduser(), *size_px, clock.now)


@dataclass(frozen=True, slots=True)
class BenchFindings:
    """What opening the bench has shown: who the camera is, what was measured, and what is wrong with which remedy."""

    camera: str
    measured: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()


def open_bench(bench: OpticalBench, config: Config, clock: CycleClock) -> BenchFindings:
    """Connect camera and screen (of `configured_bench`), and let the camera measure the screen.

    What is found wrong does not keep a run from trying: its cycles are judged one by one. Raises LinkError if one of
    them is not there or not usable.
    """
    identity = bench.camera.open()
    who = " ".join(part for part in (identity.kind, identity.serial, identity.detail) if part)
    section = config.devices.screen if config.devices is not None else None
    if section is None:
        return BenchFindings(who)
    screen = bench.screen
    screen.open()
    test = DisplayTest(screen, bench.camera, clock, section.width_px, section.height_px)
    measured: list[str] = []
    problems: list[str] = []
    if section.self_test:
        problems += [_exposure(config, test), told("screen", test.checkerboard)]
    if section.settle_ms is not None:
        screen.settle_s = test.settle_s = section.settle_ms / 1000.0
    else:
        problems.append(told("screen", lambda: _settle(screen, test, measured)))
    if section.linearise:
        problems.append(told("screen", lambda: _linearise(screen, test, measured)))
    return BenchFindings(who, tuple(measured), tuple(filter(None, problems)))


def _exposure(config: Config, test: DisplayTest) -> str:
    camera = config.devices.camera if config.devices is not None else None
    if not isinstance(camera, settings.AravisCameraConfig):  # another's exposure has no unit
        return ""
    return told("camera", lambda: test.exposure((1 << config.optics.camera.bits) - 1, camera.exposure_ms))


def _settle(screen: screen_pygame.PygameScreen, test: DisplayTest, measured: list[str]) -> str:
    found = test.settling()
    screen.settle_s = found.settle_s
    measured.append(
        f"screen settles in {1000 * found.settle_s:.0f} ms "
        f"(latency {1000 * found.latency_s:.0f} ms, time constant {1000 * found.tau_s:.0f} ms)"
    )
    return ""


def _linearise(screen: screen_pygame.PygameScreen, test: DisplayTest, measured: list[str]) -> str:
    curve = test.response()
    screen.linearise(curve)
    measured.append(f"screen response corrected (gamma {curve.gamma:.2f})")
    return ""
