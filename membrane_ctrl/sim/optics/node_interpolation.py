"""Interpolates maps between the traced nodes of a picture.

Nodes are `step` pixels apart, one before the first pixel and two after the last. Between them a
cubic through four nodes (Lagrange) in each direction; with step 1 every pixel is a node and nothing
is interpolated.
"""

import numpy as np

from membrane_ctrl.model.arrays import FloatArray, Singles
from membrane_ctrl.model.kernel_cache import compile_loop


def node_positions(pixels: int, step: int) -> FloatArray:
    """Return the positions of the nodes along one side of the picture.

    Parameters
    ----------
    pixels : int
        Length of the side.
    step : int
        Pixels between nodes.

    Returns
    -------
    (nodes,) array
        In pixels; one before the first pixel and two after the last.
    """
    return np.asarray(np.arange(-1, -(-pixels // step) + 2) * step, dtype=np.float64)


def cubic_weights(step: int) -> FloatArray:
    """Weights (step, 4) of the nodes at -1, 0, 1, 2 for the places k / step, k = 0..step-1
    (Lagrange).
    """
    f = np.arange(step) / step
    return np.stack(
        [
            -f * (f - 1) * (f - 2) / 6,
            (f + 1) * (f - 1) * (f - 2) / 2,
            -(f + 1) * f * (f - 2) / 2,
            (f + 1) * f * (f - 1) / 6,
        ],
        axis=1,
    )


@compile_loop()
def interpolate_cubic(line: FloatArray, cell: int, w: FloatArray, k: int) -> float:
    """Value of a cubic through four nodes, at one of the places between the inner two.

    Parameters
    ----------
    line : (nodes,) array
        Values at the nodes.
    cell : int
        First of the four nodes.
    w : (places, 4) array
        Weight of each node at each place.
    k : int
        The place.
    """
    return float(
        w[k, 0] * line[cell]
        + w[k, 1] * line[cell + 1]
        + w[k, 2] * line[cell + 2]
        + w[k, 3] * line[cell + 3]
    )


@compile_loop()
def interpolate_row(
    nodes: FloatArray, k: int, node: int, w: FloatArray | Singles, line: FloatArray | Singles
) -> None:
    """Values of a map at one row of the picture, at the nodes' columns.

    Parameters
    ----------
    nodes : (maps, node rows, node columns) array
        Values at the nodes.
    k : int
        The map.
    node : int
        First of the four rows of nodes around the picture's row.
    w : (4,) array
        Weight of each of these.
    line : (node columns,) array
        Takes the values.
    """
    for c in range(nodes.shape[2]):
        line[c] = (
            w[0] * nodes[k, node, c]
            + w[1] * nodes[k, node + 1, c]
            + w[2] * nodes[k, node + 2, c]
            + w[3] * nodes[k, node + 3, c]
        )
