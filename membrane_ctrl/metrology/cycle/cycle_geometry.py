"""How well a live bench's geometry is known, by each full cycle, as `measure` states it of a set.

What the stated spread explains of the slopes is computed once. Each full cycle then costs a
coarse map of the slopes that its fit leaves, and the rim in the light of its bins: some
milliseconds. Fringes-only cycles keep the statement.
"""

from dataclasses import replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Tracer
from membrane_ctrl.metrology.rays.rim_outline import Outline, find_outline
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction.bin_grid import BinGrid
from membrane_ctrl.metrology.reconstruction.tracked_points import TrackedPoints
from membrane_ctrl.metrology.reconstruction.zonal_map import integrate_residual, residual_grid
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread, KnownBy
from membrane_ctrl.metrology.uncertainty.geometry_statement import GeometryStatement
from membrane_ctrl.metrology.uncertainty.rim_check import measure_rim_misfit
from membrane_ctrl.metrology.uncertainty.slope_misfit import (
    SlopeMisfit,
    estimate_explained_urad,
    measure_curl_urad,
)
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, spread_evenly
from membrane_ctrl.model.arrays import FloatArray

_BENCH_POINTS = 1500  # of the bench whose inputs are disturbed
_SLOPE_POINTS = 20_000  # of the map of slopes: 16 in each of its patches


class CycleGeometry:
    """Judges the geometry by full cycles.

    Parameters
    ----------
    optics : OpticsConfig
        The bench as stated.
    grid : BinGrid
        Places of the bins.
    bin_px : int
        Their side.
    spread, known_by, source : GeometrySpread, KnownBy, str
        How well the geometry is known, what that rests on, and where it is stated.
    """

    def __init__(
        self,
        optics: OpticsConfig,
        grid: BinGrid,
        bin_px: int,
        spread: GeometrySpread,
        known_by: KnownBy,
        source: str,
    ) -> None:
        self._optics = optics
        self._spread = spread
        self._places_px = np.stack([grid.column_px, grid.row_px])
        self._known_by = known_by
        self._source = source
        self._explained_urad: float | None = None
        stated = Geometry.from_config(optics)
        # of a camera whose pixels are the bins: pixel centres are integers
        column, row = stated.principal_px
        middle = (bin_px - 1) / 2
        self._of_bins = replace(
            stated,
            focal_px=stated.focal_px / bin_px,
            principal_px=((column - middle) / bin_px, (row - middle) / bin_px),
        )

    def judge(
        self, tracer: Tracer, state: TrackedPoints, surface: Surface, light: FloatArray
    ) -> GeometryStatement | None:
        """State how well the geometry is known.

        Parameters
        ----------
        tracer : Tracer
            The bench with the vertex of the cycle.
        state : TrackedPoints
            The points of the cycle, on their surface.
        surface : Surface
            The fitted surface.
        light : (rows, columns) array
            Mean light of the sinusoids in each bin.

        Returns
        -------
        GeometryStatement or None
            None if the spread is so wide that no fit follows it.
        """
        bench = self._make_bench(tracer, state, surface)
        if self._explained_urad is None:
            try:
                self._explained_urad = estimate_explained_urad(bench, self._spread)
            except ArithmeticError:
                return None
        slopes = SlopeMisfit(self._measure_curl_urad(tracer, state, surface), self._explained_urad)
        outline = self._find_outline(tracer, surface, light)
        rim = None if outline is None else measure_rim_misfit(bench, self._spread, outline)
        return GeometryStatement.from_evidence(self._known_by, self._source, rim, slopes)

    def _make_bench(self, tracer: Tracer, state: TrackedPoints, surface: Surface) -> TrialBench:
        places_px = np.take(self._places_px, state.index, axis=1)
        exact = np.zeros((2, state.index.size))
        return TrialBench.from_points(
            self._optics, tracer, surface, state.points, places_px, exact, _BENCH_POINTS
        )

    def _measure_curl_urad(self, tracer: Tracer, state: TrackedPoints, surface: Surface) -> float:
        """Slopes without a surface that the fit of some points leaves."""
        places_px = np.take(self._places_px, state.index, axis=1)
        some = spread_evenly(places_px, self._optics.camera.width_px, _SLOPE_POINTS)
        points = state.points.subset(some)
        field = tracer.slope_field(points, surface)
        grid = residual_grid(field, points.weights, self._optics.mirror.analysis_radius_mm)
        return measure_curl_urad(grid, integrate_residual(grid))

    def _find_outline(self, tracer: Tracer, surface: Surface, light: FloatArray) -> Outline | None:
        rim_z_mm = tracer.vertex_z_mm + surface.sag_mm
        return find_outline(light, self._of_bins, self._optics.mirror.radius_mm, rim_z_mm)
