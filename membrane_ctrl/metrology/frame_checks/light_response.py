"""Response of panel and camera together, and how even the light is over the mirror.

Over whole fringes the mean of a sinusoid lies between black and white by the mean of
((1 + cos) / 2)^g, which is Gamma(g + 1/2) / (sqrt(pi) Gamma(g + 1)): 0.5 of a linear chain, 0.36 of
a panel with a gamma of 2.2. No panel has a gamma below 1: there the camera's response is not
linear, or a panel is corrected that was linear. A gamma of both that cancels is not seen, and does
nothing to a sinusoid.

Light that varies over the mirror is the panel's, at an angle, or the lens's. It multiplies all
frames, so that it changes no phase; the two cannot be separated in the frames of one set.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.model.arrays import FloatArray, IntArray

_EXPONENTS = np.geomspace(0.15, 6.0, 200)
_LEAST_EXPONENT = 0.88  # below, a linear panel's light is not what the camera counts
_LEAST_BINS = 300


@dataclass(frozen=True)
class LightResponse:
    """What the frames show of the light."""

    exponent: float  # counts rise as level^exponent; NaN if the set cannot show it
    edge_loss: float  # share of the light that is lost from the mirror's middle to its edge
    side_loss: float  # and from its brightest side to the opposite one


UNKNOWN = LightResponse(math.nan, math.nan, math.nan)


def estimate_response(
    stack: FrameStack,
    binned: Binned,
    index: IntArray,
    place_mm: FloatArray,
    excluded: Collection[int],
    used: tuple[list[int], list[int]],
) -> LightResponse:
    """Estimate it from some bins.

    Parameters
    ----------
    index : (n,) int array
        Bins that see the pattern in the mirror.
    place_mm : (2, n) array
        Where on the mirror, over its radius.
    excluded : frames
        Those that do not belong.
    used : two lists
        Sinusoids of x and y.
    """
    if index.size < _LEAST_BINS:
        return UNKNOWN
    means = binned.means.reshape(len(stack.patterns), -1)[:, index].astype(float)
    middle = np.mean([stack.weights(frames)[0] @ means[frames] for frames in used], axis=0)
    edge_loss, side_loss = _find_losses(middle, place_mm)
    white, black = stack.single("white"), stack.single("black")
    if white is None or black is None or {white, black} & set(excluded):
        return LightResponse(math.nan, edge_loss, side_loss)
    span = np.maximum(means[white] - means[black], 1e-9)
    share = float(np.median((middle - means[black]) / span))
    return LightResponse(_invert_share(share), edge_loss, side_loss)


def describe_response(found: LightResponse) -> str:
    """Why a set is degraded by the response; empty if it is not."""
    if not found.exponent < _LEAST_EXPONENT:
        return ""
    return (
        "the camera's response is not linear: its counts rise about as "
        f"light^{found.exponent:.2f}: switch its gamma off (or the panel, which was linear, is "
        "corrected)"
    )


def _invert_share(share: float) -> float:
    """Exponent of which a sinusoid's mean lies at this share between black and white."""
    shares = [
        math.exp(math.lgamma(g + 0.5) - math.lgamma(g + 1)) / math.sqrt(math.pi) for g in _EXPONENTS
    ]
    return float(np.interp(-share, -np.array(shares), _EXPONENTS))


def _find_losses(light: FloatArray, place: FloatArray) -> tuple[float, float]:
    """Losses to the edge and from side to side, by a plane and a bowl of the light."""
    x, y = place
    columns = np.stack([np.ones_like(x), x, y, x**2 + y**2])
    level, along_x, along_y, bowl = np.linalg.lstsq(columns.T, light, rcond=None)[0]
    level = max(float(level), 1e-9)
    return float(-bowl / level), float(2 * math.hypot(along_x, along_y) / level)
