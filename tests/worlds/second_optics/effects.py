"""What may be wrong with a bench or its frames, one by one and with a size. All are off by default.

Sizes are in the unit of the name; a share is 0..1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Motion = Callable[[float], FloatArray]  # time in s -> six numbers, see `bench.SIX`

ORIENTATIONS = ("", "rotated 180", "mirrored left-right", "mirrored up-down", "axes exchanged")
CONTAINERS = ("plain", "left-aligned", "video range", "byte-swapped", "packed")


@dataclass(frozen=True)
class Ghost:
    """A second reflection of the screen: a share of its light, from elsewhere on the screen.

    `shift_mm` is where it comes from; `scale` is its size over that of the true reflection.
    """

    share: float
    shift_mm: tuple[float, float] = (12.0, 5.0)
    scale: float = 1.0


@dataclass(frozen=True)
class Panel:
    """The screen's light.

    Attributes
    ----------
    gamma : float
        Light is level^gamma.
    gamma_by_angle : float
        Change of gamma from one side of the mirror to the other, with the viewing angle along s_x.
    leak : float
        Light of black over that of white.
    previous_share : float
        Share of the previous picture that a frame still shows.
    between_greys : float
        That share where one sinusoid follows another, over that of the other frames: a liquid
        crystal turns from grey to grey at another rate than from black to white.
    falloff : float
        Share of the light that is lost at the mirror's edge (`EDGE_TILT` of viewing angle) when the
        panel is brightest straight ahead.
    falloff_slope : float
        Share that is lost from the middle to one side, with the sign of the angle along s_x.
    contrast_falloff : float
        Share of the contrast that is lost at the mirror's edge: black becomes brighter.
    """

    gamma: float = 1.0
    gamma_by_angle: float = 0.0
    leak: float = 0.02
    previous_share: float = 0.0
    between_greys: float = 1.0
    falloff: float = 0.0
    falloff_slope: float = 0.0
    contrast_falloff: float = 0.0
    ghost: Ghost | None = None


@dataclass(frozen=True)
class Sensor:
    """Camera electronics.

    Attributes
    ----------
    bits : int
        Depth of the converter; over 8 the frames are 16-bit files.
    exposure : float
        Over that at which white reaches 80 % of full scale.
    response_gamma : float
        Counts are light^(1 / gamma); 1 is linear.
    black_clip : float
        Share of full scale that is subtracted before counts below 0 are cut.
    container : one of `CONTAINERS`
        "left-aligned": 12 bits in the high bits of 16. "video range": 8 bits cut to 16..235.
        "byte-swapped": 16 bits with high and low byte exchanged. "packed": 12-bit pixels in one and
        a half bytes each, read as 16-bit ones.
    read_adu : float
        Noise of a dark pixel; quantisation comes on top.
    full_well : float
        Electrons at full scale: shot noise. 0: none.
    """

    bits: int = 8
    exposure: float = 1.0
    response_gamma: float = 1.0
    black_clip: float = 0.0
    container: str = "plain"
    read_adu: float = 0.4
    full_well: float = 2.0e5


@dataclass(frozen=True)
class Effects:
    """Everything that can be planted.

    Attributes
    ----------
    camera_motion, screen_motion : function or None
        Six numbers by time: shifts in mm, turns in rad, about the own axes (`bench.SIX`).
    film_motion_um : function or None
        Displacement added to the film by time.
    laser : bool
        Whether the frames carry readings.
    laser_scale : float
        Reading over true displacement.
    laser_noise_um : float
    orientation : one of `ORIENTATIONS`
        Of the frames as they are stored.
    screen_exchanged : bool
        The display shows the x patterns along y, and the y patterns along x.
    psf_px : float
        Gaussian blur, of pixels of this resolution.
    flicker : float
        RMS change of the light from frame to frame.
    ambient : float
        Light that grows from 0 to this share of white during a set.
    dust : int
        Spots on the mirror that pass half of the light.
    stale_frame : int or None
        This frame shows the picture of the one before.
    """

    camera_motion: Motion | None = None
    screen_motion: Motion | None = None
    film_motion_um: Callable[[float], float] | None = None
    laser: bool = True
    laser_scale: float = 1.0
    laser_noise_um: float = 1.0
    panel: Panel = Panel()
    sensor: Sensor = Sensor()
    orientation: str = ""
    screen_exchanged: bool = False
    psf_px: float = 0.4
    flicker: float = 0.0
    ambient: float = 0.0
    dust: int = 0
    stale_frame: int | None = None

    def __post_init__(self) -> None:
        if self.orientation not in ORIENTATIONS:
            raise ValueError(f"orientation {self.orientation!r} is not one of {ORIENTATIONS}")
        if self.sensor.container not in CONTAINERS:
            raise ValueError(f"container {self.sensor.container!r} is not one of {CONTAINERS}")


def step_motion(degree: int, size: float, at_s: float) -> Motion:
    """A knock: degree of freedom 0..5 changes by `size` (mm or rad) at a time."""

    def motion(time_s: float) -> FloatArray:
        six = np.zeros(6)
        six[degree] = size if time_s >= at_s else 0.0
        return six

    return motion


def ramp_motion(degree: int, size: float, end_s: float) -> Motion:
    """A creep: degree of freedom 0..5 grows from 0 at time 0 to `size` at `end_s`, and on."""

    def motion(time_s: float) -> FloatArray:
        six = np.zeros(6)
        six[degree] = size * time_s / end_s
        return six

    return motion
