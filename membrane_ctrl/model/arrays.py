"""Types of arrays."""

from typing import Any

import numpy as np
from numpy import typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
ComplexArray = npt.NDArray[np.complex128]
AnyArray = npt.NDArray[Any]
Column = FloatArray  # of a table, or as long as one
Singles = npt.NDArray[np.float32]  # where memory counts
Image = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]  # one of a camera, or many
ArrayLike = npt.ArrayLike
