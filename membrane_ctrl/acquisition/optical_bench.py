"""Camera and screen of a run: the twin's, or those of the configuration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_iface.display.pattern_image import ScreenRaster
from firmware_iface.drivers.camera_aravis import AravisCamera, AravisSettings
from firmware_iface.drivers.camera_folder import FolderCamera
from firmware_iface.drivers.camera_uvc import UvcCamera, UvcSettings
from firmware_iface.drivers.screen_pygame import PygameScreen, ScreenSettings
from firmware_iface.roles import LinkError
from membrane_ctrl import camera_config as table
from membrane_ctrl.acquisition.exposures import CycleClock
from membrane_ctrl.acquisition.self_test import DisplayTest, told
from membrane_ctrl.config import Config
from membrane_ctrl.metrology.patterns import full_sequence


@dataclass(frozen=True, slots=True)
class OpticalBench:
    """A camera and what it looks at."""

    camera: Any
    screen: Any

    def close(self) -> None:
        """Give both back. Never raises."""
        self.camera.close()
        self.screen.close()


def configured_bench(config: Config, clock: CycleClock) -> OpticalBench:
    """The drivers that `[devices.camera]` and `[devices.screen]` name, not yet open.

    Raises
    ------
    LinkError
        If the configuration names none, or patterns that do not fit on the screen.
    """
    devices = config.devices
    if devices is None or devices.camera is None:
        raise LinkError("no camera: name one in [devices.camera], or set shape.enabled = false")
    camera = _camera(config, devices.camera, clock)
    if devices.screen is None:
        return OpticalBench(camera, camera)  # a folder of frames is both
    screen, pattern = devices.screen, config.optics.pattern
    try:
        raster = ScreenRaster(
            screen.width_px, screen.height_px, screen.pixel_mm, pattern.periods, pattern.period_mm, screen.centre_px
        )
    except ValueError as error:
        raise LinkError(f"devices.screen: {error}") from None
    settings = ScreenSettings(raster, full_sequence(pattern), screen.display)
    return OpticalBench(camera, PygameScreen(settings, now=clock.now, sleep=clock.sleep))


def _camera(config: Config, section: table.CameraTable, clock: CycleClock) -> Any:
    width_px, height_px = config.optics.camera.width_px, config.optics.camera.height_px
    match section:
        case table.AravisCamera():
            settings = AravisSettings(
                section.camera,
                width_px,
                height_px,
                section.pixel_format,
                section.exposure_ms,
                section.gain_db,
                section.packet_bytes,
                section.timeout_s,
            )
            return AravisCamera(settings, clock.now, clock.sleep)
        case table.UvcCamera():
            return UvcCamera(
                UvcSettings(section.port, width_px, height_px, section.exposure, section.gain), clock.now
            )
        case table.FolderCamera():
            return FolderCamera(Path(section.folder).expanduser(), width_px, height_px, clock.now)


@dataclass(frozen=True, slots=True)
class Findings:
    """What opening the bench has shown: who the camera is, what was measured, and what is wrong with which remedy."""

    camera: str
    measured: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()


def open_bench(bench: OpticalBench, config: Config, clock: CycleClock) -> Findings:
    """Connect camera and screen, and let the camera measure the screen.

    What is found wrong does not keep a run from trying: its cycles are judged one by one.

    Parameters
    ----------
    bench : OpticalBench
        From `configured_bench`.
    config : Config
    clock : CycleClock
        The run's clock.

    Raises
    ------
    LinkError
        If one of them is not there or not usable.
    """
    identity = bench.camera.open()
    who = " ".join(part for part in (identity.kind, identity.serial, identity.detail) if part)
    section = config.devices.screen if config.devices is not None else None
    if section is None:
        return Findings(who)
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
    return Findings(who, tuple(measured), tuple(filter(None, problems)))


def _exposure(config: Config, test: DisplayTest) -> str:
    camera = config.devices.camera if config.devices is not None else None
    if not isinstance(camera, table.AravisCamera):  # another's exposure has no unit
        return ""
    return told("camera", lambda: test.exposure((1 << config.optics.camera.bits) - 1, camera.exposure_ms))


def _settle(screen: PygameScreen, test: DisplayTest, measured: list[str]) -> str:
    found = test.settling()
    screen.settle_s = found.settle_s
    measured.append(
        f"screen settles in {1000 * found.settle_s:.0f} ms "
        f"(latency {1000 * found.latency_s:.0f} ms, time constant {1000 * found.tau_s:.0f} ms)"
    )
    return ""


def _linearise(screen: PygameScreen, test: DisplayTest, measured: list[str]) -> str:
    response = test.response()
    screen.linearise(response)
    measured.append(f"screen's response corrected (gamma {response.gamma:.2f})")
    return ""
