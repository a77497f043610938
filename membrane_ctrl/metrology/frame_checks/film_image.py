"""A second reflection of the screen in a part of the mirror: a film in front that is not stated.

A convex film in front shows the whole screen in a small part of the mirror. There white is brighter
by a fifth, with sharp edges, but the fringes hardly swing more: the added light comes from other
places of the screen, whose fringes run across each other. A bright spot of the panel raises
both; a lamp in the room is in the black frame, too. Without white and black frames the mean light
of the fringes shows the same patch, but a lamp as well.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.polynomial.polynomial import polyvander

from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

_DEGREE = 4  # of the smooth light of the mirror
# Exponents of x and y of its monomials
_POWERS = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
_FITTED_BINS = 6000  # that determine it, and the scatter about it
_ROUNDS = 4  # of its fit, each without the bins that are brighter
_LEAST_SHARE = 0.02  # of the light
_CLEAR_SIGMAS = 6.0
_LARGEST_SQUARE = 5  # bins along a side
_LEAST_BINS = 12
_LEAST_PART, _LARGEST_PART = 5e-4, 0.3  # of the mirror's bins
_STEEP = 0.2  # largest excess outside the edge of the patch over that inside it
_SWING_SHARE = 0.6  # largest excess of the swing over that of the light
_MAD_SIGMAS = 1.4826


class ImageEvidence(Enum):
    """Which light was searched for a second reflection."""

    WHITE_AND_BLACK = "white and black"
    MEAN_LIGHT = "mean light of the fringes"
    NOT_TESTED = "not tested"


@dataclass(frozen=True)
class FilmImage:
    """A part of the mirror that shows the screen a second time.

    Attributes
    ----------
    share : float
        Of the main light; 0 if there is none.
    evidence : ImageEvidence
        The light that was searched; not tested: the frames do not allow it, or the bench has a
        front film.
    x_mm, y_mm : float
        Middle of the part on the mirror.
    width_mm, height_mm : float
        Its size along x and along y.
    """

    share: float
    evidence: ImageEvidence = ImageEvidence.NOT_TESTED
    x_mm: float = math.nan
    y_mm: float = math.nan
    width_mm: float = math.nan
    height_mm: float = math.nan

    @property
    def is_found(self) -> bool:
        """Whether there is one."""
        return self.share > 0

    def describe(self) -> str:
        """Why a set is degraded; empty without a second reflection."""
        if not self.is_found:
            return ""
        place = (
            f"at x {self.x_mm:+.0f} mm, y {self.y_mm:+.0f} mm "
            f"({self.width_mm:.0f} by {self.height_mm:.0f} mm), {self.share:.0%} of the light"
        )
        if self.evidence is ImageEvidence.MEAN_LIGHT:
            return (
                f"a second reflection of the screen, or of a lamp, {place}: is there a film in "
                "front of the mirror? State it as mirror.front_film; a set with white and black "
                "frames shows which it is"
            )
        return (
            f"a second reflection of the screen {place}: is there a film in front of the mirror? "
            "State it as mirror.front_film"
        )


NO_FILM_IMAGE = FilmImage(0.0)


def find_film_image(
    shape: tuple[int, int],
    index: IntArray,
    position_mm: FloatArray,
    light: FloatArray,
    compute_swing: Callable[[], FloatArray],
    evidence: ImageEvidence = ImageEvidence.WHITE_AND_BLACK,
) -> FilmImage:
    """Search the bins of the mirror for a part that shows the screen a second time.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of bins.
    index : (n,) int array
        Bins on the mirror.
    position_mm : (2, n) array
        Where they are on it.
    light : (n,) array
        Light of a white screen less that of a black one, or the mean light of the fringes.
    compute_swing : function
        Returns the amplitude (n,) of the fringes; called only if a part is brighter.
    evidence : ImageEvidence
        Which of both the light is.

    Returns
    -------
    FilmImage
    """
    nothing = FilmImage(0.0, evidence)
    if index.size < _LEAST_BINS / _LARGEST_PART or not np.median(light) > 0:
        return NO_FILM_IMAGE

    # A smooth change of the light over the mirror, which some of the bins determine: in each round
    # those that were not far off it in the last one.
    scale_mm = float(np.abs(position_mm).max())
    some = np.arange(0, index.size, max(1, index.size // _FITTED_BINS))
    columns = _smooth_columns(position_mm[:, some] / scale_mm)
    usual = np.ones(some.size, bool)
    smooth = np.zeros(len(_POWERS))
    sigma = math.inf
    for _ in range(_ROUNDS):
        smooth = _fit_smooth(light[some], columns, usual)
        excess_of_some = light[some] / (smooth @ columns) - 1
        sigma = _MAD_SIGMAS * float(np.median(np.abs(excess_of_some[usual])))
        usual = np.abs(excess_of_some) < max(_LEAST_SHARE / 2, 3 * sigma)
        if np.mean(usual) < 1 - _LARGEST_PART:
            return nothing
    excess = light / _evaluate_smooth(smooth, position_mm / scale_mm) - 1

    # Noisy bins are averaged over squares.
    side = 1
    while sigma / side > _LEAST_SHARE / _CLEAR_SIGMAS and side < _LARGEST_SQUARE:
        side += 2
    excess = _average_bins(shape, index, excess, side)
    bright = excess > max(_LEAST_SHARE, _CLEAR_SIGMAS * sigma / side)

    # The largest connected patch of brighter bins.
    if not bright.any():
        return nothing
    picture = np.zeros(shape, np.uint8)
    picture.reshape(-1)[index[bright]] = 1
    _, parts, stats, _ = cv2.connectedComponentsWithStats(picture, connectivity=4)
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    patch = parts == largest
    inside = patch.reshape(-1)[index]
    size = int(np.count_nonzero(inside))
    if size < max(_LEAST_BINS, _LEAST_PART * index.size) or size > _LARGEST_PART * index.size:
        return nothing

    # Its edges are sharp, and its fringes do not swing more.
    share = float(np.median(excess[inside]))
    around = _ring_around(patch).reshape(-1)[index]
    within = _ring_within(patch).reshape(-1)[index]
    if not within.any():
        within = inside
    if not around.any() or np.median(excess[around]) > _STEEP * np.median(excess[within]):
        return nothing
    swing = compute_swing()
    smooth = _fit_smooth(swing[some], columns, usual)
    swing_excess = swing / _evaluate_smooth(smooth, position_mm / scale_mm) - 1
    swing_excess = _average_bins(shape, index, swing_excess, side)
    if float(np.mean(swing_excess[inside])) > _SWING_SHARE * share:
        return nothing
    x_mm, y_mm = position_mm[:, inside]
    return FilmImage(
        share,
        evidence,
        float(np.mean(x_mm)),
        float(np.mean(y_mm)),
        float(np.ptp(x_mm)),
        float(np.ptp(y_mm)),
    )


def _smooth_columns(place: FloatArray) -> FloatArray:
    """Monomials (k, m) of places (2, m) within the unit square."""
    of_x, of_y = polyvander(place, _DEGREE)
    return np.stack([of_x[:, i] * of_y[:, j] for i, j in _POWERS])


def _fit_smooth(values: FloatArray, columns: FloatArray, usual: BoolArray) -> FloatArray:
    """Amplitudes (k,) of the monomials (k, m) through the usual ones of the values (m,)."""
    known = columns[:, usual]
    return np.asarray(np.linalg.solve(known @ known.T, known @ values[usual]))


def _evaluate_smooth(amplitudes: FloatArray, place: FloatArray) -> FloatArray:
    """The polynomial of these amplitudes at places (2, n)."""
    table = np.zeros((_DEGREE + 1, _DEGREE + 1))
    for (i, j), amplitude in zip(_POWERS, amplitudes, strict=True):
        table[i, j] = amplitude
    # Horner's scheme, in x of polynomials in y, each no longer than the total degree allows.
    x, y = place
    value = np.zeros(x.size)
    for i in range(_DEGREE, -1, -1):
        of_y = np.full(x.size, table[i, _DEGREE - i])
        for j in range(_DEGREE - i - 1, -1, -1):
            of_y *= y
            of_y += table[i, j]
        value *= x
        value += of_y
    return value


def _average_bins(
    shape: tuple[int, int], index: IntArray, values: FloatArray, side: int
) -> FloatArray:
    """Means of values (n,) over squares of bins, of those that have one."""
    if side == 1:
        return values
    # Mean over a square of values and zeros, divided by the share of bins that have one.
    sums = np.zeros(shape)
    known = np.zeros(shape)
    sums.reshape(-1)[index] = values
    known.reshape(-1)[index] = 1.0
    square = (side, side)
    mean = cv2.blur(sums, square, borderType=cv2.BORDER_CONSTANT)
    share = cv2.blur(known, square, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(mean.reshape(-1)[index] / share.reshape(-1)[index])


def _ring_around(patch: BoolArray) -> BoolArray:
    """Bins two and three beside a patch: the first one is cut by its edge."""
    kernel = np.ones((3, 3), np.uint8)
    near = cv2.dilate(patch.astype(np.uint8), kernel, iterations=1)
    far = cv2.dilate(near, kernel, iterations=2)
    return np.asarray((far > 0) & (near == 0))


def _ring_within(patch: BoolArray) -> BoolArray:
    """Bins of a patch that are second from its edge."""
    kernel = np.ones((3, 3), np.uint8)
    whole = cv2.erode(patch.astype(np.uint8), kernel)
    core = cv2.erode(whole, kernel)
    return np.asarray((whole > 0) & (core == 0))
