"""Errors of single frames, their light and the film's place, and what they do to the figure."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.optics import OpticsConfig
from membrane_ctrl.metrology.phase import phase_steps, screen_scale
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, moves_mm
from membrane_ctrl.model.arrays import FloatArray

LIGHT = 5e-4  # of a frame's level or swing, after the correction or below what it can see


@dataclass(frozen=True)
class FrameEffects:
    """Changes (parameters, frames) of the parameters in mm per unit of one frame's error, x frames
    first.
    """

    level: FloatArray  # its light, relative
    swing: FloatArray  # the amplitude of its fringes and of their harmonics, relative
    film: FloatArray  # the film's place, µm; the figure is that of the mean place
    display: FloatArray  # the same of the fringes' harmonics alone

    @property
    def x_to_y(self) -> FloatArray:
        """(parameters,) per µm of the film's motion from the x to the y frames."""
        x, y = np.split(self.film, 2, axis=1)
        return np.asarray((y.sum(axis=1) - x.sum(axis=1)) / 2)


def frame_effects(
    bench: TrialBench,
    optics: OpticsConfig,
    shifts_rad: Sequence[FloatArray] | FloatArray,
    light: FloatArray | float = 1.0,
    harmonics: FloatArray | None = None,
) -> FrameEffects:
    """Of single frames; `light` (2, n) and `harmonics` (2, 2), second and third of x and y, over
    the amplitude.
    """
    scale, moves = screen_scale.mm_per_rad(optics.pattern), moves_mm(bench)
    light, orders = np.broadcast_to(light, bench.screen_mm.shape), (2, 3)
    effects: tuple[list[FloatArray], ...] = ([], [], [], [])
    for axis, shifts in enumerate(shifts_rad):
        angle = bench.screen_mm[axis] / scale + screen_scale.centre_phase_rad(optics.pattern)
        _, cosine, sine = phase_steps.step_weights(shifts)
        for k, shift in enumerate(shifts):
            # the frame's error over the fringes' amplitude turns the phasor
            turned = -scale * (cosine[k] * np.sin(angle) - sine[k] * np.cos(angle))
            at = angle + shift
            wave, display = np.cos(at), np.zeros_like(at)
            for order, share in zip(
                orders, (0.0, 0.0) if harmonics is None else harmonics[axis], strict=True
            ):
                wave, display = (
                    wave + share * np.cos(order * at),
                    display - order * share * np.sin(order * at),
                )
            errors = (
                light[axis],
                wave,
                -np.sin(at) * moves[axis] / scale,
                display * moves[axis] / scale,
            )
            for effect, error in zip(effects, errors, strict=True):
                off = np.zeros_like(bench.screen_mm)
                off[axis] = turned * error
                effect.append(
                    bench.solve(bench.geometry(), off, linear=True) - bench.surface.parameters
                )
    level, swing, film, display = (np.stack(effect, axis=1) for effect in effects)
    return FrameEffects(level, swing, film - film.mean(axis=1, keepdims=True), display)


def frame_sources(
    bench: TrialBench,
    optics: OpticsConfig,
    shifts_rad: Sequence[FloatArray],
    film_um: float,
    light: float,
) -> Iterator[Source]:
    """What differs from frame to frame: the light, by `light`, and the film, by `film_um`."""
    effects = frame_effects(bench, optics, shifts_rad)
    yield Source(
        "light_relative",
        "light of each frame",
        light,
        light * (effects.level + effects.swing),
        False,
        False,
    )
    says = "motion of the film from frame to frame that no laser has told"
    yield Source("film_um", says, film_um, film_um * effects.film, False, False)
