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
from membrane_ctrl.metrology.tracking.bin_cells import (
    Cells,
)
from membrane_ctrl.model.arrays import FloatArray, IntArray, Singles

_STEP_MM = 0.01  # of a parameter, for the derivatives: their error is 1e-7 of them
RESPONSE_POWERS = (2, 3, 4, 5)


@dataclass(frozen=True)
class CrossedScene:
    """The bench as a frame of crossed fringes sees it; n bins inside the analysis radius, cell by
    cell.
    """

    tracer: ray_tracing.Tracer  # the bench with the vertex of the reference
    surface: Surface  # of the reference
    bin_px: int
    index: IntArray  # (n,): bins, counted row by row
    row: IntArray  # (n,): of the picture, that each is in
    cells: Cells
    points: ray_tracing.Points  # their rays; `t_mm` moves with the surface that was traced last
    beyond_mm: FloatArray  # (2, n): screen points of the reference less the traced ones
    light_adu: FloatArray  # (3, n): mean level and swings of x and y
    basis: Singles  # (terms, n): Noll's order at the bins, for what changes smoothly
    taper: Singles  # (n,): weight, which fades to 0 where the bins end
    edge: Singles  # (n,): the same, 0 for bins that changed between the last five steps
    position_mm: FloatArray  # (2, n): on the mirror
    # (4,): deviation of the panel's response from a straight line, sum c_k (v^k - v), k = 2..5;
    # zeros if straight
    response: FloatArray
    rad_per_mm: float
    half_side_mm: float  # of the pattern

    def phase_rad(self, shape: Surface) -> FloatArray:
        """Phases (2, n) of x and y that a surface shows, counted from the low edge's -pi.

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
        out = np.empty((2, PARAMETERS, self.index.size), np.float32)
        for k, change_mm in enumerate(np.eye(PARAMETERS) * _STEP_MM):
            above, below = (
                self.phase_rad(
                    Surface.from_parameters(shape.parameters + sign * change_mm, shape.radius_mm)
                )
                for sign in (1, -1)
            )
            out[:, k] = (above - below) / (2 * _STEP_MM)
        return out

    def harmonics_adu(self, phase_rad: FloatArray) -> FloatArray:
        """Light (n,) at phases (2, n) beyond level and swings, by the panel's response."""
        v = 0.5 + 0.25 * np.cos(phase_rad).sum(axis=0)
        bent = self.response @ np.stack([v**k - v for k in RESPONSE_POWERS])
        return np.asarray(2 * self.light_adu[1:].sum(axis=0) * bent)
