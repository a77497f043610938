"""The screen's face: its deviation from its plane, w(s_x, s_y), towards the mirror.

w = c (s_x^2 + s_y^2) + map(s_x, s_y): a bow, and a bicubic spline through the nodes of a measured
grid, counted along s_x x s_y. The spline is kept as its polynomial in each cell, sum of C[m, n]
v^m u^n with u and v from 0 to 1 across the cell, so that a loop needs one look-up and a Horner
scheme. Beyond the grid the height of its edge continues.
"""

import math
from typing import NamedTuple

import numpy as np

from membrane_ctrl.config.optics import HeightMapConfig, ScreenPoseConfig
from membrane_ctrl.metrology.numerics.compiled import compile_kernel, compile_step
from membrane_ctrl.model.arrays import FloatArray

BOW_RADIUS_MM = 200.0  # where `bow_mm` is counted: half the paper's pattern, rounded
_ORDER = 4  # coefficients of a cubic


class Face(NamedTuple):
    """A face; a named tuple, since compiled loops take one as it is.

    Attributes
    ----------
    bow_per_mm : float
        Coefficient c of the bow, 1/mm.
    cells_mm : (rows, columns, 4, 4) array
        Polynomials of the map's cells, along s_y and s_x; no cells: no map.
    low_mm : (2,) array
        First node along s_x and s_y.
    pitch_mm : (2,) array
        Distance of the nodes.
    """

    bow_per_mm: float
    cells_mm: FloatArray
    low_mm: FloatArray
    pitch_mm: FloatArray

    @classmethod
    def from_config(cls, screen: ScreenPoseConfig | None) -> "Face":
        """The face that a configuration describes; a plane for None."""
        bow_mm = 0.0
        if screen is not None:
            bow_mm = screen.bow_mm
        cells, low, pitch = _make_cells(None if screen is None else screen.height_map)
        return cls(bow_mm / BOW_RADIUS_MM**2, cells, low, pitch)

    @property
    def is_plane(self) -> bool:
        """Whether nothing stands off."""
        return bool(is_plane(self))

    def heights(self, screen_mm: FloatArray) -> FloatArray:
        """w, dw/ds_x and dw/ds_y, (3, ...), in mm and without unit, at screen coordinates (2, ...)
        in mm.
        """
        flat = np.ascontiguousarray(screen_mm.reshape(2, -1))
        out = np.empty((3, flat.shape[1]))
        _evaluate_heights(self, flat, out)
        return out.reshape(3, *screen_mm.shape[1:])


def _make_cells(config: HeightMapConfig | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cells, first nodes and distances of the nodes of a map."""
    if config is None:
        return np.zeros((0, 0, _ORDER, _ORDER)), np.zeros(2), np.ones(2)
    # The spline along s_y in each column of nodes: axes row, m, column; then of its coefficients
    # along s_x: axes column, n, row, m.
    along_y = _spline_coefficients(np.array(config.heights_mm), np.array(config.s_y_mm))
    both = _spline_coefficients(along_y.transpose(2, 0, 1), np.array(config.s_x_mm))
    cells = np.ascontiguousarray(both.transpose(2, 0, 3, 1))

    axes_mm = (config.s_x_mm, config.s_y_mm)
    low_mm = np.array([axis[0] for axis in axes_mm], float)
    pitch_mm = np.array([(axis[-1] - axis[0]) / (len(axis) - 1) for axis in axes_mm])
    return cells, low_mm, pitch_mm


def _spline_coefficients(values: FloatArray, nodes_mm: FloatArray) -> FloatArray:
    """Coefficients (cells, 4, ...) of the spline through values (nodes, ...), in powers of the
    share of a cell.
    """
    # Loads for a third of a second, and most screens have no map.
    from scipy.interpolate import make_interp_spline

    degree = min(_ORDER, nodes_mm.size) - 1
    spline = make_interp_spline(nodes_mm, values, k=degree)
    pitch = (nodes_mm[-1] - nodes_mm[0]) / (nodes_mm.size - 1)
    out = np.zeros((nodes_mm.size - 1, _ORDER, *values.shape[1:]))
    for m in range(degree + 1):
        out[:, m] = spline(nodes_mm[:-1], nu=m) * (pitch**m / math.factorial(m))
    return out


@compile_step
def is_plane(face):  # type: ignore[no-untyped-def]
    """Whether nothing stands off."""
    return face.bow_per_mm == 0 and face.cells_mm.shape[0] == 0


@compile_step
def face_height(face, a, b):  # type: ignore[no-untyped-def]
    """Deviation of the face from its plane at a point.

    Parameters
    ----------
    face : Face
    a, b : float
        s_x and s_y in mm.

    Returns
    -------
    w, wa, wb : float
        Height in mm, and its derivatives by s_x and s_y.
    """
    # The bow, with its slopes; then the map on top of it.
    w = face.bow_per_mm * (a * a + b * b)
    wa = 2 * face.bow_per_mm * a
    wb = 2 * face.bow_per_mm * b
    rows = face.cells_mm.shape[0]
    columns = face.cells_mm.shape[1]
    if rows > 0:
        u = (a - face.low_mm[0]) / face.pitch_mm[0]
        v = (b - face.low_mm[1]) / face.pitch_mm[1]
        # The cell, and the place in it; beyond the grid the height of its edge continues.
        inside_u = 0.0 <= u <= columns
        inside_v = 0.0 <= v <= rows
        u = min(max(u, 0.0), float(columns))
        v = min(max(v, 0.0), float(rows))
        column = min(int(u), columns - 1)
        row = min(int(v), rows - 1)
        u -= column
        v -= row

        # Height and slopes of its polynomial, by Horner's rule in v and u.
        h = 0.0
        hu = 0.0
        hv = 0.0
        for m in range(3, -1, -1):
            line = 0.0
            slope = 0.0
            for n in range(3, -1, -1):
                slope = slope * u + line
                line = line * u + face.cells_mm[row, column, m, n]
            hv = hv * v + h
            h = h * v + line
            hu = hu * v + slope
        w += h
        if inside_u:
            wa += hu / face.pitch_mm[0]
        if inside_v:
            wb += hv / face.pitch_mm[1]
    return w, wa, wb


@compile_kernel
def _evaluate_heights(face, screen_mm, out):  # type: ignore[no-untyped-def]
    for p in range(screen_mm.shape[1]):
        out[0, p], out[1, p], out[2, p] = face_height(face, screen_mm[0, p], screen_mm[1, p])
