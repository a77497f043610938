"""Readings of a sensor that may lose some of them."""

import math
from collections.abc import Iterable

import numpy as np

from membrane_ctrl.commissioning.guide.stage import StageFailedError

_GOOD_SHARE_LEAST = 0.5  # a sound laser loses 1 %; at half, aim, cable or rate are wrong


def select_good(values: Iterable[float], sensor: str) -> list[float]:
    """The readings that are there.

    Parameters
    ----------
    values : iterable of float
        NaN where the sensor had no reading.
    sensor : str
        For the message.

    Raises
    ------
    StageFailedError
        Fewer than half of them are there.
    """
    given = list(values)
    good = [value for value in given if math.isfinite(value)]
    if not good or len(good) < _GOOD_SHARE_LEAST * len(given):
        raise StageFailedError(
            f"the {sensor} gave {len(good)} readings in {len(given)} samples: look at its aim, its "
            "cable and its rate"
        )
    return good


def average_good(values: Iterable[float], sensor: str) -> float:
    """The mean of the readings that are there. Raises StageFailedError as `select_good`.

    Parameters
    ----------
    values : iterable of float
        In any unit, which the mean has, too; NaN where the sensor had no reading.
    sensor : str
        For the message.
    """
    return float(np.mean(select_good(values, sensor)))
