"""Camera and screen of a run: the twin's, or the configured ones."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from firmware_iface import display_patterns, drivers, optical_roles, roles
from firmware_iface.guarded_camera import GuardedCamera
from firmware_iface.pattern_screen import PatternScreen
from firmware_iface.settings import ExternalCameraConfig, ExternalScreenConfig, ScreenSection
from membrane_ctrl.acquisition.display_test import DisplayTest
from membrane_ctrl.acquisition.exposures import CycleClock
from membrane_ctrl.config.schema import Config
from membrane_ctrl.instruments import driver_loading
from membrane_ctrl.metrology.phase.pattern_sequence import full_sequence
from membrane_ctrl.metrology.tracking.live_tracker import crossed_patterns
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sim.optics.camera import TwinOptics

# Tables of the configuration, for messages.
_CAMERA = "devices.camera"
_SCREEN = "devices.screen"


def format_finding(name: str, measure: Callable[[], str]) -> str:
    """Measure something, and return a finding with its subject; a failed measurement is a finding.

    Parameters
    ----------
    name : str
        The subject.
    measure : callable
        Returns the finding, empty without one.
    """
    try:
        problem = measure()
    except ValueError as error:
        problem = str(error)
    if problem:
        return f"{name}: {problem}"
    return ""


@dataclass(frozen=True, slots=True)
class OpticalBench:
    """A camera and its target; the twin's own camera and screen need not be opened."""

    camera: Any
    screen: Any

    def close(self) -> None:
        """Release both. Never raises."""
        self.camera.close()
        self.screen.close()


def configured_bench(config: Config, clock: CycleClock) -> OpticalBench:
    """Return the drivers named in `[devices.camera]` and `[devices.screen]`, not yet open.

    Parameters
    ----------
    config : Config
    clock : CycleClock
        The drivers wait by it.

    Raises
    ------
    LinkError
        If the configuration names none, or the patterns do not fit on the screen.
    InputError
        For a driver that is not installed, does not load or refuses its settings.
    """
    devices = config.devices
    if devices is None or devices.camera is None:
        raise roles.LinkError(
            "no camera: name one in [devices.camera], or set shape.enabled = false"
        )
    camera = _make_camera(config, devices.camera, clock)
    if devices.screen is None:
        return OpticalBench(camera, camera.driver)  # its pictures are those of the patterns
    return OpticalBench(camera, _make_screen(config, devices.screen, clock))


def emulated_bench(config: Config, clock: CycleClock, optics: TwinOptics) -> OpticalBench:
    """Return the twin's camera and screen.

    Drivers of other packages that have an emulator take their places.

    Parameters
    ----------
    config : Config
    clock : CycleClock
    optics : TwinOptics
        Renders the frames.

    Raises
    ------
    InputError
        For a driver or emulator that does not load or refuses its settings.
    """
    camera: Any = optics.camera
    screen: Any = optics.screen
    devices = config.devices
    if devices is None:
        return OpticalBench(camera, screen)

    # A screen of a package, which draws on the simulated panel.
    if isinstance(devices.screen, ExternalScreenConfig) and drivers.has_emulator(
        devices.screen.name, drivers.SCREENS
    ):
        raster = make_raster(config, devices.screen)
        panel = driver_loading.make_emulator(
            devices.screen,
            _SCREEN,
            drivers.SCREENS,
            lambda levels: optics.screen.show_picture(levels, raster),
        )
        screen = _make_screen(config, devices.screen, clock, panel)

    # A camera of a package, which sees the simulated picture.
    if isinstance(devices.camera, ExternalCameraConfig) and drivers.has_emulator(
        devices.camera.name, drivers.CAMERAS
    ):
        sensor = driver_loading.make_emulator(devices.camera, _CAMERA, drivers.CAMERAS, optics.view)
        camera = _make_camera(config, devices.camera, clock, sensor)
    return OpticalBench(camera, screen)


def exposure_s(config: Config) -> float:
    """Exposure time of a frame; 0 for cameras that do not state it."""
    camera = None
    if config.devices is not None:
        camera = config.devices.camera
    if camera is None:
        return 0.0
    return camera.frame_exposure_s or 0.0


def _make_camera(config: Config, section: Any, clock: CycleClock, *library: Any) -> GuardedCamera:
    """The camera of a table; `library` stands for the library that its driver calls."""
    stated = config.optics.camera
    sensor = optical_roles.SensorFormat(stated.width_px, stated.height_px, stated.bits)
    waits = optical_roles.DriverClock(clock.now, clock.sleep)
    driver = driver_loading.make_driver(section, _CAMERA, drivers.CAMERAS, sensor, waits, *library)
    try:
        return GuardedCamera(driver, sensor, clock.now, f"camera {driver_loading.name_of(section)}")
    except ValueError as error:
        raise InputError(f"{_CAMERA}: {error}") from None


def _make_screen(config: Config, section: Any, clock: CycleClock, *library: Any) -> PatternScreen:
    """The screen of a table, as `_make_camera`."""
    patterns = full_sequence(config.optics.pattern)
    if config.shape.mode == "track":
        patterns += crossed_patterns(config.shape.track_periods)
    shown = driver_loading.make_driver(section, _SCREEN, drivers.SCREENS, *library)
    waits = optical_roles.DriverClock(clock.now, clock.sleep)
    name = f"screen {driver_loading.name_of(section)}"
    return PatternScreen(shown, make_raster(config, section), patterns, waits, name)


def make_raster(config: Config, screen: ScreenSection) -> display_patterns.ScreenRaster:
    """Make the raster of a screen: its pixels, and the region in which the pattern is shown.

    Parameters
    ----------
    config : Config
        For the number of periods and their length in mm.
    screen : ScreenSection
        For the pixels, their pitch in mm, and the pattern's centre.

    Raises
    ------
    LinkError
        The pattern does not fit on the screen.
    """
    pattern = config.optics.pattern
    try:
        return display_patterns.ScreenRaster(
            screen.width_px,
            screen.height_px,
            screen.pixel_mm,
            pattern.periods,
            pattern.period_mm,
            screen.centre_px,
        )
    except ValueError as error:
        raise roles.LinkError(f"devices.screen: {error}") from None


@dataclass(frozen=True, slots=True)
class BenchFindings:
    """Findings from opening the bench: the camera's identity, the measurements, and the problems
    with remedies.
    """

    camera: str
    measured: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()


def open_bench(bench: OpticalBench, config: Config, clock: CycleClock) -> BenchFindings:
    """Connect the camera and screen, and measure the screen with the camera.

    Problems found do not stop a run, as each cycle is judged.

    Parameters
    ----------
    bench : OpticalBench
    config : Config
    clock : CycleClock

    Returns
    -------
    BenchFindings
        Identities, and problems for people.

    Raises
    ------
    LinkError
        If camera or screen is missing or unusable.
    """
    who = ""
    if isinstance(bench.camera, GuardedCamera):
        identity = bench.camera.open()
        who = " ".join(part for part in (identity.kind, identity.serial, identity.detail) if part)

    # Only a screen that shows patterns is tested.
    section = None
    if config.devices is not None:
        section = config.devices.screen
    if section is None or not isinstance(bench.screen, PatternScreen):
        return BenchFindings(who)

    # What the camera sees of it: exposure and checkerboard.
    screen = bench.screen
    screen.open()
    test = DisplayTest(screen, bench.camera, clock, section.width_px, section.height_px)
    measured: list[str] = []
    problems: list[str] = []
    if section.self_test:
        problems += [
            _check_exposure(config, test),
            format_finding("screen", test.check_checkerboard),
        ]

    # Settling time and response: as stated, or measured.
    if section.settle_ms is not None:
        screen.settle_s = test.settle_s = section.settle_ms / 1000.0
    else:
        problems.append(format_finding("screen", lambda: _measure_settling(screen, test, measured)))
    if section.linearise:
        problems.append(format_finding("screen", lambda: _measure_response(screen, test, measured)))
    return BenchFindings(who, tuple(measured), tuple(filter(None, problems)))


def _check_exposure(config: Config, test: DisplayTest) -> str:
    exposure_ms = 1000.0 * exposure_s(config)
    if not exposure_ms:  # the remedy would have no unit
        return ""
    return format_finding(
        "camera", lambda: test.check_exposure((1 << config.optics.camera.bits) - 1, exposure_ms)
    )


def _measure_settling(screen: PatternScreen, test: DisplayTest, measured: list[str]) -> str:
    found = test.measure_settling()
    screen.settle_s = found.settle_s
    measured.append(
        f"screen settles in {1000 * found.settle_s:.0f} ms "
        f"(latency {1000 * found.latency_s:.0f} ms, time constant {1000 * found.tau_s:.0f} ms)"
    )
    return ""


def _measure_response(screen: PatternScreen, test: DisplayTest, measured: list[str]) -> str:
    curve = test.measure_response()
    screen.linearise(curve)
    measured.append(f"screen response corrected (gamma {curve.gamma:.2f})")
    return ""
