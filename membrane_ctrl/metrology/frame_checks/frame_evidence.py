"""What each frame shows, measured against what the surface predicts it should show.

After the fit the phase of every bin is known without any single frame, so each frame alone gives
its own phase step, brightness, contrast and film position. For a sinusoid with predicted phase psi
= phi + d_k

    I = g [m + b cos(psi + delta) + c2 cos 2 psi + c3 cos 3 psi + c4 cos 4 psi
           - b e (q - <q>) sin psi]

with g the bin's light and q its known change of phase per µm of film motion: linear in m, b cos
delta, b sin delta, b e, c2, c3 and c4. The harmonics are the display's response, the same in all
frames. A Gray frame has two levels, I = g (lo + (hi - lo) bit); white and black have one. Over
thousands of bins noise is negligible; the remaining residual does not belong to the pattern.
"""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

_SAMPLE = 6_000
# For the film's places, whose noise would be taken for motion: as many pixels, whatever the size of
# the bins
_SAMPLED_PX = 96_000
# standard deviation of the phases: fewer fringes cannot be told from a contrast that differs
_SEVERAL_RAD = 6.0
# Distance from a Gray bit's edge, rad: blur, and the film's motion by up to some hundred µm, stay
# inside
_EDGE_RAD = 0.5


@dataclass(frozen=True)
class SampledBins:
    """What is known of the sampled bins: (n,) and (2, n) arrays."""

    index: IntArray  # (n,): bins
    light: FloatArray  # (n,): brightness, see `view`
    phase_rad: FloatArray  # (2, n): predicted absolute phase, film at its mean displacement
    sensitivity_rad_per_um: FloatArray  # (2, n): change of phase per µm of displacement

    def thinned(self, enough: int = _SAMPLE) -> "SampledBins":
        """Enough of the bins."""
        return self.part(slice(None, None, max(1, self.index.size // enough)))

    def part(self, which: slice | BoolArray) -> "SampledBins":
        """Some of the bins."""
        of_axes = self.phase_rad[:, which], self.sensitivity_rad_per_um[:, which]
        return SampledBins(self.index[which], self.light[which], *of_axes)


@dataclass(frozen=True)
class FrameEvidence:
    """One frame; units of light are those of `SampledBins.light`."""

    level: float  # m of a sinusoid, hi of a Gray frame, the level of white and black
    swing: float  # b of a sinusoid, hi - lo of a Gray frame, 0 else
    step_rad: float  # delta of a sinusoid: how far its phase step is from the stated one
    moved_um: float  # e of a sinusoid: how far the film is from where the laser says
    moved_sigma_um: float  # its noise, if what is left over is noise
    rest: float  # RMS of what is left over, as a share of the light
    saturated: float  # share of bins with a saturated pixel
    shows: int  # frame whose pattern this one fits best
    # Share of the bins where a Gray frame is predicted bright: 0 or 1 where the mirror shows no
    # edge of that bit
    lit: float = 1.0


def measure_frames(
    stack: FrameStack, binned: Binned, scene: SampledBins, readable: list[int]
) -> dict[int, FrameEvidence]:
    """Evidence of all readable frames."""
    scene = scene.thinned()
    readings = np.nan_to_num(stack.displacement_um - np.nan_to_num(stack.mean_reading_um))
    templates = [
        _make_template(stack, scene, k, float(reading)) for k, reading in enumerate(readings)
    ]
    waves = [template.wave() for template in templates]
    out = {}
    for k in readable:
        seen = binned.means[k].reshape(-1)[scene.index].astype(float)
        saturated = float(np.mean(binned.saturated[k].reshape(-1)[scene.index]))
        out[k] = _make_evidence(
            seen,
            templates[k],
            scene.light,
            saturated,
            _find_best_pattern(seen, waves, scene.light, k),
        )
    return out


def estimate_light_and_film(
    stack: FrameStack,
    binned: Binned,
    scene: SampledBins,
    used: tuple[list[int], list[int]],
    phase_rad: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:
    """Level and swing (2, frames) of the used sinusoids about the mean of their axis; the film's
    places, 1 sigma, µm.

    Places are those of the used sinusoids of x and then of y. Each frame is compared with the light
    that the other axis saw: in that of its own axis it leaves waves, which would hide a tenth of
    what differs. Phases `phase_rad` (2, bins) that differ smoothly from the surface's (a film that
    moved between the axes, a wrong geometry) and a contrast that differs over the mirror (blur)
    would be taken for both.
    """
    scene, light = scene.thinned(_SAMPLED_PX // binned.bin_px**2), np.ones((2, len(stack.patterns)))
    film_um, sigma_um = np.empty(0), np.empty(0)
    told_um = np.nan_to_num(stack.displacement_um - stack.mean_reading_um)
    spread_rad = scene.phase_rad.std(axis=1)
    u, v = (scene.phase_rad - scene.phase_rad.mean(axis=1)[:, None]) / spread_rad[:, None]
    order = 4 if spread_rad.min() > _SEVERAL_RAD else 1
    smooth = np.stack([u**p * v**q for p in range(order) for q in range(order - p)])
    left = (phase_rad[:, scene.index] - scene.phase_rad) @ np.linalg.pinv(smooth)
    scene = replace(scene, phase_rad=scene.phase_rad + left @ smooth)
    contrast = smooth[1:] - smooth[1:].mean(axis=1, keepdims=True)
    means = binned.means.reshape(len(stack.patterns), -1)[:, scene.index].astype(float)
    for own, others in (used, used[::-1]):
        aside, found = stack.weights(others)[0] @ means[others], []
        for k in own:
            template = _make_template(stack, scene, k, float(told_um[k]))
            columns = np.vstack([template.columns, template.columns[1] * contrast])
            found.append(
                _make_evidence(means[k], replace(template, columns=columns), aside, 0.0, k)
            )
        seen = np.array([[each.level, each.swing] for each in found]).T
        light[:, own] = seen / seen.mean(axis=1, keepdims=True)
        film_um = np.append(film_um, told_um[own] + [each.moved_um for each in found])
        sigma_um = np.append(sigma_um, [each.moved_sigma_um for each in found])
    return light, film_um, float(np.sqrt(np.mean(sigma_um**2)))


@dataclass(frozen=True)
class _Template:
    """Columns (p, n) that a frame is a sum of, in units of the light; `sure` are the bins to
    compare on.
    """

    role: str
    columns: FloatArray
    sure: BoolArray

    def wave(self) -> tuple[BoolArray, FloatArray]:
        """The sure bins, and the pattern there: times a picture of deviation 1 it is their
        correlation.
        """
        wave = self.columns[:2][-1][self.sure]
        return self.sure, (wave - wave.mean()) / (wave.size * max(wave.std(), 1e-6))


def _make_template(
    stack: FrameStack, scene: SampledBins, frame: int, reading_um: float
) -> _Template:
    pattern = stack.patterns[frame]
    ones = np.ones(scene.index.size)
    if pattern.role in ("white", "black"):
        return _Template(pattern.role, ones[None], ones.astype(bool))
    axis = AXES.index(pattern.axis)
    slope = scene.sensitivity_rad_per_um[axis]
    phase = scene.phase_rad[axis] + slope * reading_um
    if pattern.role == "gray":
        shown, from_edge = gray_bit(phase, pattern.index)
        sure = from_edge > _EDGE_RAD
        # where edges are everywhere (a nonsense prediction) all bins are used
        return _Template(
            "gray", np.stack([ones, shown.astype(float)]), sure if sure.any() else ones.astype(bool)
        )
    psi = phase + pattern.shift_rad
    sine = np.sin(psi)
    columns = [
        ones,
        np.cos(psi),
        -sine,
        -(slope - slope.mean()) * sine,
        *(np.cos(k * psi) for k in (2, 3, 4)),
    ]
    return _Template("sin", np.stack(columns), ones.astype(bool))


def _solve_coefficients(
    seen: FloatArray, template: _Template, light: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Coefficients, their noise if the rest is noise, and the RMS of the rest over the light."""
    sure = template.sure
    columns = (template.columns * light)[:, sure]
    normal = columns @ columns.T
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))  # columns of very different size
    inverse = np.linalg.pinv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    solved = inverse @ (columns @ seen[sure])
    rest = float(np.sqrt(np.mean((seen[sure] - solved @ columns) ** 2)))
    return (
        solved,
        rest * np.sqrt(np.maximum(np.diag(inverse), 0.0)),
        rest / float(np.mean(light[sure])),
    )


def _make_evidence(
    seen: FloatArray, template: _Template, light: FloatArray, saturated: float, shows: int
) -> FrameEvidence:
    solved, sigma, rest = _solve_coefficients(seen, template, light)
    if template.role == "sin":
        swing = float(np.hypot(solved[1], solved[2]))
        step = float(np.arctan2(solved[2], solved[1]))
        moved_um, sigma_um = (float(each[3]) / max(swing, 1e-9) for each in (solved, sigma))
        return FrameEvidence(
            float(solved[0]), swing, step, moved_um, sigma_um, rest, saturated, shows
        )
    if template.role == "gray":
        lit = float(np.mean(template.columns[1][template.sure]))
        return FrameEvidence(
            float(solved.sum()), float(solved[1]), 0.0, 0.0, 0.0, rest, saturated, shows, lit
        )
    return FrameEvidence(float(solved[0]), 0.0, 0.0, 0.0, 0.0, rest, saturated, shows)


def _find_best_pattern(
    seen: FloatArray, waves: list[tuple[BoolArray, FloatArray]], light: FloatArray, own: int
) -> int:
    """The pattern that the frame looks like most: largest correlation of the picture over the
    light.

    A flat picture, white or black, correlates with nothing and is taken for its own.
    """
    picture = seen / np.maximum(light, 1e-9)
    flat = max(float(np.mean(picture)), 1e-9)
    best, where = 0.7, own  # less than 0.7 is no likeness: a sinusoid and its square wave have 0.9
    for frame, (sure, wave) in enumerate(waves):
        deviation = float(np.std(picture[sure]))
        likeness = float(picture[sure] @ wave) / deviation if deviation >= 0.02 * flat else 0.0
        if likeness > best + (0.0 if frame == own else 1e-3):
            best, where = likeness, frame
    return where
