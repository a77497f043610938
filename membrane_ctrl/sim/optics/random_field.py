"""Random fields that change slowly, such as brightness and warm air."""

import math

import cv2
import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_WAVES = 40  # a smooth field needs no more
_NODES_A_WAVE = 16


class RandomField:
    """A random field of unit RMS on a square: plane waves about `length_mm` long, each with a
    memory.
    """

    def __init__(
        self, length_mm: float, memory_s: float, half_side_mm: float, rng: np.random.Generator
    ) -> None:
        self._rng, self._memory_s = rng, memory_s
        count = max(8, math.ceil(2 * half_side_mm / length_mm * _NODES_A_WAVE))
        self._half_side_mm, self._per_mm = half_side_mm, (count - 1) / (2 * half_side_mm)
        along = np.linspace(-half_side_mm, half_side_mm, count)
        across, down = np.meshgrid(along, along)
        lengths_mm, turns = (
            length_mm * rng.lognormal(0.0, 0.3, _WAVES),
            rng.uniform(0.0, 2 * math.pi, _WAVES),
        )
        ways = [
            np.multiply.outer(2 * math.pi / lengths_mm * part, place)
            for part, place in ((np.cos(turns), across), (np.sin(turns), down))
        ]
        self._basis = np.concatenate([np.cos(sum(ways)), np.sin(sum(ways))]) / math.sqrt(_WAVES)
        self._amplitudes = rng.standard_normal(2 * _WAVES)
        self._time_s = -math.inf

    def evaluate_at(self, time_s: float, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """The field at places of the square; beyond it that of its edge."""
        if time_s > self._time_s:
            keep = math.exp(-(time_s - self._time_s) / self._memory_s)
            fresh = self._rng.standard_normal(2 * _WAVES)
            self._amplitudes = keep * self._amplitudes + math.sqrt(1.0 - keep * keep) * fresh
            self._time_s = time_s
        field = np.tensordot(self._amplitudes, self._basis, 1).astype(np.float32)
        column, row = (
            ((p + self._half_side_mm) * self._per_mm).astype(np.float32) for p in (x_mm, y_mm)
        )
        moved = cv2.remap(field, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(moved, dtype=float)
