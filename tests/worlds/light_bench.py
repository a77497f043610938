"""Frames of a bench whose light has one chosen effect: written for the checks of the light.

Only the places at which the camera's rays meet the screen come from the twin's exact trace. Panel,
ghost, blur and camera are modelled here, pixel by pixel, with none of the twin's shading.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import CameraConfig, OpticsConfig, PatternConfig
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.pattern_levels import pattern_sequence

FloatArray = NDArray[np.float64]
FILM = typical_film(37.1, 500.0, seed=1)
BLACK = Pattern("black")
_BACK = 37.35  # sag of the film that reflects a second time


def quarter_bench(steps: int = 4, bits: int = 8, shrink: int = 4) -> OpticsConfig:
    """The paper's geometry with larger pixels."""
    camera = CameraConfig(
        width_px=2448 // shrink,
        height_px=2048 // shrink,
        pixel_um=3.45 * shrink,
        bits=bits,
        noise_adu=0.4 * 2 ** (bits - 8),
    )
    return OpticsConfig(camera=camera, pattern=PatternConfig(steps=steps))


@dataclass(frozen=True)
class Places:
    """Where the ray of each pixel meets the screen and the film; arrays (H, W)."""

    screen_mm: FloatArray  # (2, H, W)
    film_mm: FloatArray  # (2, H, W)
    lit: NDArray[np.bool_]  # sees the screen in the film


@lru_cache(maxsize=8)
def trace_places(optics: OpticsConfig, film: FilmShape = FILM) -> Places:
    """Trace every pixel."""
    found = OpticsRenderer(optics, film, exact=True).trace_pixels(0.0)
    shape = (optics.camera.height_px, optics.camera.width_px)
    screen_mm = np.nan_to_num(np.stack([found.s_x_mm, found.s_y_mm]).reshape(2, *shape), nan=1e6)
    film_mm = np.nan_to_num(np.stack([found.x_mm, found.y_mm]).reshape(2, *shape), nan=1e6)
    lit = np.hypot(*film_mm) <= film.radius_mm
    return Places(screen_mm, film_mm, lit)


@dataclass(frozen=True)
class LightEffects:
    """What differs from an ideal panel and camera; the defaults are ideal."""

    gamma: float = 1.0  # of the panel
    gamma_slope: float = 0.0  # change of gamma from the panel's middle to its edge, along x
    image_lag_share: float = 0.0  # of the previous pattern's light in each frame
    held_fall_share: float | None = None  # the same where the light falls; None: as where it rises
    first_order: bool = False  # the panel relaxes from its last state, not from the last pattern
    fall_off: float = 0.0  # loss of light from one side of the panel to the other, along x
    fall_off_radial: float = 0.0  # from the middle of the panel to its edge
    ghost_share: float = 0.0  # light that a second film reflects
    ghost_sag_mm: float = _BACK
    ghost_shift_mm: tuple[float, float] = (0.0, 0.0)  # of the second image on the screen
    blur_px: float = 0.0
    white_fraction: float = 0.8
    dark_fraction: float = 0.02
    leak: float = 0.02
    vignetting: float = 0.15
    noise_share: float = 1.0  # of the camera's stated noise
    # from light, 1 at full scale, to counts over full scale
    response: Callable[[FloatArray], FloatArray] = field(default=lambda light: light)
    clip_low: float = 0.0  # of full scale
    clip_high: float = 1.0


def render_set(
    optics: OpticsConfig, effects: LightEffects, seed: int = 1, film: FilmShape = FILM
) -> FrameStack:
    """A full set in the order of its patterns; before the first one the screen was black."""
    patterns = pattern_sequence("full", optics.pattern)
    frames = render_frames(optics, effects, patterns, seed, film)
    return FrameStack(frames, tuple(patterns), np.full(len(patterns), math.nan), {})


def render_frames(
    optics: OpticsConfig,
    effects: LightEffects,
    patterns: list[Pattern],
    seed: int = 1,
    film: FilmShape = FILM,
    before: Pattern | None = BLACK,
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Pictures of patterns shown one after the other; `before` was shown first, for a long time."""
    places = [(trace_places(optics, film), np.zeros(2), 1.0)]
    if effects.ghost_share:
        second = replace(film, sag_mm=effects.ghost_sag_mm)
        shift_mm = np.array(effects.ghost_shift_mm)
        places.append((trace_places(optics, second), shift_mm, effects.ghost_share))
    states: list[FloatArray | None] = [None] * len(places)
    if before is not None:
        states = [_panel_light(place, shift, before, optics, effects) for place, shift, _ in places]
    random = np.random.default_rng(seed)
    frames = []
    for pattern in patterns:
        light = np.zeros((optics.camera.height_px, optics.camera.width_px))
        for k, (place, shift_mm, share) in enumerate(places):
            target = _panel_light(place, shift_mm, pattern, optics, effects)
            state = states[k]
            seen = target
            if state is not None:
                fall = effects.image_lag_share
                if effects.held_fall_share is not None:
                    fall = effects.held_fall_share
                held = np.where(target < state, fall, effects.image_lag_share)
                seen = target + held * (state - target)
            states[k] = seen if effects.first_order else target
            light += share * seen * place.lit
        frames.append(_expose(light, optics, effects, random))
    return np.stack(frames)


def _panel_light(
    places: Places,
    shift_mm: FloatArray,
    pattern: Pattern,
    optics: OpticsConfig,
    effects: LightEffects,
) -> FloatArray:
    """Light (H, W) of what the panel shows, 1 for white at its brightest place."""
    s_mm = places.screen_mm + shift_mm[:, None, None]
    half_mm = optics.pattern.periods * optics.pattern.period_mm / 2
    inside = (np.abs(s_mm) < half_mm).all(axis=0)
    level = _level(s_mm, pattern, optics.pattern, half_mm)
    u, v = np.clip(s_mm / half_mm, -1, 1)
    light = level ** (effects.gamma + effects.gamma_slope * u)
    light = effects.leak + (1 - effects.leak) * light
    bright = 1 - effects.fall_off * (u + 1) / 2 - effects.fall_off_radial * (u**2 + v**2) / 2
    return np.where(inside, bright * light, 0.0)


def _level(s_mm: FloatArray, pattern: Pattern, config: PatternConfig, half_mm: float) -> FloatArray:
    """Level (H, W), 0 to 1, by the format's description of each pattern."""
    if pattern.role in ("white", "black"):
        return np.full(s_mm.shape[1:], float(pattern.role == "white"))
    along_mm = s_mm["xy".index(pattern.axis)] + half_mm
    if pattern.role == "sin":
        phase = 2 * np.pi * along_mm / (pattern.period_mm or config.period_mm) - np.pi
        return np.asarray(0.5 + 0.5 * np.cos(phase + pattern.shift_rad))
    half_periods = np.floor(2 * along_mm / config.period_mm).astype(np.int64)
    code = half_periods ^ (half_periods >> 1)
    return ((code >> (4 - pattern.index)) & 1).astype(float)


def _expose(
    light: FloatArray, optics: OpticsConfig, effects: LightEffects, random: np.random.Generator
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    camera = optics.camera
    row, column = np.indices(light.shape)
    far = np.hypot(column - camera.width_px / 2, row - camera.height_px / 2)
    loss = 1 - effects.vignetting * (far / far.max()) ** 2
    if effects.blur_px:
        light = ndimage.gaussian_filter(light, effects.blur_px)
    seen = effects.dark_fraction + (effects.white_fraction - effects.dark_fraction) * light * loss
    full = 2**camera.bits - 1
    noisy = seen + effects.noise_share * camera.noise_adu / full * random.normal(size=light.shape)
    counts = effects.response(np.maximum(noisy, 0.0))
    counts = np.clip(counts, effects.clip_low, effects.clip_high)
    return np.rint(full * counts).astype(np.uint8 if camera.bits == 8 else np.uint16)
