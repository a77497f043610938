"""A second image of the screen in the picture: a film in front, a cover glass, a mirror's back.

The second image adds r cos(phi' + step) to fringes of cos(phi + step), and the phase is off by
r sin(phi' - phi): 5 µm of height at 1 %, nearly all of it tilt if the second image is only shifted.
The fringes fit a surface as well as before, and nothing in them shows it. Gray frames do: where a
bit is dark, the second image has bits of another place.

Each axis is searched for the place phi' = c + a (phi - c) + d, with c the middle of the pattern:
what level, contrast and their slow changes over the mirror leave of the Gray frames is compared
with the bits at that place. Light that spreads evenly to both sides of an edge is stray light, not
a second image: it moves no phase.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.metrology.frame_checks.frame_evidence import SampledBins
from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import BoolArray, FloatArray

_BINS = 800
HIDDEN_RAD = 0.4  # from a Gray bit's edge: blur and the size of a bin
_SCALES = (1.0, 0.95, 1.05, 0.9, 1.1, 0.75, 1.25, 0.5, 1.5, -0.5, -0.75, -1.0, -1.3)
_SAME_SCALE = 0.06
_STEP_RAD = 0.4
_EVERY = 7  # of the places show what chance explains
_LEAST_DETERMINED = 0.02
_CELL_RAD = 0.05  # of the table of bits
_SMOOTH = 3  # of the polynomials' powers
# Explained power of the best place over that of the median place (0.455 of a chance's mean): chance
# reaches 15 in 5000 places
_CLEAR = 100.0
_CHANCE_MEDIAN = 0.455
_LEAST_SHARE = 5e-4
_STRAY_SHARE = 0.5  # of a second image's share that its mirror image may have


@dataclass(frozen=True)
class SecondReflection:
    """A second image of the screen, or by how much one may hide."""

    share: float  # of the first image's light; 0 if none was found
    sigma: float  # NaN if the set cannot show it
    scale: tuple[float, float] = (1.0, 1.0)  # of x and y, over the first image
    # of x and y, in the middle of the pattern; NaN: not seen along that axis
    shift_rad: tuple[float, float] = (math.nan, math.nan)
    mm_per_rad: float = math.nan  # of the fringes on the screen

    @property
    def found(self) -> bool:
        """Whether there is one."""
        return self.share > 0


UNKNOWN = SecondReflection(0.0, math.nan)


@dataclass(frozen=True)
class _Place:
    """The best place of a second image along one axis."""

    share: float
    sigma: float
    clear: float  # explained power over that of chance
    scale: float
    shift_rad: float


def find_second_reflection(
    stack: FrameStack,
    binned: Binned,
    scene: SampledBins,
    excluded: Collection[int],
    pattern: PatternConfig,
) -> SecondReflection:
    """Search the Gray frames of a fitted set."""
    centre_rad = screen_scale.centre_phase_rad(pattern)
    scene = scene.thinned(_BINS)
    places = [
        _search_axis(stack, binned, scene, excluded, axis, centre_rad) for axis in range(len(AXES))
    ]
    known = [place for place in places if place is not None]
    if not known:
        return UNKNOWN
    sigma = max(place.sigma for place in known)
    seen = [place for place in known if place.clear > _CLEAR and place.share > _LEAST_SHARE]
    if not seen:
        return SecondReflection(0.0, sigma)
    best = max(seen, key=lambda place: place.clear)
    scales, shifts = [1.0, 1.0], [math.nan, math.nan]
    for axis, place in enumerate(places):
        if place in seen and place is not None:
            scales[axis], shifts[axis] = place.scale, place.shift_rad
    return SecondReflection(
        best.share,
        sigma,
        (scales[0], scales[1]),
        (shifts[0], shifts[1]),
        screen_scale.mm_per_rad(pattern),
    )


def describe_second_reflection(found: SecondReflection) -> str:
    """Why a set is degraded by a second image; empty if it has none."""
    if not found.found:
        return ""
    places = [
        f"{found.mm_per_rad * shift:+.0f} mm along {axis}"
        for axis, shift in zip(AXES, found.shift_rad, strict=True)
        if math.isfinite(shift)
    ]
    return (
        f"a second image of the screen has {found.share:.1%} of the light "
        f"({' and '.join(places)}): a second surface reflects, such as a film or a glass in front"
    )


def _search_axis(
    stack: FrameStack,
    binned: Binned,
    scene: SampledBins,
    excluded: Collection[int],
    axis: int,
    centre_rad: float,
) -> _Place | None:
    """The place that explains the Gray frames of an axis best; None without usable frames."""
    phase = scene.phase_rad[axis]
    smooth = _smooth_columns(scene)
    bits, lefts, bases, sures = [], [], [], []
    for frame in stack.gray(AXES[axis]):
        if frame in excluded:
            continue
        bit = stack.patterns[frame].index
        shown, from_edge = gray_bit(phase, bit)
        sure = (from_edge > HIDDEN_RAD) & ~binned.saturated[frame].reshape(-1)[scene.index]
        if np.count_nonzero(sure) < _BINS // 5:
            continue
        seen = binned.means[frame].reshape(-1)[scene.index].astype(float)
        columns = np.concatenate([smooth, smooth * shown]) * (scene.light * sure)
        columns /= np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-30)
        solve = np.linalg.pinv(columns @ columns.T) @ columns
        bits.append(bit)
        lefts.append(seen * sure - (solve @ (seen * sure)) @ columns)
        bases.append((columns, solve))
        sures.append(sure)
    if not bits:
        return None
    bright = _white_light(stack, binned, scene, excluded)
    return _compare_places(phase - centre_rad, bits, lefts, bases, sures, bright, centre_rad)


def _compare_places(
    phase: FloatArray,
    bits: list[int],
    lefts: list[FloatArray],
    bases: list[tuple[FloatArray, FloatArray]],
    sures: list[BoolArray],
    bright: FloatArray,
    centre_rad: float,
) -> _Place | None:
    """The best of all places of a second image.

    `phase` (n,) is counted from the pattern's middle; of each Gray frame there are its bit, what
    its own pattern leaves (n,), that pattern's columns with their solution, and the bins (n,);
    `bright` (n,) is the light of white over that of black.
    """
    images = _Images(phase, bits, sures, bright, centre_rad)
    found = _score_places(images, _coarse_places(centre_rad), lefts, bases)
    if not found.size:
        return None
    _, _, _, scale, shift = found[np.argmax(found[:, 0])]
    near = [(scale, shift + np.arange(-_STEP_RAD, _STEP_RAD, _CELL_RAD))]
    fine = _score_places(images, near, lefts, bases)
    _, share, power, scale, shift = fine[np.argmax(fine[:, 0])]
    best = images.at(scale, np.array([shift]))
    # what is left without the best image shows how much chance explains
    without = [
        left - share * _free_of_own(one, basis)
        for left, one, basis in zip(lefts, best[:, 0], bases, strict=True)
    ]
    others = _score_places(images, _coarse_places(centre_rad, _EVERY), without, bases)
    chance = float(np.median(np.abs(others[:, 0]))) / _CHANCE_MEDIAN
    sigma = math.sqrt(chance / float(np.median(others[:, 2])))
    mirrored = _score_places(images, [(2 - scale, np.array([-shift]))], lefts, bases)
    stray = bool(mirrored.size) and float(mirrored[0, 1]) > _STRAY_SHARE * float(share)
    clear = 0.0 if stray or share < 0 else float(share**2 * power) / max(chance, 1e-30)
    return _Place(float(share), sigma, clear, float(scale), float(shift))


class _Images:
    """Second images of the Gray frames of an axis, for any place."""

    def __init__(
        self,
        phase: FloatArray,
        bits: list[int],
        sures: list[BoolArray],
        bright: FloatArray,
        centre_rad: float,
    ) -> None:
        self._phase = phase
        self._reach_rad = 3 * (float(np.max(np.abs(phase))) + 1.5 * centre_rad)
        cells = np.arange(-self._reach_rad, self._reach_rad, _CELL_RAD)
        inside = np.abs(cells) < centre_rad + np.pi
        shown = [gray_bit(cells + centre_rad, bit)[0] & inside for bit in bits]
        self._table = np.stack(shown)
        self._bright = bright * np.stack(sures)

    def at(self, scale: float, shifts_rad: FloatArray) -> FloatArray:
        """Light (frames, shifts, n) of images of the same brightness as the first."""
        place = scale * self._phase + shifts_rad[:, None] + self._reach_rad
        cell = np.rint(place / _CELL_RAD).astype(np.int32)
        shown = self._table[:, np.clip(cell, 0, self._table.shape[1] - 1)]
        return np.asarray(shown * self._bright[:, None])


def _white_light(
    stack: FrameStack, binned: Binned, scene: SampledBins, excluded: Collection[int]
) -> FloatArray:
    """Light (n,) of a white screen less that of a black one."""
    white, black = stack.single("white"), stack.single("black")
    if white is None or black is None or {white, black} & set(excluded):
        return 2 * scene.light  # of fringes with full contrast
    more = binned.means[white].astype(float) - binned.means[black]
    return scene.light * float(np.median(more.reshape(-1)[scene.index] / scene.light))


def _coarse_places(centre_rad: float, every: int = 1) -> list[tuple[float, FloatArray]]:
    """Scales with their shifts, without those of the first image itself."""
    shifts = np.arange(-1.5 * centre_rad, 1.5 * centre_rad, every * _STEP_RAD)
    apart = shifts[np.abs(shifts) > HIDDEN_RAD]
    return [(scale, shifts if abs(scale - 1) > _SAME_SCALE else apart) for scale in _SCALES]


def _score_places(
    images: _Images,
    places: list[tuple[float, FloatArray]],
    lefts: list[FloatArray],
    bases: list[tuple[FloatArray, FloatArray]],
) -> FloatArray:
    """Rows (k, 5) of explained power with the share's sign, share, power, scale and shift."""
    scores = [np.zeros((0, 5))]
    for scale, shifts in places:
        image = images.at(scale, shifts)
        whole = np.sum(image**2, axis=(0, 2))
        power, along = whole.copy(), np.zeros(shifts.size)
        for one, left, (columns, solve) in zip(image, lefts, bases, strict=True):
            power -= np.sum((one @ solve.T) * (one @ columns.T), axis=1)
            along += one @ left
        seen = power > _LEAST_DETERMINED * whole + 1e-9
        power, along, shifts = power[seen], along[seen], shifts[seen]
        scales = np.full(shifts.size, scale)
        rows = (along * np.abs(along) / power, along / power, power, scales, shifts)
        scores.append(np.stack(rows, axis=1))
    return np.concatenate(scores)


def _free_of_own(image: FloatArray, basis: tuple[FloatArray, FloatArray]) -> FloatArray:
    """An image (n,) without what the frame's own pattern explains of it."""
    columns, solve = basis
    return image - (solve @ image) @ columns


def _smooth_columns(scene: SampledBins) -> FloatArray:
    """Polynomials (k, n) over the mirror."""
    spread = np.maximum(scene.phase_rad.std(axis=1), 1e-9)
    u, v = (scene.phase_rad - scene.phase_rad.mean(axis=1)[:, None]) / spread[:, None]
    return np.stack([u**p * v**q for p in range(_SMOOTH) for q in range(_SMOOTH - p)])
