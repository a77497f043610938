"""Frames rendered by the twin, in memory, with one thing wrong or nothing."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from firmware_iface.roles import Pattern
from membrane_ctrl.config.schema import CameraConfig, OpticsConfig, PatternConfig
from membrane_ctrl.metrology.frames.frame_stack import FrameStack
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.shade import Light, pattern_sequence

FILM = typical_film(37.1, 500.0, seed=1)
GAINS = {"saturated": 2.0, "dark": 0.05, "flicker": 0.8}


def bench(steps: int = 4, bits: int = 8, noise_adu: float = 0.4, shrink: int = 8) -> OpticsConfig:
    """The paper's geometry with larger pixels."""
    camera = CameraConfig(
        width_px=2448 // shrink, height_px=2048 // shrink, pixel_um=3.45 * shrink, bits=bits, noise_adu=noise_adu
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
    renderer = OpticsRenderer(optics, film, light or Light(), seed=seed)
    shown = patterns(optics, shifts_rad)
    readings = np.array([0.0 if motion_um is None else motion_um(0.1 * k) for k in range(len(shown))])
    frames = np.stack([renderer.render(p, float(d)) for p, d in zip(shown, readings, strict=True)])
    return stack_of(frames, shown, None if motion_um is None else readings)


def faulty_set(kind: str, frame: str, steps: int = 4, gamma: float = 1.0) -> FrameStack:
    """A full set in which one frame went wrong."""
    renderer, shown = _renderer(steps, gamma), patterns(bench(steps))
    place = [p.name for p in shown].index(frame)
    content = list(shown)
    if kind == "stale":
        content[place] = shown[place - 1]
    elif kind == "swapped":
        content[place], content[place + 1] = shown[place + 1], shown[place]
    moved = {place: 200.0} if kind == "moved" else {}
    gain = {place: GAINS[kind]} if kind in GAINS else {}
    frames = np.stack([renderer.render(p, moved.get(k, 0.0), gain=gain.get(k, 1.0)) for k, p in enumerate(content)])
    if kind == "repeated":
        frames[place] = frames[place - 1]
    return stack_of(frames, shown)
