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

_EXPONENTS = np.geomspace(0.15, 6.0, 200)  # that are tabulated
_LEAST_EXPONENT = 0.88  # below it, the camera's counts are not proportional to the light
_LEAST_BINS = 300


@dataclass(frozen=True)
class LightResponse:
    """What the frames show of the light.

    Attributes
    ----------
    exponent : float
        Counts rise as level^exponent; NaN if the set cannot show it.
    edge_loss : float
        Share of the light that is lost from the mirror's middle to its edge.
    side_loss : float
        Share of the light that is lost from the mirror's brightest side to the opposite one.
    """

    exponent: float
    edge_loss: float
    side_loss: float

    @classmethod
    def unknown(cls) -> "LightResponse":
        """A response that the set does not show."""
        return cls(math.nan, math.nan, math.nan)


def estimate_response(
    stack: FrameStack,
    binned: Binned,
    index: IntArray,
    position: FloatArray,
    excluded: Collection[int],
    used: tuple[list[int], list[int]],
) -> LightResponse:
    """Estimate response and losses of the light.

    Parameters
    ----------
    stack, binned : FrameStack, Binned
        The set, and its frames as means over bins.
    index : (n,) int array
        Bins that see the pattern in the mirror.
    position : (2, n) array
        Position on the mirror, over its radius.
    excluded : collection of int
        Frames that do not belong to the set.
    used : two lists of int
        The used sinusoids of x and y.

    Returns
    -------
    LightResponse
        `LightResponse.unknown()` with fewer than 300 bins.
    """
    if index.size < _LEAST_BINS:
        return LightResponse.unknown()
    # Mean light of the fringes, which is that of half the pattern for a straight response.
    means = binned.means.reshape(len(stack.patterns), -1)[:, index].astype(float)
    mean_of_axes = [stack.weights(frames)[0] @ means[frames] for frames in used]
    mean_of_fringes = np.mean(mean_of_axes, axis=0)
    edge_loss, side_loss = _find_losses(mean_of_fringes, position)
    pair = stack.white_and_black(excluded)
    if pair is None:
        return LightResponse(math.nan, edge_loss, side_loss)
    # Its place between black and white shows the exponent.
    white, black = pair
    span = np.maximum(means[white] - means[black], 1e-9)
    share = float(np.median((mean_of_fringes - means[black]) / span))
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
    """Exponent of which a sinusoid's mean lies at this share between black and white.

    The mean of ((1 + cos) / 2)^g is Gamma(g + 1/2) / (sqrt(pi) Gamma(g + 1)) (section 11 of
    docs/explanation/metrology.md); it falls with g.
    """
    shares = []
    for g in _EXPONENTS:
        gamma_ratio = math.exp(math.lgamma(g + 0.5) - math.lgamma(g + 1))
        shares.append(gamma_ratio / math.sqrt(math.pi))
    return float(np.interp(-share, -np.array(shares), _EXPONENTS))


def _find_losses(light: FloatArray, position: FloatArray) -> tuple[float, float]:
    """Losses to the edge and from side to side: a plane and a bowl fitted to the light."""
    x, y = position
    columns = np.stack([np.ones_like(x), x, y, x**2 + y**2])
    level, along_x, along_y, bowl = np.linalg.lstsq(columns.T, light, rcond=None)[0]
    level = max(float(level), 1e-9)
    edge_loss = -bowl / level
    side_loss = 2 * math.hypot(along_x, along_y) / level
    return float(edge_loss), float(side_loss)
