"""What a frame of crossed fringes must show: phases predicted from the surface, light predicted
from the reference.

A bin shows I = A + B_x cos(phi_x + d_x) + B_y cos(phi_y + d_y) + harmonics. Its phases are those
of the screen points that the surface sends its ray to, traced exactly, plus what the reference saw
beyond its own fit: averaging over the bin, and shape that the terms cannot represent. Light and
response of the panel are the reference's.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.tracking.bin_cells import Cells
from membrane_ctrl.model.arrays import FloatArray, IntArray, Singles

_STEP_MM = 0.01  # of a parameter, for the derivatives: their error is 1e-7 of them
RESPONSE_POWERS = (2, 3, 4, 5)


@dataclass(frozen=True)
class CrossedScene:
    """The bench of a frame of crossed fringes.

    It has n bins inside the analysis radius, in the order of their cells.

    Attributes
    ----------
    tracer : Tracer
        The bench, with the vertex of the reference.
    surface : Surface
        The reference's surface.
    bin_px : int
        Side of a bin.
    index : (n,) int array
        Numbers of the bins, row by row.
    row : (n,) int array
        Row of bins that each is in.
    cells : Cells
        Squares of bins over which slow changes are planes.
    points : Points
        The bins' rays; `t_mm` follows the surface that was traced last.
    beyond_mm : (2, n) array
        Screen points of the reference less the traced ones.
    light_adu : (3, n) array
        Mean level and swings of x and y.
    basis : (terms, n) array
        Zernike terms at the bins, for what changes smoothly.
    taper : (n,) array
        Weight, which fades to 0 where the bins end.
    edge : (n,) array
        The same, 0 for bins that changed between the last five steps.
    position_mm : (2, n) array
        The bins on the mirror.
    response : (4,) array
        Deviation of the panel's response from a straight line, sum c_k (v^k - v), k = 2..5; zeros
        if it is straight.
    rad_per_mm : float
        Phase of the fringes on the screen.
    half_side_mm : float
        Half the side of the pattern.
    """

    tracer: ray_tracing.Tracer
    surface: Surface
    bin_px: int
    index: IntArray
    row: IntArray
    cells: Cells
    points: ray_tracing.Points
    beyond_mm: FloatArray
    light_adu: FloatArray
    basis: Singles
    taper: Singles
    edge: Singles
    position_mm: FloatArray
    response: FloatArray
    rad_per_mm: float
    half_side_mm: float

    def phase_rad(self, shape: Surface) -> FloatArray:
        """Phases (2, n) of x and y that a surface shows; the pattern's low edge is at -pi.

        The ring does not move: a deeper bowl has its vertex lower.
        """
        lower_mm = shape.sag_mm - self.surface.sag_mm
        bench = ray_tracing.Tracer(
            self.tracer.geometry, shape.radius_mm, self.tracer.vertex_z_mm - lower_mm
        )
        bench.intersect(self.points, shape, newton=2)
        seen = bench.predict_screen(self.points, shape) + self.beyond_mm
        return (seen + self.half_side_mm) * self.rad_per_mm - math.pi

    def jacobian(self, shape: Surface) -> Singles:
        """Change (2, parameters, n) of the phases per mm of each parameter of the surface."""
        # Central differences.
        out = np.empty((2, PARAMETERS, self.index.size), np.float32)
        parameters = shape.parameters
        for k, change_mm in enumerate(np.eye(PARAMETERS) * _STEP_MM):
            above = Surface.from_parameters(parameters + change_mm, shape.radius_mm)
            below = Surface.from_parameters(parameters - change_mm, shape.radius_mm)
            difference_rad = self.phase_rad(above) - self.phase_rad(below)
            out[:, k] = difference_rad / (2 * _STEP_MM)
        return out

    def harmonics_adu(self, phase_rad: FloatArray) -> FloatArray:
        """Light (n,) at phases (2, n) beyond level and swings, by the panel's response."""
        v = 0.5 + 0.25 * np.cos(phase_rad).sum(axis=0)
        bent = self.response @ np.stack([v**k - v for k in RESPONSE_POWERS])
        return np.asarray(2 * self.light_adu[1:].sum(axis=0) * bent)
