"""Camera and screen of the emulated bench in virtual time: rendered pictures of the twin's film.

The screen has the latency and the response of a liquid-crystal panel. The lens begins out of focus,
and each turn of its ring halves the blur.
"""

import math
from typing import Any

import cv2
import numpy as np

from firmware_iface.optical_roles import DriverClock, Frame, Levels, Pattern, Pixels
from firmware_iface.pattern_screen import PatternScreen
from firmware_iface.roles import DeviceIdentity
from membrane_ctrl.acquisition import optical_bench
from membrane_ctrl.commissioning.check import DeviceProbe
from membrane_ctrl.config.schema import Config
from membrane_ctrl.metrology.phase.pattern_sequence import full_sequence
from membrane_ctrl.model.arrays import Singles
from membrane_ctrl.sim.optics.camera import TwinOptics
from membrane_ctrl.sim.plant import Plant

_FRAME_S = 0.033  # 30 frames a second
_LATENCY_S = 1 / 60
_TAU_S = 0.012
_FADED = 1e-3  # share of the former picture that is not rendered
_BLUR_LEAST_PX = 0.1
_FIRST_BLUR_PX = 6.0  # standard deviation, of a lens as it comes from its box


class EmulatedLens:
    """What a hand changes at the lens.

    Attributes
    ----------
    blur_px : float
        Standard deviation of the blur.
    gain : float
        Exposure over the right one.
    full_scale_adu : float
        At which the sensor saturates.
    """

    def __init__(self) -> None:
        self.blur_px = _FIRST_BLUR_PX
        self.gain = 1.0
        self.full_scale_adu = 255.0

    def turn_ring(self) -> None:
        """Turn the focus ring towards the focus."""
        self.blur_px *= 0.5

    def alter_picture(self, pixels: Pixels) -> Pixels:
        """Return a picture as this lens gives it."""
        seen: Singles = pixels.astype(np.float32) * np.float32(self.gain)
        if self.blur_px > _BLUR_LEAST_PX:
            border = cv2.BORDER_REPLICATE
            seen = np.asarray(
                cv2.GaussianBlur(seen, (0, 0), self.blur_px, borderType=border), np.float32
            )
        return _digitise_light(np.minimum(seen, self.full_scale_adu), pixels)


def _digitise_light(light: Singles, like: Pixels) -> Pixels:
    """Round counts to the type of a picture."""
    counts = np.rint(np.maximum(light, 0.0))
    if like.dtype == np.uint8:
        return counts.astype(np.uint8)
    return counts.astype(np.uint16)


class EmulatedOptics:
    """The twin's camera and screen, on a clock that runs only while they are used.

    Parameters
    ----------
    config : Config
        With a screen.
    mirror : Plant
        Whose true shape the camera sees.
    lens : EmulatedLens
        Its focus, which blurs the rendered pictures.
    """

    def __init__(self, config: Config, mirror: Plant, lens: EmulatedLens) -> None:
        self._config = config
        self._lens = lens
        self._now_s = 0.0
        self.optics = TwinOptics(config.optics, config.twin, mirror.truth, self)
        self._display = _EmulatedPanel(self)
        camera: Any = _EmulatedCamera(self.optics, self, self._display, lens)
        screen: Any = self.optics.screen
        section = None if config.devices is None else config.devices.screen
        if section is not None:
            self._display.raster = optical_bench.make_raster(config, section)
            patterns = full_sequence(config.optics.pattern)
            waits = DriverClock(self.now, self.sleep)
            screen = PatternScreen(
                self._display, self._display.raster, patterns, waits, "emulated screen"
            )
        self.bench = optical_bench.OpticalBench(camera, screen)

    def now(self) -> float:
        """The time in s."""
        return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Let time pass; the film stands still."""
        self._now_s += duration_s

    def probe_bench(self) -> DeviceProbe:
        """Test exposure, pattern, settling and response, as `check` does."""
        found = optical_bench.open_bench(self.bench, self._config, self)
        self.bench.screen.show(Pattern("white"))
        median_adu = float(np.median(self.bench.camera.grab().pixels))
        return DeviceProbe(
            "camera",
            "emulated camera and screen",
            "twin",
            f"{median_adu:.0f} counts",
            problem="; ".join(found.problems),
            notes="; ".join(found.measured),
        )


class _EmulatedPanel:
    """A `Display` that shows a picture after a latency, and then gradually."""

    def __init__(self, clock: EmulatedOptics) -> None:
        self._clock = clock
        self.raster: Any = None
        self.before: Levels | None = None
        self.present: Levels | None = None
        self._sent_s = -math.inf

    def open(self) -> DeviceIdentity:
        return DeviceIdentity("emulated panel", "twin", "")

    def prepare(self, levels: Levels) -> Levels:
        return levels.copy()

    def show(self, picture: Levels) -> None:
        self.before, self.present = self.present, picture
        self._sent_s = self._clock.now()

    def close(self) -> None:
        self.before = self.present = None

    def describe(self) -> dict[str, str]:
        return {"port": "emulated panel"}

    @property
    def share_before(self) -> float:
        """Share of the former picture in the light now."""
        if self.before is None:
            return 0.0
        lit_s = self._clock.now() - self._sent_s - _LATENCY_S
        return 1.0 if lit_s <= 0.0 else math.exp(-lit_s / _TAU_S)


class _EmulatedCamera:
    """A `Camera`: renders what the panel shows, through the lens."""

    def __init__(
        self, optics: TwinOptics, clock: EmulatedOptics, panel: _EmulatedPanel, lens: EmulatedLens
    ) -> None:
        self._optics = optics
        self._clock = clock
        self._panel = panel
        self._lens = lens

    def grab(self, out: Pixels | None = None) -> Frame:
        frame = self._expose()
        pixels = self._lens.alter_picture(frame.pixels)
        self._clock.sleep(_FRAME_S)
        if out is not None:
            out[...] = pixels
        return Frame(pixels, frame.time_s)

    def _expose(self) -> Frame:
        panel = self._panel
        if panel.present is None:
            return self._optics.camera.grab()
        share = panel.share_before
        self._optics.screen.show_picture(panel.present, panel.raster)
        frame = self._optics.camera.grab()
        if share <= _FADED or panel.before is None:
            return frame
        self._optics.screen.show_picture(panel.before, panel.raster)
        former = self._optics.camera.grab().pixels.astype(np.float32)
        mixed = share * former + (1.0 - share) * frame.pixels
        return Frame(_digitise_light(mixed.astype(np.float32), frame.pixels), frame.time_s)

    def describe(self) -> dict[str, str]:
        return {"port": "emulated camera"}

    def close(self) -> None:
        self._optics.camera.close()
