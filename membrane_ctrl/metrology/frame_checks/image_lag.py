"""Share of the previous picture that each frame still shows: a slow panel, or a camera's lag.

Frame k then shows P_k + f (P_(k-1) - P_k), with P the pictures of a panel at rest. All steps of a
sinusoid but the first follow a step of the same sinusoid, so that their phases turn together by
about f sin(step). No frame disagrees with the others, and the figure tilts: 3.6 µm RMS at 1 %.

Frames that follow another kind of pattern show f: Gray bits after Gray bits or sinusoids, the first
y step after the last x frame, white after a Gray bit. Each of them is fitted by its own pattern and
by the difference from the previous frame as it was seen, where that is brighter and where it is
darker: panels rarely rise as fast as they fall. The medians over the frames are the two shares.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from membrane_ctrl.metrology.frame_checks.sampled_bins import SampledBins
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray, Singles

# Bins nearer than this to the edge of a Gray bit are not used, rad: blur, and the turn of the
# phases by a large share, stay inside.
_EDGE_RAD = 0.7
_HARMONICS = range(2, 7)  # of a sinusoid: the response of panel and camera

# Least power of the change from the previous frame that the frame's own pattern does not explain,
# over the whole power of that change.
_LEAST_DETERMINED = 0.05
_REGULAR = 1e-12  # of the length of a column
_LEAST_BINS = 300  # of one frame
_LIVE_BINS = 2500  # of a live cycle: a share is known to 2e-4
# Errors of the shares that no frame shows: relative to the share, because sinusoids change between
# greys and Gray frames between black and white; relative to the difference of rise and fall;
# relative to the share's square, because a panel relaxes from its last picture or from its state.
_TRANSITIONS = 0.01
_ASYMMETRY = 0.03
_SECOND_ORDER = 0.1
_SURE_SIGMAS = 3.0  # a share is removed if it exceeds so many of its sigmas
_FLOOR_SIGMA = 3e-5  # least standard uncertainty of a share
# Rounds of estimate and correction. Each finds 90 % of the rest, because the light that it compares
# with has its share, too.
ROUNDS = 5
_NEGLIGIBLE_SHARE = 2e-5  # a smaller rest needs no further round
_UNKNOWN_SIGMA = 0.03  # a share that is less well known is no estimate
_GREAT_SHARE = 0.05  # from here on, the rest after the correction is not small
_LEAST_AMPLITUDE = 1e-9  # instead of a division by zero
# Robust statistics: standard deviation over the median absolute deviation of normal numbers, and
# standard error of a median over that of a mean.
_SIGMA_OVER_MAD = 1.4826
_MEDIAN_OVER_MEAN = 1.25
_LEAST_SHOWN = 10.0  # a frame whose share is less certain than the usual by this factor is left out
_SCATTER_OF_ONE = 0.1  # assumed relative scatter of the shares if only one frame shows them

# Share of the previous picture and its standard uncertainty, as one frame shows them.
ShareOfFrame = tuple[float, float]


@dataclass(frozen=True)
class ImageLag:
    """Share of the previous picture in each frame.

    Attributes
    ----------
    rise : float
        Share where a frame is brighter than the previous one.
    fall : float
        Share where it is darker.
    sigma : float
        Standard uncertainty of their mean; NaN if the set cannot show it.
    corrected : bool
        Whether the frames were corrected for it.
    noise : float
        The part of `sigma` that follows from the noise of the pixels.
    scatter : (k,) array
        The parts of `sigma` that single frames add, because what they show differs from the others;
        at the same place for the same frame, first where frames rise, then where they fall.
    """

    rise: float
    fall: float
    sigma: float
    corrected: bool = False
    noise: float = 0.0
    scatter: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def unknown(cls) -> "ImageLag":
        """A share that the set does not show."""
        return cls(0.0, 0.0, math.nan)

    @property
    def share(self) -> float:
        """Mean of the two."""
        return (self.rise + self.fall) / 2

    @property
    def remaining_sigma(self) -> float:
        """Standard uncertainty of the share that is left in the frames; NaN if unknown."""
        if self.corrected:
            return self.sigma
        return math.hypot(self.share, self.sigma)


def estimate_image_lag(
    stack: FrameStack, binned: Binned, scene: SampledBins, excluded: Collection[int]
) -> ImageLag:
    """Estimate the shares from all frames that can show them.

    Derivation: section 10 of docs/explanation/metrology.md.

    Parameters
    ----------
    stack, binned, scene
        As in `frame_evidence.measure_frames`.
    excluded : collection of int
        Frames that do not belong to the set: neither used nor compared with.

    Returns
    -------
    ImageLag
        `ImageLag.unknown()` if no frame shows both shares, or only with an uncertainty above 3 %.
    """
    scene = scene.thin_to()
    means = np.take(binned.means.reshape(len(stack.patterns), -1), scene.index, axis=1).astype(
        float
    )
    clipped = np.take(binned.saturated.reshape(len(stack.patterns), -1), scene.index, axis=1)
    smooth = scene.smooth_columns()

    # The shares that each frame shows.
    rises: dict[int, ShareOfFrame] = {}
    falls: dict[int, ShareOfFrame] = {}
    for frame in range(len(stack.patterns)):
        previous = stack.frame_before(frame)
        if previous < 0 or {frame, previous} & set(excluded):
            continue
        if stack.patterns[previous].role not in ("sin", "gray"):
            continue  # a picture without a pattern acts as a change of the light
        columns, sure = _own_columns(stack, scene, frame, smooth)
        usable = sure & ~clipped[frame] & ~clipped[previous]
        rise_of_frame, fall_of_frame = _fit_previous(
            means[frame], means[previous], columns * scene.light, usable
        )
        if rise_of_frame is not None:
            rises[frame] = rise_of_frame
        if fall_of_frame is not None:
            falls[frame] = fall_of_frame
    if not rises or not falls:
        return ImageLag.unknown()

    # Their medians over the frames.
    count_frames = len(stack.patterns)
    rise, rise_noise, rise_scatter = _combine_frames(rises, count_frames)
    fall, fall_noise, fall_scatter = _combine_frames(falls, count_frames)
    noise = math.hypot(rise_noise, fall_noise) / math.sqrt(2)
    scatter = np.concatenate([rise_scatter, fall_scatter]) / math.sqrt(2)
    sigma = math.hypot(noise, float(np.linalg.norm(scatter)))
    if len(rises) == 1:  # one frame has no scatter: only the difference of the shares is evidence
        sigma = math.hypot(sigma, rise - fall)
    if sigma > _UNKNOWN_SIGMA:
        return ImageLag.unknown()
    sigma = math.hypot(sigma, _FLOOR_SIGMA)
    return ImageLag(rise, fall, sigma, noise=math.hypot(noise, _FLOOR_SIGMA), scatter=scatter)


def is_worth_removing(lag: ImageLag) -> bool:
    """Whether the frames show a share beyond its uncertainty."""
    return max(abs(lag.rise), abs(lag.fall)) > _SURE_SIGMAS * lag.sigma


def add_image_lag(removed: ImageLag, found: ImageLag) -> ImageLag:
    """Return the shares in the frames, of which one part was removed before the other was found.

    Parameters
    ----------
    removed : ImageLag
        Sum of the shares that earlier rounds removed.
    found : ImageLag
        Shares that the corrected frames still show.

    Returns
    -------
    ImageLag
        `found` itself if nothing was removed and nothing is worth it; else the sum, whose sigma
        contains what no frame shows.
    """
    if not removed.corrected and not is_worth_removing(found):
        return found
    # The frames were corrected by P = I + f / (1 - f) (I - I_before): what is found is a share of
    # what the correction has left.
    rise = removed.rise + found.rise * (1 - removed.rise)
    fall = removed.fall + found.fall * (1 - removed.fall)
    share = (rise + fall) / 2

    # What no frame shows: transitions between greys, a rise that differs from the fall, and the
    # second order of the share.
    model_sigma = math.hypot(
        _TRANSITIONS * share, _ASYMMETRY * (rise - fall), _SECOND_ORDER * share**2
    )
    return replace(
        found,
        rise=rise,
        fall=fall,
        sigma=math.hypot(found.sigma, model_sigma),
        corrected=True,
    )


def remove_image_lag(stack: FrameStack, binned: Binned, lag: ImageLag) -> Binned:
    """Return the bins with the previous pictures taken out: P = I + f / (1 - f) (I - I_before).

    Section 10 of docs/explanation/metrology.md.

    Parameters
    ----------
    stack : FrameStack
        Its `frame_before` states which picture was shown before each frame.
    binned : Binned
        The frames as the camera took them.
    lag : ImageLag
        The shares f to remove.

    Returns
    -------
    Binned
        The means of frames with a known predecessor are corrected, others as they were.
    """
    means = binned.means.copy()
    for frame in range(len(stack.patterns)):
        previous = stack.frame_before(frame)
        if previous >= 0:
            means[frame] += lag_correction(binned.means[frame], binned.means[previous], lag)
    return replace(binned, means=means)


def lag_correction(seen: Singles, previous: Singles, lag: ImageLag) -> Singles:
    """Return the correction f / (1 - f) (I - I_before) that a picture at rest shows in addition.

    Parameters
    ----------
    seen, previous : array of one shape
        The picture I, and the one before it as it was seen.
    lag : ImageLag
        The shares f.

    Returns
    -------
    array
        P - I in the units of the pictures.
    """
    more = seen - previous
    rise = np.float32(lag.rise / (1 - lag.rise))
    fall = np.float32(lag.fall / (1 - lag.fall))
    return np.asarray(np.where(more > 0, rise, fall) * more)


def choose_lag_bins(index: IntArray) -> IntArray:
    """Enough of the bins `index` (n,) of a live cycle to find the shares."""
    return np.arange(0, index.size, max(1, index.size // _LIVE_BINS))


def find_image_lag(
    stack: FrameStack, binned: Binned, phase_rad: FloatArray, places_px: FloatArray
) -> ImageLag:
    """Find the shares of a live cycle, whose phases are known.

    Parameters
    ----------
    stack, binned : FrameStack, Binned
        The cycle, and its frames as means over n bins.
    phase_rad : (2, n) array
        Absolute phases of the bins, to some hundredths of a radian.
    places_px : (2, n) array
        Columns and rows of the bins in the picture.
    """
    x_frames = stack.sinusoids(AXES[0])
    mean_of_steps = stack.weights(x_frames)[0]
    index = np.arange(phase_rad.shape[1])
    # Each round finds what the frames as corrected so far still contain.
    lag = ImageLag.unknown()
    corrected = binned
    for _ in range(ROUNDS):
        # The light is the mean of the x steps, in the frames as corrected so far.
        x_means = corrected.means[x_frames].reshape(len(x_frames), -1)
        light = np.tensordot(mean_of_steps, x_means, axes=1)
        scene = SampledBins(index, light, phase_rad, np.zeros_like(phase_rad), places_px)
        found = estimate_image_lag(stack, corrected, scene, ())
        lag = add_image_lag(lag, found)
        if not lag.corrected or not is_worth_another_round(found):
            break
        corrected = remove_image_lag(stack, binned, lag)
    return lag


def is_worth_another_round(found: ImageLag) -> bool:
    """Whether the shares that the last round found are worth a correction."""
    return max(abs(found.rise), abs(found.fall)) > _NEGLIGIBLE_SHARE


def add_first_predecessor(
    stack: FrameStack, binned: Binned, scene: SampledBins, lag: ImageLag
) -> FrameStack:
    """Return the stack with the last frame as the first one's predecessor, if that fits better.

    Sets are often taken one after the other, and then the first picture follows the last one (white
    or black). If it does, the first sinusoid swings less than the others of its axis, by the share.

    Parameters
    ----------
    stack, binned, scene
        As in `estimate_image_lag`.
    lag : ImageLag
        The shares, as the other frames show them.

    Returns
    -------
    FrameStack
        The given one, or one whose first frame has a predecessor.
    """
    share = lag.share
    x_frames = stack.sinusoids(AXES[0])
    without_predecessor = [frame for frame in x_frames if stack.frame_before(frame) < 0]
    if len(without_predecessor) != 1 or share <= 0:
        return stack
    first = without_predecessor[0]

    # Swing of each sinusoid of x.
    scene = scene.thin_to()
    constant = np.ones((1, scene.index.size))
    swings = {}
    for frame in x_frames:
        seen = binned.means[frame].reshape(-1)[scene.index].astype(float)
        columns, _ = _own_columns(stack, scene, frame, constant)
        solved = np.linalg.lstsq((columns * scene.light).T, seen, rcond=None)[0]
        swings[frame] = float(np.hypot(solved[1], solved[2]))

    # Swing without image lag: the other frames contain the share f of a step of the same fringes,
    # which leaves |1 - f + f exp(-i step)| of it.
    others = float(np.median([swing for frame, swing in swings.items() if frame != first]))
    step_rad = float(np.median(np.diff(stack.shifts_rad(x_frames))))
    others /= abs(1 - share + share * np.exp(-1j * step_rad))

    # 1 - f of it is left in the first frame if it follows a picture without fringes, else all.
    ratio = swings[first] / max(others, _LEAST_AMPLITUDE)
    if abs(ratio - (1 - share)) >= abs(ratio - 1):
        return stack
    before = [stack.frame_before(frame) for frame in range(len(stack.patterns))]
    before[first] = stack.last_taken
    return replace(stack, before=tuple(before))


def describe_image_lag(lag: ImageLag) -> str:
    """Why a set is degraded by light of the previous pictures; empty if it is not."""
    if not lag.corrected or abs(lag.share) < _GREAT_SHARE:
        return ""
    return (
        f"each frame shows {lag.share:.1%} of the previous picture: the panel is slow, or the "
        "frames come too early after it: wait longer"
    )


def _own_columns(
    stack: FrameStack, scene: SampledBins, frame: int, smooth: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Columns (p, n) of a frame's own pattern, in units of the light, and the bins (n,) to fit.

    Of a sinusoid, the first three columns are level, cosine and sine.
    """
    pattern = stack.patterns[frame]
    every_bin = np.ones(scene.index.size, bool)
    if pattern.role in ("white", "black"):
        return smooth, every_bin
    phase_rad = scene.phase_rad[AXES.index(pattern.axis)]
    # A Gray frame: two levels, each with slow changes over the mirror.
    if pattern.role == "gray":
        shown, from_edge_rad = gray_bit(phase_rad, pattern.index)
        return np.concatenate([smooth, smooth * shown]), from_edge_rad > _EDGE_RAD
    if pattern.period_mm:  # another period: its phase is not among those of the scene
        return smooth, ~every_bin
    psi_rad = phase_rad + pattern.shift_rad
    # The contrast may vary slowly over the mirror, as that of a panel that is seen at an angle.
    fundamental = np.stack([np.cos(psi_rad), np.sin(psi_rad)])
    slow_contrast = smooth[1:] * fundamental[0]
    cosines = np.stack([np.cos(n * psi_rad) for n in _HARMONICS])
    sines = np.stack([np.sin(n * psi_rad) for n in _HARMONICS])
    columns = np.concatenate([smooth[:1], fundamental, smooth[1:], slow_contrast, cosines, sines])
    return columns, every_bin


def _fit_previous(
    seen: FloatArray, previous: FloatArray, columns: FloatArray, usable: BoolArray
) -> tuple[ShareOfFrame | None, ShareOfFrame | None]:
    """Fit one frame by its own pattern, and by the change from the previous frame.

    Parameters
    ----------
    seen, previous : (n,) array
        Light of the bins in this frame, and in the one before.
    columns : (p, n) array
        The frame's own pattern.
    usable : (n,) bool array
        The bins to fit.

    Returns
    -------
    rise, fall : (share, sigma) or None
        Where the frame rises, and where it falls; None if it cannot show that.
    """
    if np.count_nonzero(usable) < _LEAST_BINS:
        return None, None
    columns = np.compress(usable, columns, axis=1)
    seen = seen[usable]

    # The frame's own pattern alone. Normal equations of columns of length 1, which are far from
    # dependent; where one is empty, the small diagonal leaves it out.
    normal = columns @ columns.T
    lengths = np.maximum(np.sqrt(np.diag(normal)), 1e-30)
    scale = np.outer(lengths, lengths)
    inverse = np.linalg.inv(normal / scale + _REGULAR * np.eye(lengths.size)) / scale

    def explain(light: FloatArray) -> FloatArray:
        """The part of light (..., n) that the columns can show."""
        return np.asarray((light @ columns.T) @ inverse @ columns)

    own = explain(seen)

    # The change from the previous frame, where this frame is brighter, and where it is darker; each
    # less what the own pattern explains of it.
    change = previous[usable] - own
    ways = np.stack([np.minimum(change, 0.0), np.maximum(change, 0.0)])
    free = ways - explain(ways)
    power = np.sum(free**2, axis=1)
    least_power = _LEAST_DETERMINED * np.sum(ways**2, axis=1) + 1e-12 * float(own @ own)
    is_determined = power > least_power
    if not is_determined.any():
        return None, None

    # Least squares for the shares; the rest gives their noise.
    free = free[is_determined]
    covariance = np.linalg.inv(free @ free.T)
    shares = covariance @ (free @ (seen - own))
    rest = seen - own - shares @ free
    sigmas = np.sqrt(np.mean(rest**2) * np.diag(covariance))
    determined = list(zip(shares.tolist(), sigmas.tolist(), strict=True))
    rise_is_determined, fall_is_determined = is_determined
    rise = determined[0] if rise_is_determined else None
    fall = determined[-1] if fall_is_determined else None
    return rise, fall


def _combine_frames(
    found: dict[int, ShareOfFrame], count_frames: int
) -> tuple[float, float, FloatArray]:
    """Median of the frames' shares, its noise, and what each frame's scatter adds to its
    uncertainty (count_frames,).

    Frames that hardly show the share beside their own pattern are left out.
    """
    frames = np.array(list(found))
    shares, sigmas = np.array(list(found.values())).T
    is_shown = sigmas <= _LEAST_SHOWN * np.median(sigmas)
    frames = frames[is_shown]
    shares = shares[is_shown]
    sigmas = sigmas[is_shown]
    share = float(np.median(shares))
    noise = float(np.median(sigmas)) / math.sqrt(shares.size)
    scatter = np.zeros(count_frames)
    if shares.size == 1:
        scatter[frames] = _SCATTER_OF_ONE * abs(share)
        return share, noise, scatter

    # The frames' deviations, of which outliers count as much as the usual ones, scaled to the
    # uncertainty of a median.
    deviations = shares - share
    usual = _SIGMA_OVER_MAD * float(np.median(np.abs(deviations)))
    deviations = np.clip(deviations, -usual, usual)
    length = max(float(np.linalg.norm(deviations)), _LEAST_AMPLITUDE)
    sigma = _MEDIAN_OVER_MEAN * usual / math.sqrt(shares.size)
    scatter[frames] = deviations * (sigma / length)
    return share, noise, scatter
