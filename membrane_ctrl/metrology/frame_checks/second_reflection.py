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
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.metrology.frame_checks.sampled_bins import SampledBins
from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import BoolArray, FloatArray

_BINS = 800  # number of bins that are compared
_LEAST_SURE = 0.2  # share of these bins in which a Gray frame must show its bit
# Phase from the edge of a Gray bit within which the size of a bin hides a second image.
HIDDEN_RAD = 0.4
# Sigmas of the blur from such an edge within which it hides one: 0.02 % of the light is beyond.
_BLUR_SIGMAS = 3.5

# The places that are searched: scales a, and shifts d in steps.
_SCALES = (1.0, 0.95, 1.05, 0.9, 1.1, 0.75, 1.25, 0.5, 1.5, -0.5, -0.75, -1.0, -1.3)
_SAME_SCALE = 0.06  # scales as near to 1 as this may show the first image itself
_STEP_RAD = 0.4  # of the shifts
_SHIFT_RANGE = 1.5  # largest shift, over half the pattern's phase
_EVERY = 7  # steps between the places that show what chance explains
_CELL_RAD = 0.05  # cells of the table of bits, and steps of the finer search

# Least power of a second image that a frame's own pattern does not explain, over its whole power.
_LEAST_DETERMINED = 0.02
# Explained power of the best place over the mean of what chance explains, whose median is 0.455 of
# its mean (chi square with one degree of freedom): chance reaches 15 in 5000 places.
_CLEAR = 100.0
_CHANCE_MEDIAN = 0.455
_LEAST_SHARE = 5e-4  # of the light, to count as a second image
_STRAY_SHARE = 0.5  # of a second image's share that its mirror image may have
_TINY = 1e-30  # instead of a division by zero
_DEPENDENT = 1e-15  # eigenvalue over the largest of rows that depend on others: as of `pinv`


@dataclass(frozen=True)
class SecondReflection:
    """A second image of the screen, or by how much one may hide.

    Attributes
    ----------
    share : float
        Of the first image's light; 0 if none was found.
    sigma : float
        Standard uncertainty of the share; NaN if the set cannot show it.
    scale : (float, float)
        Of x and y, over the first image.
    shift_rad : (float, float)
        Of x and y, in the middle of the pattern; NaN: not seen along that axis.
    mm_per_rad : float
        Of the fringes on the screen.
    """

    share: float
    sigma: float
    scale: tuple[float, float] = (1.0, 1.0)
    shift_rad: tuple[float, float] = (math.nan, math.nan)
    mm_per_rad: float = math.nan

    @classmethod
    def unknown(cls) -> "SecondReflection":
        """No second image found, and none excluded."""
        return cls(0.0, math.nan)

    @property
    def is_found(self) -> bool:
        """Whether there is one."""
        return self.share > 0


@dataclass(frozen=True)
class _Place:
    """The best place of a second image along one axis."""

    share: float
    sigma: float
    clear: float  # explained power over that of chance
    scale: float
    shift_rad: float


@dataclass(frozen=True)
class _GrayFrame:
    """One Gray frame in n bins, and what its own pattern leaves of it.

    Attributes
    ----------
    bit : int
        Number of its bit.
    sure : (n,) bool array
        Bins to compare on.
    own : (p, n) array
        Orthonormal rows that span the frame's own pattern.
    left : (n,) array
        What they leave of the picture.
    """

    bit: int
    sure: BoolArray
    own: FloatArray
    left: FloatArray

    def free_of_own(self, image: FloatArray) -> FloatArray:
        """An image (n,) without what the frame's own pattern explains of it."""
        return image - (self.own @ image) @ self.own


def find_second_reflection(
    stack: FrameStack,
    binned: Binned,
    scene: SampledBins,
    excluded: Collection[int],
    pattern: PatternConfig,
    blur_rad: FloatArray,
) -> SecondReflection:
    """Search the Gray frames of a fitted set for a second image.

    Derivation: section 11 of docs/explanation/metrology.md.

    Parameters
    ----------
    stack, binned, scene
        As in `frame_evidence.measure_frames`.
    excluded : collection of int
        Frames that do not belong to the set.
    pattern : PatternConfig
        The pattern on the screen.
    blur_rad : (2, n) array
        Sigma of the picture's blur in the bins, in phases of x and y; NaN counts as 0.

    Returns
    -------
    SecondReflection
        `SecondReflection.unknown()` without usable Gray frames.
    """
    # The best place along each axis, by itself.
    centre_rad = screen_scale.centre_phase_rad(pattern)
    hidden_rad = np.fmax(HIDDEN_RAD, _BLUR_SIGMAS * blur_rad)
    some = scene.thinning(_BINS)
    scene = scene.select_bins(some)
    places = [
        _search_axis(stack, binned, scene, excluded, axis, centre_rad, hidden_rad[axis, some])
        for axis in range(len(AXES))
    ]
    known = [place for place in places if place is not None]
    if not known:
        return SecondReflection.unknown()

    # A place counts if it is far beyond chance, and bright enough.
    sigma = max(place.sigma for place in known)
    seen = [place for place in known if place.clear > _CLEAR and place.share > _LEAST_SHARE]
    if not seen:
        return SecondReflection(0.0, sigma)
    best = max(seen, key=lambda place: place.clear)

    # Scale and shift along each axis in which it was seen.
    scales = [1.0, 1.0]
    shifts_rad = [math.nan, math.nan]
    for axis, place in enumerate(places):
        if place is not None and place in seen:
            scales[axis] = place.scale
            shifts_rad[axis] = place.shift_rad
    return SecondReflection(
        best.share,
        sigma,
        (scales[0], scales[1]),
        (shifts_rad[0], shifts_rad[1]),
        screen_scale.mm_per_rad(pattern),
    )


def describe_second_reflection(found: SecondReflection) -> str:
    """Why a set is degraded by a second image; empty if it has none."""
    if not found.is_found:
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
    hidden_rad: FloatArray,
) -> _Place | None:
    """The place that explains the Gray frames of an axis best; None without usable frames.

    `hidden_rad` (n,) is the phase from the edge of a bit within which a second image is hidden.
    """
    phase_rad = scene.phase_rad[axis]
    smooth = scene.smooth_columns()
    frames = []
    for k in stack.gray(AXES[axis]):
        if k in excluded:
            continue
        # Bins that are surely on one side of the frame's edges.
        bit = stack.patterns[k].index
        shown, from_edge_rad = gray_bit(phase_rad, bit)
        saturated = binned.saturated[k].reshape(-1)[scene.index]
        sure = (from_edge_rad > hidden_rad) & ~saturated
        if np.count_nonzero(sure) < _LEAST_SURE * _BINS:
            continue
        # The frame's own pattern: level and contrast, which vary smoothly over the mirror.
        seen = binned.means[k].reshape(-1)[scene.index].astype(float)
        columns = np.concatenate([smooth, smooth * shown]) * (scene.light * sure)
        own = _span_rows(columns)
        left = seen * sure - (own @ (seen * sure)) @ own
        frames.append(_GrayFrame(bit, sure, own, left))
    if not frames:
        return None
    bright = _white_light(stack, binned, scene, excluded)
    return _compare_places(phase_rad - centre_rad, frames, bright, centre_rad)


def _span_rows(columns: FloatArray) -> FloatArray:
    """Orthonormal rows (q, n) that span those of an array (p, n), by the eigenvectors of its Gram
    matrix.
    """
    columns = columns / np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), _TINY)
    values, vectors = np.linalg.eigh(columns @ columns.T)
    independent = values > _DEPENDENT * values[-1]
    scaled = vectors[:, independent] / np.sqrt(values[independent])
    return np.asarray(scaled.T @ columns)


def _compare_places(
    phase_rad: FloatArray, frames: list[_GrayFrame], bright: FloatArray, centre_rad: float
) -> _Place | None:
    """The best of all places of a second image.

    Parameters
    ----------
    phase_rad : (n,) array
        From the pattern's middle.
    frames : list of _GrayFrame
        The Gray frames of the axis.
    bright : (n,) array
        Light of white less that of black.
    centre_rad : float
        Absolute phase of the pattern's middle.
    """
    images = _Images(phase_rad, frames, bright, centre_rad)

    # A coarse search over scales and shifts.
    coarse = _score_places(images, _coarse_places(centre_rad), frames)
    if not coarse.power.size:
        return None
    best = int(np.argmax(coarse.score))
    scale = coarse.scale[best]

    # A finer one over the shifts around its best place.
    shifts_rad = coarse.shift_rad[best] + np.arange(-_STEP_RAD, _STEP_RAD, _CELL_RAD)
    fine = _score_places(images, [(scale, shifts_rad)], frames)
    best = int(np.argmax(fine.score))
    share = fine.share[best]
    power = fine.power[best]
    shift_rad = fine.shift_rad[best]

    # What the other places explain of the rest shows how much chance explains.
    image = images.light_at(scale, np.array([shift_rad]))[:, 0]
    without = [
        replace(frame, left=frame.left - share * frame.free_of_own(of_frame))
        for frame, of_frame in zip(frames, image, strict=True)
    ]
    others = _score_places(images, _coarse_places(centre_rad, _EVERY), without)
    chance = float(np.median(np.abs(others.score))) / _CHANCE_MEDIAN
    sigma = math.sqrt(chance / float(np.median(others.power)))

    # Stray light around an edge has a mirror image of about the same share.
    mirrored = _score_places(images, [(2 - scale, np.array([-shift_rad]))], frames)
    is_stray = False
    if mirrored.share.size:
        is_stray = float(mirrored.share[0]) > _STRAY_SHARE * float(share)

    # Explained power over that of chance; 0 for stray light, and for a share that is no light.
    clear = 0.0
    if not is_stray and share >= 0:
        clear = float(share**2 * power) / max(chance, _TINY)
    return _Place(float(share), sigma, clear, float(scale), float(shift_rad))


class _Images:
    """Second images of the Gray frames of an axis, for any place.

    The bits of the pattern are tabulated by phase, from far beyond one edge to far beyond the
    other, where the pattern is dark.
    """

    def __init__(
        self, phase_rad: FloatArray, frames: list[_GrayFrame], bright: FloatArray, centre_rad: float
    ) -> None:
        # Phases that any scale and shift of the search reaches.
        self._phase_rad = phase_rad
        largest_rad = float(np.max(np.abs(phase_rad))) + _SHIFT_RANGE * centre_rad
        self._reach_rad = 3 * largest_rad

        # What each Gray frame shows at cells of the phase, dark beside the pattern: a look-up for
        # every bin, scale and shift.
        cells_rad = np.arange(-self._reach_rad, self._reach_rad, _CELL_RAD)
        inside = np.abs(cells_rad) < centre_rad + np.pi
        shown = [gray_bit(cells_rad + centre_rad, frame.bit)[0] & inside for frame in frames]
        self._table = np.stack(shown)
        self._bright = bright * np.stack([frame.sure for frame in frames])

    def light_at(self, scale: float, shifts_rad: FloatArray) -> FloatArray:
        """Light of images of the same brightness as the first.

        Parameters
        ----------
        scale : float
            Phase of the second image over that of the first, about the pattern's middle.
        shifts_rad : (s,) array
            Phase added to it.

        Returns
        -------
        (frames, s, n) array
            Light of each bin in each Gray frame.
        """
        place_rad = scale * self._phase_rad + shifts_rad[:, None] + self._reach_rad
        cell = np.rint(place_rad / _CELL_RAD).astype(np.intp)
        light = np.empty((len(self._table), *cell.shape))
        for of_frame, shown, bright in zip(light, self._table, self._bright, strict=True):
            np.multiply(np.take(shown, cell, mode="clip"), bright, out=of_frame)
        return light


def _white_light(
    stack: FrameStack, binned: Binned, scene: SampledBins, excluded: Collection[int]
) -> FloatArray:
    """Light (n,) of a white screen less that of a black one."""
    pair = stack.white_and_black(excluded)
    if pair is None:
        return 2 * scene.light  # of fringes with full contrast
    white, black = pair
    more = binned.means[white].astype(float) - binned.means[black]
    ratio = more.reshape(-1)[scene.index] / scene.light
    return scene.light * float(np.median(ratio))


def _coarse_places(centre_rad: float, every: int = 1) -> list[tuple[float, FloatArray]]:
    """Scales with their shifts, without those of the first image itself."""
    reach_rad = _SHIFT_RANGE * centre_rad
    shifts_rad = np.arange(-reach_rad, reach_rad, every * _STEP_RAD)
    of_other_images = shifts_rad[np.abs(shifts_rad) > HIDDEN_RAD]
    places = []
    for scale in _SCALES:
        of_scale_rad = shifts_rad
        if abs(scale - 1) <= _SAME_SCALE:  # the first image is among these
            of_scale_rad = of_other_images
        places.append((scale, of_scale_rad))
    return places


@dataclass(frozen=True)
class _PlaceScores:
    """How well k places explain what the frames' own patterns leave: arrays (k,).

    Attributes
    ----------
    score : (k,) array
        Explained power, with the sign of the share.
    share : (k,) array
        Least squares for the share of a second image there.
    power : (k,) array
        Power of the image that the own patterns do not explain.
    scale, shift_rad : (k,) arrays
        The place.
    """

    score: FloatArray
    share: FloatArray
    power: FloatArray
    scale: FloatArray
    shift_rad: FloatArray


def _score_places(
    images: _Images, places: list[tuple[float, FloatArray]], frames: list[_GrayFrame]
) -> _PlaceScores:
    """Score the places at which the frames determine a second image."""
    rows = [np.zeros((5, 0))]
    for scale, shifts_rad in places:
        image = images.light_at(scale, shifts_rad)
        whole_power = np.zeros(shifts_rad.size)
        power = np.zeros(shifts_rad.size)
        product = np.zeros(shifts_rad.size)
        for of_frame, frame in zip(image, frames, strict=True):
            # Power of the image outside the frame's own pattern, and its product with what is left.
            of_frame_power = np.einsum("sn,sn->s", of_frame, of_frame)
            found = of_frame @ np.vstack([frame.own, frame.left]).T
            whole_power += of_frame_power
            power += of_frame_power - np.sum(found[:, :-1] ** 2, axis=1)
            product += found[:, -1]
        # Least squares of one amplitude: product / power; it lowers the sum of squares by the
        # score.
        determined = power > _LEAST_DETERMINED * whole_power + 1e-9
        power = power[determined]
        product = product[determined]
        shifts_rad = shifts_rad[determined]
        score = product * np.abs(product) / power
        scales = np.full(shifts_rad.size, scale)
        rows.append(np.stack([score, product / power, power, scales, shifts_rad]))
    return _PlaceScores(*np.concatenate(rows, axis=1))
