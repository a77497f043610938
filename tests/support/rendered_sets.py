"""Frames rendered by the twin, in memory, with one thing wrong or nothing."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import CameraConfig, OpticsConfig, PatternConfig
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.pattern_levels import Light, pattern_sequence

FILM = typical_film(37.1, 500.0, seed=1)
GAINS = {"saturated": 2.0, "dark": 0.05, "flicker": 0.8}


def bench(steps: int = 4, bits: int = 8, noise_adu: float = 0.4, shrink: int = 8) -> OpticsConfig:
    """The paper's geometry with larger pixels."""
    camera = CameraConfig(
        width_px=2448 // shrink,
        height_px=2048 // shrink,
        pixel_um=3.45 * shrink,
        bits=bits,
        noise_adu=noise_adu,
    )
    return OpticsConfig(camera=camera, pattern=PatternConfig(steps=steps))


@cache
def _renderer(steps: int, gamma: float) -> OpticsRenderer:
    return OpticsRenderer(bench(steps), FILM, Light(gamma=gamma), seed=1)


def patterns(optics: OpticsConfig, shifts_rad: tuple[float, ...] = ()) -> list[Pattern]:
    """Of a full set."""
    return pattern_sequence("full", optics.pattern, shifts_rad)


def stack_of(
    frames: NDArray[np.uint8], shown: list[Pattern], readings_um: NDArray[np.float64] | None = None
) -> FrameStack:
    """Frames without readings unless given."""
    none = np.full(len(shown), math.nan)
    return FrameStack(frames, tuple(shown), none if readings_um is None else readings_um, {})


def good_set(
    optics: OpticsConfig,
    film: FilmShape = FILM,
    light: Light | None = None,
    motion_um: Callable[[float], float] | None = None,
    shifts_rad: tuple[float, ...] = (),
    seed: int = 1,
) -> FrameStack:
    """A full set; with `motion_um` of the time the film moves and the laser says so."""
    shown = patterns(optics, shifts_rad)
    readings = tuple(
        0.0 if motion_um is None else float(motion_um(0.1 * k)) for k in range(len(shown))
    )
    frames = _frames(optics, film, light or Light(), shifts_rad, seed, readings).copy()
    return stack_of(frames, shown, None if motion_um is None else np.array(readings))


@lru_cache(maxsize=32)
def _frames(
    optics: OpticsConfig,
    film: FilmShape,
    light: Light,
    shifts_rad: tuple[float, ...],
    seed: int,
    readings_um: tuple[float, ...],
) -> NDArray[np.uint8]:
    renderer = OpticsRenderer(optics, film, light, seed=seed)
    shown = patterns(optics, shifts_rad)
    return np.stack(
        [renderer.render_picture(p, d) for p, d in zip(shown, readings_um, strict=True)]
    )


def faulty_set(kind: str, frame: str, steps: int = 4, gamma: float = 1.0) -> FrameStack:
    """A full set in which one frame went wrong."""
    stack = good_set(bench(steps), light=Light(gamma=gamma))
    renderer, shown, frames = _renderer(steps, gamma), stack.patterns, stack.frames
    place = [p.name for p in shown].index(frame)
    if kind == "repeated":
        frames[place] = frames[place - 1]
    elif kind == "stale":
        frames[place] = renderer.render_picture(shown[place - 1], 0.0)
    elif kind == "swapped":
        frames[[place, place + 1]] = frames[[place + 1, place]]
    elif kind == "moved":
        frames[place] = renderer.render_picture(shown[place], 200.0)
    else:
        frames[place] = renderer.render_picture(shown[place], 0.0, gain=GAINS[kind])
    return stack
