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

import math
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.frame_checks.phase_drift import PhaseShifts
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

_SAMPLE = 6_000  # bins that are compared
# Pixels that are used to find the film's positions, whose noise would be taken for motion: a fixed
# number, whatever the size of the bins.
_SAMPLED_PX = 96_000
# Standard deviation of the phases, rad: fewer fringes cannot be distinguished from a contrast that
# differs over the mirror.
_SEVERAL_RAD = 6.0
_SMOOTH_ORDER = 4  # powers of the smooth deviations over the mirror with several fringes
_FLAT_ORDER = 1  # with fewer: a constant alone
_COLUMNS_ORDER = 4  # of the polynomials of `SampledBins.smooth_columns`
# Patches across the picture: what a model leaves of a frame is independent from one to the next.
_PATCHES = 12
# Distance from a Gray bit's edge, rad: blur, and the film's motion by up to some hundred µm, stay
# inside.
_EDGE_RAD = 0.5
_HARMONICS = (2, 3, 4)  # of a sinusoid: the display's response
_COSINE, _SINE, _MOTION, _SECOND_HARMONIC = range(1, 5)  # columns of a sinusoid's model
# Least correlation with a pattern, to look like it: a sinusoid and its square wave have 0.9.
_LEAST_LIKENESS = 0.7
_CLEARLY_MORE = 1e-3  # another pattern must be more like a frame than its own by this much
_FLAT_PICTURE = 0.02  # standard deviation over mean of a picture without any pattern
_TINY = 1e-9  # instead of a division by zero


@dataclass(frozen=True)
class SampledBins:
    """What is known of n sampled bins.

    Attributes
    ----------
    index : (n,) int array
        Numbers of the bins.
    light : (n,) array
        Brightness, as in `bin_view.BinView`.
    phase_rad : (2, n) array
        Predicted absolute phases of x and y, with the film at its mean displacement.
    sensitivity_rad_per_um : (2, n) array
        Change of the phases per µm of displacement.
    places_px : (2, n) array
        Columns and rows of the bins' centres in the picture.
    """

    index: IntArray
    light: FloatArray
    phase_rad: FloatArray
    sensitivity_rad_per_um: FloatArray
    places_px: FloatArray

    def thin_to(self, enough: int = _SAMPLE) -> "SampledBins":
        """Return every k-th bin, so that at least `enough` of them stay."""
        return self.select_bins(slice(None, None, max(1, self.index.size // enough)))

    def select_bins(self, which: slice | BoolArray) -> "SampledBins":
        """Return some of the bins."""
        return SampledBins(
            self.index[which],
            self.light[which],
            self.phase_rad[:, which],
            self.sensitivity_rad_per_um[:, which],
            self.places_px[:, which],
        )

    def smooth_columns(self) -> FloatArray:
        """Polynomials (k, n) in the place in the picture, which is about proportional to that on
        the mirror; the constant first.

        Light and contrast of one frame may differ over the mirror by these. The phases are no
        measure of the place: at the rim of a deep bowl they hardly change with it.
        """
        spread_px = np.maximum(self.places_px.std(axis=1), _TINY)
        centred_px = self.places_px - self.places_px.mean(axis=1)[:, None]
        u, v = centred_px / spread_px[:, None]
        orders = range(_COLUMNS_ORDER + 1)
        powers = [(p, q) for p in orders for q in range(_COLUMNS_ORDER + 1 - p)]
        return np.stack([u**p * v**q for p, q in powers])


@dataclass(frozen=True)
class FrameEvidence:
    """What one frame shows; units of light are those of `SampledBins.light`.

    Attributes
    ----------
    level : float
        m of a sinusoid, hi of a Gray frame, the level of white and black.
    swing : float
        b of a sinusoid, hi - lo of a Gray frame, else 0.
    step_rad : float
        delta of a sinusoid: its phase step less the stated one.
    moved_um, moved_sigma_um : float
        e of a sinusoid: the film's displacement less the laser's reading; its noise, if the rest is
        noise.
    rest : float
        RMS of what the model leaves, as a share of the light.
    saturated : float
        Share of bins with a saturated pixel.
    shows : int
        The frame whose pattern this one fits best.
    lit : float
        Share of the bins where a Gray frame is predicted bright: 0 or 1 where the mirror shows no
        edge of that bit.
    """

    level: float
    swing: float
    step_rad: float
    moved_um: float
    moved_sigma_um: float
    rest: float
    saturated: float
    shows: int
    lit: float = 1.0


def measure_frames(
    stack: FrameStack, binned: Binned, scene: SampledBins, readable: list[int]
) -> dict[int, FrameEvidence]:
    """Measure what each readable frame shows.

    Parameters
    ----------
    stack, binned : FrameStack, Binned
        The set, and its frames as means over bins.
    scene : SampledBins
        The mirror's bins, with the phases that the fitted surface predicts.
    readable : list of int
        Frames that hold a picture.

    Returns
    -------
    dict
        The evidence by frame.
    """
    # What each frame should show, with the film where the laser saw it.
    scene = scene.thin_to()
    readings_um = np.nan_to_num(stack.displacement_um - np.nan_to_num(stack.mean_reading_um))
    models = [
        _make_model(stack, scene, k, float(reading_um)) for k, reading_um in enumerate(readings_um)
    ]
    waves = [model.wave() for model in models]
    # What it shows: the pattern that it is most like, and the parameters of its own.
    evidence = {}
    for k in readable:
        seen = binned.means[k].reshape(-1)[scene.index].astype(float)
        saturated = float(np.mean(binned.saturated[k].reshape(-1)[scene.index]))
        shows = _find_best_pattern(seen, waves, scene.light, k)
        solution = _solve_frame(seen, models[k], scene.light)
        evidence[k] = _make_evidence(solution, models[k], scene.light, saturated, shows)
    return evidence


@dataclass(frozen=True)
class LightAndFilm:
    """Light of the used sinusoids, where the film was, and how the picture shifted.

    Attributes
    ----------
    light : (2, frames) array
        Level and swing of the used sinusoids about the mean of their axis; 1 for other frames.
    film_um : (used,) array
        Displacement of the film during the used sinusoids of x, and then of y.
    film_noise_um : float
        Its standard uncertainty, RMS over the frames.
    shifts : two PhaseShifts
        Shifts of the phases of x and of y that the film's motion does not explain.
    """

    light: FloatArray
    film_um: FloatArray
    film_noise_um: float
    shifts: tuple[PhaseShifts, PhaseShifts]


def estimate_light_and_film(
    stack: FrameStack,
    binned: Binned,
    scene: SampledBins,
    used: tuple[list[int], list[int]],
    phase_rad: FloatArray,
) -> LightAndFilm:
    """Estimate the light of each used sinusoid, and where the film was during it.

    Each frame is compared with the light that the other axis saw: in that of its own axis it leaves
    waves, which would hide 10 % of what differs. Phases that differ smoothly from the surface's (a
    film that moved between the axes, a wrong geometry) and a contrast that differs over the mirror
    (blur) would be taken for both light and motion, so the model has them, too.

    Parameters
    ----------
    stack, binned, scene : FrameStack, Binned, SampledBins
        As in `measure_frames`.
    used : two lists of int
        The used sinusoids of x and of y.
    phase_rad : (2, bins) array
        Measured absolute phases.

    Returns
    -------
    LightAndFilm
    """
    scene = scene.thin_to(_SAMPLED_PX // binned.bin_px**2)
    readings_um = np.nan_to_num(stack.displacement_um - stack.mean_reading_um)

    # Polynomials in the place on the mirror, to which the phases are about proportional.
    spread_rad = scene.phase_rad.std(axis=1)
    u, v = (scene.phase_rad - scene.phase_rad.mean(axis=1)[:, None]) / spread_rad[:, None]
    order = _FLAT_ORDER
    if spread_rad.min() > _SEVERAL_RAD:
        order = _SMOOTH_ORDER
    smooth = np.stack([u**p * v**q for p in range(order) for q in range(order - p)])

    # The predicted phases plus a smooth fit of what the measured ones deviate from them.
    deviation_rad = phase_rad[:, scene.index] - scene.phase_rad
    smooth_rad = deviation_rad @ np.linalg.pinv(smooth) @ smooth
    scene = replace(scene, phase_rad=scene.phase_rad + smooth_rad)

    # Each frame by its model, with a contrast that differs over the mirror, and with the light that
    # the other axis saw.
    contrast = smooth[1:]
    if order == _SMOOTH_ORDER:
        contrast = scene.smooth_columns()[1:]
    contrast = contrast - contrast.mean(axis=1, keepdims=True)
    patch = _assign_patches(scene.places_px)
    means = binned.means.reshape(len(stack.patterns), -1)[:, scene.index].astype(float)
    light = np.ones((2, len(stack.patterns)))
    film_um = np.empty(0)
    sigma_um = np.empty(0)
    shifts = []
    for axis, (own, others) in enumerate((used, used[::-1])):
        light_of_others = stack.weights(others)[0] @ means[others]
        sensitivity = scene.sensitivity_rad_per_um[axis]
        found = []
        patches_rad = []
        for k in own:
            # The second harmonic differs over the mirror, too: by blur, or by the angle of view.
            model = _make_model(stack, scene, k, float(readings_um[k]))
            parts = [model.columns, model.columns[1] * contrast]
            parts.append(model.columns[_SECOND_HARMONIC] * contrast)
            model = replace(model, columns=np.vstack(parts))
            solution = _solve_frame(means[k], model, light_of_others)
            found.append(_make_evidence(solution, model, light_of_others, 0.0, k))
            per_unit = np.array([1.0, -sensitivity.mean()])
            influence = per_unit @ solution.inverse[[_SINE, _MOTION]] @ solution.columns
            parts_rad = influence * solution.rest / max(solution.swing, _TINY)
            patches_rad.append(np.bincount(patch, parts_rad, _PATCHES**2))
        places_um = readings_um[own] + [each.moved_um for each in found]
        shift_rad = [each.step_rad - sensitivity.mean() * each.moved_um for each in found]
        film_rad = float(np.sqrt(np.mean(sensitivity**2)) * np.std(places_um))
        frames = np.array(own, float)
        shifts.append(PhaseShifts(frames, np.array(shift_rad), film_rad, np.array(patches_rad)))

        # Light about the mean of the axis, and the film's place: the laser's reading corrected.
        level_and_swing = np.array([[each.level, each.swing] for each in found]).T
        light[:, own] = level_and_swing / level_and_swing.mean(axis=1, keepdims=True)
        film_um = np.append(film_um, places_um)
        sigma_um = np.append(sigma_um, [each.moved_sigma_um for each in found])
    noise_um = float(np.sqrt(np.mean(sigma_um**2)))
    return LightAndFilm(light, film_um, noise_um, (shifts[0], shifts[1]))


@dataclass(frozen=True)
class _FrameModel:
    """What a frame is a sum of: the equations of the module's docstring, as columns.

    Attributes
    ----------
    role : str
        "sin", "gray", "white" or "black".
    columns : (p, n) array
        In units of the light. Of a sinusoid: 1, cos psi, -sin psi, -(q - <q>) sin psi, harmonics.
    sure : (n,) bool array
        Bins to compare on.
    """

    role: str
    columns: FloatArray
    sure: BoolArray

    def wave(self) -> tuple[BoolArray, FloatArray]:
        """The sure bins, and the pattern there, scaled so that its product with a picture of
        standard deviation 1 is their correlation.
        """
        # The second column; white and black have the constant alone.
        shape = self.columns[min(1, len(self.columns) - 1)]
        pattern = shape[self.sure]
        norm = pattern.size * max(pattern.std(), 1e-6)
        return self.sure, (pattern - pattern.mean()) / norm


def _assign_patches(places_px: FloatArray) -> IntArray:
    """Number (n,) of the patch of the picture that each place (2, n) is in."""
    first_px = places_px.min(axis=1, keepdims=True)
    reach_px = np.maximum(np.ptp(places_px, axis=1, keepdims=True), _TINY)
    in_patches = (places_px - first_px) / reach_px * _PATCHES
    column, row = np.clip(in_patches.astype(int), 0, _PATCHES - 1)
    return np.asarray(row * _PATCHES + column)


def _make_model(
    stack: FrameStack, scene: SampledBins, frame: int, reading_um: float
) -> _FrameModel:
    """The model of a frame during which the laser read `reading_um` more than in the mean."""
    pattern = stack.patterns[frame]
    ones = np.ones(scene.index.size)
    every_bin = ones.astype(bool)

    # White and black: one level.
    if pattern.role in ("white", "black"):
        return _FrameModel(pattern.role, ones[None], every_bin)

    # The phase during this frame: the predicted one, moved with the film.
    axis = AXES.index(pattern.axis)
    sensitivity = scene.sensitivity_rad_per_um[axis]
    phase_rad = scene.phase_rad[axis] + sensitivity * reading_um

    # A Gray frame: two levels, away from the edges of its bit.
    if pattern.role == "gray":
        shown, from_edge_rad = gray_bit(phase_rad, pattern.index)
        sure = from_edge_rad > _EDGE_RAD
        if not sure.any():  # edges everywhere: the prediction is nonsense, and all bins are used
            sure = every_bin
        return _FrameModel("gray", np.stack([ones, shown.astype(float)]), sure)

    # A sinusoid: level, fundamental, motion of the film, and harmonics of the display.
    psi_rad = phase_rad + pattern.shift_rad
    sine = np.sin(psi_rad)
    motion = -(sensitivity - sensitivity.mean()) * sine
    harmonics = [np.cos(k * psi_rad) for k in _HARMONICS]
    columns = np.stack([ones, np.cos(psi_rad), -sine, motion, *harmonics])
    return _FrameModel("sin", columns, every_bin)


@dataclass(frozen=True)
class _FrameSolution:
    """The least squares of a frame by its model, on its n sure bins.

    Attributes
    ----------
    coefficients : (p,) array
        Of the model's columns.
    columns : (p, n) array
        Those columns, times the light.
    inverse : (p, p) array
        Inverse of the normal matrix.
    rest : (n,) array
        What the model leaves.
    """

    coefficients: FloatArray
    columns: FloatArray
    inverse: FloatArray
    rest: FloatArray

    @property
    def rest_rms(self) -> float:
        """RMS of what the model leaves, which is the noise of each bin."""
        return float(np.sqrt(np.mean(self.rest**2)))

    @property
    def swing(self) -> float:
        """Swing b of a sinusoid, by b cos delta and b sin delta."""
        return float(np.hypot(self.coefficients[_COSINE], self.coefficients[_SINE]))


def _solve_frame(seen: FloatArray, model: _FrameModel, light: FloatArray) -> _FrameSolution:
    """Fit a frame, whose bins have the light `seen` (n,), by its model."""
    # Normal equations, scaled to a unit diagonal: the columns are of very different size.
    sure = model.sure
    columns = (model.columns * light)[:, sure]
    normal = columns @ columns.T
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    scales = np.outer(scale, scale)
    inverse = np.linalg.pinv(normal / scales) / scales
    solved = inverse @ (columns @ seen[sure])
    return _FrameSolution(solved, columns, inverse, seen[sure] - solved @ columns)


def _make_evidence(
    solution: _FrameSolution, model: _FrameModel, light: FloatArray, saturated: float, shows: int
) -> FrameEvidence:
    """The evidence of one frame by the fit of its model."""
    solved = solution.coefficients
    rest = solution.rest_rms / float(np.mean(light[model.sure]))

    # A sinusoid: b cos delta and b sin delta give swing and step.
    if model.role == "sin":
        swing = max(solution.swing, _TINY)
        variance = max(float(solution.inverse[_MOTION, _MOTION]), 0.0)
        return FrameEvidence(
            level=float(solved[0]),
            swing=solution.swing,
            step_rad=float(np.arctan2(solved[_SINE], solved[_COSINE])),
            moved_um=float(solved[_MOTION]) / swing,
            moved_sigma_um=solution.rest_rms * math.sqrt(variance) / swing,
            rest=rest,
            saturated=saturated,
            shows=shows,
        )

    # A Gray frame: lo and hi - lo.
    if model.role == "gray":
        lit = float(np.mean(model.columns[1][model.sure]))
        level = float(solved.sum())
        swing = float(solved[1])
        return FrameEvidence(level, swing, 0.0, 0.0, 0.0, rest, saturated, shows, lit)
    return FrameEvidence(float(solved[0]), 0.0, 0.0, 0.0, 0.0, rest, saturated, shows)


def _find_best_pattern(
    seen: FloatArray, waves: list[tuple[BoolArray, FloatArray]], light: FloatArray, own: int
) -> int:
    """The frame whose pattern a picture looks like most: the largest correlation over the light.

    A flat picture, white or black, correlates with no pattern; the answer is then its own frame.
    """
    picture = seen / np.maximum(light, _TINY)
    mean = max(float(np.mean(picture)), _TINY)
    best_likeness = _LEAST_LIKENESS
    best = own
    for frame, (sure, wave) in enumerate(waves):
        deviation = float(np.std(picture[sure]))
        if deviation < _FLAT_PICTURE * mean:
            continue
        likeness = float(picture[sure] @ wave) / deviation
        margin = _CLEARLY_MORE
        if frame == own:
            margin = 0.0
        if likeness > best_likeness + margin:
            best_likeness = likeness
            best = frame
    return best
