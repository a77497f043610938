"""Random fields that change slowly, such as brightness and warm air."""

import math

import cv2
import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_WAVES = 40  # plane waves of a field; a smooth one needs no more
_NODES_A_WAVE = 16  # of the grid on which it is computed
_LENGTH_SCATTER = 0.3  # of the logarithm of the waves' lengths


class RandomField:
    """A random field of unit RMS on a square.

    It is a sum of plane waves in all directions, whose amplitudes are Ornstein-Uhlenbeck processes.

    Parameters
    ----------
    length_mm : float
        Typical length of the waves.
    memory_s : float
        Time after which an amplitude has lost all but 1 / e of its value.
    half_side_mm : float
        Half a side of the square.
    rng : Generator
        Source of the random numbers.
    """

    def __init__(
        self, length_mm: float, memory_s: float, half_side_mm: float, rng: np.random.Generator
    ) -> None:
        self._rng = rng
        self._memory_s = memory_s
        # A square grid of nodes.
        count = max(8, math.ceil(2 * half_side_mm / length_mm * _NODES_A_WAVE))
        self._half_side_mm = half_side_mm
        self._nodes_per_mm = (count - 1) / (2 * half_side_mm)
        axis_mm = np.linspace(-half_side_mm, half_side_mm, count)
        x_mm, y_mm = np.meshgrid(axis_mm, axis_mm)
        # Cosine and sine of each wave there.
        lengths_mm = length_mm * rng.lognormal(0.0, _LENGTH_SCATTER, _WAVES)
        directions_rad = rng.uniform(0.0, 2 * math.pi, _WAVES)
        rad_per_mm = 2 * math.pi / lengths_mm
        along_x_rad = np.multiply.outer(rad_per_mm * np.cos(directions_rad), x_mm)
        along_y_rad = np.multiply.outer(rad_per_mm * np.sin(directions_rad), y_mm)
        phase_rad = along_x_rad + along_y_rad
        waves = np.concatenate([np.cos(phase_rad), np.sin(phase_rad)])
        self._basis = waves / math.sqrt(_WAVES)
        self._amplitudes = rng.standard_normal(2 * _WAVES)
        self._time_s = -math.inf

    def evaluate_at(self, time_s: float, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Return the field at a time; beyond its square it is that of its edge.

        Parameters
        ----------
        time_s : float
            Must not fall: the field is a process that goes forward.
        x_mm, y_mm : (rows, columns) array
            Places, of equal shape.

        Returns
        -------
        (rows, columns) array
        """
        # Each amplitude is a first-order process of unit variance.
        if time_s > self._time_s:
            keep = math.exp(-(time_s - self._time_s) / self._memory_s)
            fresh = self._rng.standard_normal(2 * _WAVES)
            self._amplitudes = keep * self._amplitudes + math.sqrt(1.0 - keep * keep) * fresh
            self._time_s = time_s
        # The field on its nodes, interpolated.
        field = np.tensordot(self._amplitudes, self._basis, 1).astype(np.float32)
        column = ((x_mm + self._half_side_mm) * self._nodes_per_mm).astype(np.float32)
        row = ((y_mm + self._half_side_mm) * self._nodes_per_mm).astype(np.float32)
        values = cv2.remap(field, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(values, dtype=float)
