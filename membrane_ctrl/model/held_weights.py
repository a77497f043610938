"""Weights of the scalar of the figure that a loop holds; computed in `metrology`, used in
`control`.
"""

from dataclasses import dataclass

from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class HeldWeights:
    """Weights (terms,) of the vertex and of the held scalar, in µm of sag per µm of each term."""

    vertex: FloatArray
    held: FloatArray
