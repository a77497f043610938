"""Errors of single frames, their light and the film's place, and what they do to the figure."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.optics import OpticsConfig
from membrane_ctrl.metrology.phase import phase_steps, screen_scale
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, moves_mm
from membrane_ctrl.model.arrays import FloatArray

LIGHT = 5e-4  # error of a frame's level or swing: after the correction, or too small to be seen
_HARMONICS = (2, 3)


@dataclass(frozen=True)
class FrameEffects:
    """Changes of the parameters, mm, per unit of one frame's error; x frames first.

    Attributes
    ----------
    level : (parameters, frames) array
        Per relative change of the light.
    swing : (parameters, frames) array
        Per relative change of the amplitude of the fringes and of their harmonics.
    film : (parameters, frames) array
        Per µm of the film's place; the figure is that of the mean place.
    display : (parameters, frames) array
        The same, by the fringes' harmonics alone.
    """

    level: FloatArray
    swing: FloatArray
    film: FloatArray
    display: FloatArray

    @property
    def x_to_y(self) -> FloatArray:
        """Effect (parameters,), mm per µm of the film's motion from the x to the y frames."""
        x, y = np.split(self.film, 2, axis=1)
        return np.asarray((y.sum(axis=1) - x.sum(axis=1)) / 2)


def frame_effects(
    bench: TrialBench,
    optics: OpticsConfig,
    shifts_rad: Sequence[FloatArray] | FloatArray,
    light: FloatArray | float = 1.0,
    harmonics: FloatArray | None = None,
) -> FrameEffects:
    """Compute the effects of errors of single frames.

    Parameters
    ----------
    bench : TrialBench
        n points of the set.
    optics : OpticsConfig
        The bench.
    shifts_rad : two (N,) arrays
        Phase steps of x and of y.
    light : (2, n) array or float
        Light over the amplitude of the fringes.
    harmonics : (2, 2) array, optional
        Second and third harmonic of x and of y over the amplitude; none by default.

    Returns
    -------
    FrameEffects
    """
    scale = screen_scale.mm_per_rad(optics.pattern)
    centre_rad = screen_scale.centre_phase_rad(optics.pattern)
    moves = moves_mm(bench)
    light = np.broadcast_to(light, bench.screen_mm.shape)
    if harmonics is None:
        harmonics = np.zeros((2, len(_HARMONICS)))
    effects: tuple[list[FloatArray], ...] = ([], [], [], [])
    for axis, shifts in enumerate(shifts_rad):
        angle = bench.screen_mm[axis] / scale + centre_rad
        _, cosine, sine = phase_steps.step_weights(shifts)
        for k, shift in enumerate(shifts):
            # An error e of the frame, over the amplitude, turns the phasor: the screen points are
            # off by `turned` e.
            turned = -scale * (cosine[k] * np.sin(angle) - sine[k] * np.cos(angle))

            # Light of the frame, cos psi and its harmonics, and the slope of the harmonics.
            psi = angle + shift
            wave = np.cos(psi)
            harmonics_slope = np.zeros_like(psi)
            for order, share in zip(_HARMONICS, harmonics[axis], strict=True):
                wave = wave + share * np.cos(order * psi)
                harmonics_slope = harmonics_slope - order * share * np.sin(order * psi)

            # Errors of level, swing, film, and film by the harmonics alone.
            errors = (
                light[axis],
                wave,
                -np.sin(psi) * moves[axis] / scale,
                harmonics_slope * moves[axis] / scale,
            )
            for effect, error in zip(effects, errors, strict=True):
                off_mm = np.zeros_like(bench.screen_mm)
                off_mm[axis] = turned * error
                solved = bench.solve(bench.geometry(), off_mm, linear=True)
                effect.append(solved - bench.surface.parameters)
    level, swing, film, display = (np.stack(effect, axis=1) for effect in effects)
    return FrameEffects(level, swing, film - film.mean(axis=1, keepdims=True), display)


def frame_sources(
    bench: TrialBench,
    optics: OpticsConfig,
    shifts_rad: Sequence[FloatArray],
    film_um: float,
    light: float,
) -> Iterator[Source]:
    """Rows of the budget for what differs from frame to frame.

    Parameters
    ----------
    bench, optics, shifts_rad
        As those of `frame_effects`.
    film_um : float
        1 sigma of the film's place at a frame.
    light : float
        1 sigma of the relative light of a frame.
    """
    effects = frame_effects(bench, optics, shifts_rad)
    yield Source(
        "light_relative",
        "light of each frame",
        light,
        light * (effects.level + effects.swing),
        False,
        False,
    )
    description = "motion of the film from frame to frame that no laser has measured"
    yield Source("film_um", description, film_um, film_um * effects.film, False, False)
