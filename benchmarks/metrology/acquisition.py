"""The measurement cycle on devices: an emulated GigE Vision camera at full size that sees a 60 Hz
panel in the film.

The camera is a real GenICam acquisition over loopback, the screen a real X display; the panel
between them (refresh,
16.7 ms latency, 12 ms first-order response) is emulated, and its settle time is measured by the
camera as on a bench.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import cv2
import numpy as np

from firmware_iface.display_patterns import ScreenRaster
from firmware_iface.drivers.camera_aravis import AravisCamera
from firmware_iface.drivers.screen_pygame import PygameDisplay
from firmware_iface.guarded_camera import GuardedCamera
from firmware_iface.optical_roles import DriverClock, Pattern, SensorFormat
from firmware_iface.pattern_screen import PatternScreen
from firmware_iface.settings import AravisCameraConfig, PygameScreenConfig
from membrane_ctrl.acquisition.cycle import CycleDone, ShapeCycle
from membrane_ctrl.acquisition.cycle_plan import CyclePlan
from membrane_ctrl.acquisition.display_test import DisplayTest
from membrane_ctrl.acquisition.waiting_clock import WaitingClock
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence, full_sequence
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.processes.frames import FrameRing, FrameWriter
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import typical_film
from tests.support.figures import Figure, at_most
from tests.worlds.gige_camera import GigeCameraEmulator
from tests.worlds.panel import EmulatedPanel, PanelResponse

OPTICS = OpticsConfig()
WIDTH_PX, HEIGHT_PX, PIXEL_MM = 1920, 1080, 0.4
EXPOSURE_MS = 10.0
CYCLES = 8
Shown = Pattern | float  # a pattern, or the mean light of a test image


class LaserAtRest:
    """The film does not move."""

    def at(self, time_s: float) -> float:
        """Zero."""
        return 0.0


class PanelScene:
    """The panel as the camera sees it; rendered beforehand, as a real camera runs no Python."""

    def __init__(self, panel: EmulatedPanel[Shown]) -> None:
        self._panel = panel
        renderer = OpticsRenderer(OPTICS, typical_film(37.1, 500.0, 1), seed=1)
        patterns = full_sequence(OPTICS.pattern)
        self._pictures: dict[Shown, Any] = {
            pattern: renderer.render_picture(pattern, 0.0).copy() for pattern in patterns
        }
        self._white, self._black = (
            self._pictures[Pattern("white")],
            self._pictures[Pattern("black")],
        )

    def expose(self, exposure_ms: float, gain: int) -> Any:
        """One frame."""
        lit = [
            (share, image)
            for share, image in self._panel.lit(exposure_ms / 1000.0)
            if share > 0.5 / 255
        ]
        if len(lit) == 1:
            return self._picture(lit[0][1])
        (newest, image), (_, before), *_ = lit
        return cv2.addWeighted(
            self._picture(image), newest, self._picture(before), 1.0 - newest, 0.0
        )

    def _picture(self, shown: Shown) -> Any:
        if shown not in self._pictures:
            assert isinstance(shown, float)
            self._pictures[shown] = cv2.addWeighted(
                self._white, shown, self._black, 1.0 - shown, 0.0
            )
        return self._pictures[shown]


class ScreenOnPanel:
    """The X display, and the panel that lights up at its next refresh: nothing waits for it."""

    def __init__(self, screen: PatternScreen, panel: EmulatedPanel[Shown]) -> None:
        self.screen, self._panel = screen, panel

    def begin(self, pattern: Pattern) -> None:
        """Send it."""
        self.screen.begin(pattern)
        self._panel.send(pattern)

    def wait(self) -> None:
        """Until it is settled."""
        self.screen.wait()

    def show(self, pattern: Pattern) -> None:
        """Role Screen."""
        self.begin(pattern)
        self.wait()

    def show_levels(self, levels: Any) -> None:
        """A test image."""
        self.screen.show_levels(levels)
        self._panel.send(float(np.mean(levels)) / 255.0)

    def close(self) -> None:
        """Give the display back."""
        self.screen.close()


class Timed:
    """Any object, with the time that its methods took."""

    def __init__(self, inner: Any, spent_s: dict[str, float]) -> None:
        self._inner, self._spent_s = inner, spent_s

    def _run(self, name: str, *arguments: Any, **named: Any) -> Any:
        begin_s = time.perf_counter()
        try:
            return getattr(self._inner, name)(*arguments, **named)
        finally:
            self._spent_s[name] += time.perf_counter() - begin_s


def _timed(inner: Any, spent_s: dict[str, float], *names: str) -> Any:
    methods: dict[str, Callable[..., Any]] = {
        name: (lambda self, *a, _name=name, **k: self._run(_name, *a, **k)) for name in names
    }
    return type("Timed" + type(inner).__name__, (Timed,), methods)(inner, spent_s)


@contextmanager
def x_display() -> Iterator[None]:
    """A display without a monitor."""
    number_end, server_end = os.pipe()
    command = [
        "Xvfb",
        "-displayfd",
        str(server_end),
        "-screen",
        "0",
        f"{WIDTH_PX}x{HEIGHT_PX}x24",
        "-nolisten",
        "tcp",
    ]
    server = subprocess.Popen(command, pass_fds=[server_end], stderr=subprocess.DEVNULL)
    os.close(server_end)
    os.environ.update(DISPLAY=f":{os.read(number_end, 16).decode().strip()}", SDL_VIDEODRIVER="x11")
    try:
        yield
    finally:
        os.close(number_end)
        server.terminate()
        server.wait()


def run() -> list[Figure]:
    """All figures."""
    clock = WaitingClock(RunClock.start())
    panel: EmulatedPanel[Shown] = EmulatedPanel(PanelResponse(), clock.now)
    patterns = full_sequence(OPTICS.pattern)
    raster = ScreenRaster(
        WIDTH_PX, HEIGHT_PX, PIXEL_MM, OPTICS.pattern.periods, OPTICS.pattern.period_mm
    )
    config = AravisCameraConfig(camera="127.0.0.1", exposure_ms=EXPOSURE_MS, packet_bytes=60_000)
    size_px = OPTICS.camera.width_px, OPTICS.camera.height_px
    with ExitStack() as stack:
        stack.enter_context(x_display())
        scene = PanelScene(panel)
        stack.enter_context(GigeCameraEmulator(scene.expose, *size_px))
        waits, sensor = DriverClock(clock.now, clock.sleep), SensorFormat(*size_px)
        driver = AravisCamera(config, sensor, waits)
        camera = GuardedCamera(driver, sensor, clock.now, "camera aravis")
        stack.callback(camera.close)
        display = PygameDisplay(
            PygameScreenConfig(width_px=WIDTH_PX, height_px=HEIGHT_PX, pixel_mm=PIXEL_MM)
        )
        screen = ScreenOnPanel(
            PatternScreen(display, raster, patterns, waits, "screen pygame"), panel
        )
        stack.callback(screen.close)
        camera.open()
        screen.screen.open()
        test = DisplayTest(screen, camera, clock, WIDTH_PX, HEIGHT_PX)
        found = test.measure_settling()
        screen.screen.settle_s = found.settle_s
        ring = FrameRing.for_optics(OPTICS)
        stack.callback(ring.close)
        writer = FrameWriter(ring.address)
        stack.callback(writer.close)
        spent_s: dict[str, float] = defaultdict(float)
        cycle = ShapeCycle(
            _timed(camera, spent_s, "expose", "fetch", "grab"),
            _timed(screen, spent_s, "begin", "wait", "show"),
            _timed(LiveReconstructor(OPTICS), spent_s, "full", "fringes"),
            CyclePlan(patterns, fringe_sequence(OPTICS.pattern), 0.0),
            writer,
            clock,
            LaserAtRest(),
        )
        return _figures(cycle, spent_s, found.settle_s, driver)


def _figures(
    cycle: ShapeCycle, spent_s: dict[str, float], settle_s: float, camera: AravisCamera
) -> list[Figure]:
    _take(cycle)  # compiles
    full_s = []
    for _ in range(3):
        cycle.want_full()
        full_s.append(_take(cycle))
    spent_s.clear()
    fringes_s = [_take(cycle) for _ in range(CYCLES)]
    per_frame = {name: 1e3 * seconds / (8 * CYCLES) for name, seconds in spent_s.items()}
    words = {
        "begin": "flip",
        "wait": "rest of settling",
        "expose": "expose",
        "fetch": "rest of transfer",
    }
    budget = [Figure(f"per frame: {word}", per_frame[name], "ms") for name, word in words.items()]
    total_ms = 1e3 * statistics.median(fringes_s) / 8
    return [
        Figure(
            "settle time of the panel as measured",
            1e3 * settle_s,
            "ms",
            "its model, worst phase",
            _true_settle_ms(),
        ),
        at_most(
            "cycle of 8 frames, 2448 x 2048, median",
            statistics.median(fringes_s),
            "s",
            1.0,
            "the paper",
            4.0,
        ),
        at_most(
            "cycle of 18 frames, median", statistics.median(full_s), "s", 2.2, "the paper", 8.0
        ),
        *budget,
        Figure("per frame: reconstruct", per_frame["fringes"], "ms"),
        Figure("per frame: all", total_ms, "ms"),
        at_most(
            "frames lost and retaken",
            camera.counts.incomplete + camera.counts.missing,
            "of all",
            None,
        ),
    ]


def _true_settle_ms() -> float:
    response = PanelResponse()
    return 1e3 * (
        1 / response.refresh_hz + response.latency_s + response.tau_s * float(np.log(256))
    )


def _take(cycle: ShapeCycle) -> float:
    begin_s = time.perf_counter()
    done = cycle.run_cycle()
    assert isinstance(done, CycleDone), done
    assert done.estimate.verdict == "ok", done.estimate.reason
    return time.perf_counter() - begin_s
