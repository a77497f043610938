"""The display's response, measured with a grey ramp, and the levels that make its light linear."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from firmware_iface.arrays import FloatArray

# a cubic between 17 points is off by < 0.2 %
RAMP_LEVELS = tuple(round(255 * step / 16) for step in range(17))
# Least share of the light between the end levels; less means that the ramp was not seen
_LEAST_SWING_ADU = 10.0
# A step back by more than this share is not noise: something moved, or the display adapts its light
_LARGEST_STEP_BACK = 0.02


@dataclass(frozen=True, slots=True)
class DisplayResponse:
    """Light against level."""

    levels: FloatArray  # (K,), rising, first 0 and last 255
    light: FloatArray  # (K,), 0..1, strictly rising

    @property
    def gamma(self) -> float:
        """Exponent of the power law that best fits the middle half of the ramp; for people."""
        middle = (self.light > 0.1) & (self.light < 0.9)
        x = np.log(self.levels[middle] / 255.0)
        y = np.log(self.light[middle])
        return float(np.sum(x * y) / np.sum(x * x))

    def find_levels(self, light: ArrayLike) -> NDArray[np.uint8]:
        """Levels that give this light (0..1), to the nearest of 256."""
        from scipy.interpolate import PchipInterpolator

        level = np.arange(256.0)
        curve = PchipInterpolator(self.levels, self.light)(level)  # monotone where the ramp is
        wanted = np.clip(np.asarray(light, np.float64), 0.0, 1.0)
        return np.asarray(np.rint(np.interp(wanted, curve, level)), np.uint8)


def make_linear_response() -> DisplayResponse:
    """A display whose light is proportional to its level."""
    return DisplayResponse(np.array([0.0, 255.0]), np.array([0.0, 1.0]))


def make_measured_response(levels: ArrayLike, seen_adu: ArrayLike) -> DisplayResponse:
    """Make the display's response from a ramp of grey levels.

    Parameters
    ----------
    levels : (K,) array
        Levels, rising from 0 to 255.
    seen_adu : (K,) array
        What the camera saw of each, unsaturated.

    Returns
    -------
    DisplayResponse

    Raises
    ------
    ValueError
        The camera saw no ramp, a falling or a saturated one; with the remedy.
    """
    shown = np.asarray(levels, np.float64)
    seen = np.asarray(seen_adu, np.float64)
    if (
        shown.shape != seen.shape
        or shown.size < 3
        or shown[0] != 0
        or shown[-1] != 255
        or np.any(np.diff(shown) <= 0)
    ):
        raise ValueError("a ramp has rising levels from 0 to 255, and one reading each")
    # The camera must see a ramp that rises and does not saturate.
    swing_adu = seen[-1] - seen[0]
    if not np.isfinite(seen).all() or swing_adu < _LEAST_SWING_ADU:
        raise ValueError(
            f"the camera sees no ramp ({swing_adu:.1f} counts from black to white); exposure, aim?"
        )
    light = (seen - seen[0]) / swing_adu
    if np.min(np.diff(light)) < -_LARGEST_STEP_BACK:
        raise ValueError(
            "the light falls where the level rises: switch off the display's dynamic contrast"
        )
    if np.count_nonzero(light > 0.995) > 2:
        raise ValueError("the ramp saturates; lower the camera's exposure_ms")
    # Noise may let it fall a little: an inverse needs a rising curve.
    rising = np.maximum.accumulate(light) + 1e-9 * np.arange(light.size)
    return DisplayResponse(shown, (rising - rising[0]) / (rising[-1] - rising[0]))
