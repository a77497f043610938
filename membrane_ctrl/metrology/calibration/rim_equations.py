"""The rim's equations in the calibration: it shows the size of everything that is seen.

Seen from the true bench, the radii at which the edges' rays meet the ring are the ring's: their
mean, their place and their ovalness are five observations. Their errors are the ring's own and the
edge's, which all edges share; the noise of single edges is negligible beside them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.calibration.rim_edges import EDGE_SIGMA_PX, RADIUS_SIGMA_MM, meet_rim
from membrane_ctrl.metrology.calibration.set_state import RING_PLACE
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model.arrays import FloatArray

_CENTRE_MM = 0.5  # the film's axis, by its clamp, against the edge that is seen
_OVAL_MM = 0.3  # a welded or turned ring of a metre, each of two directions
_STEP = 1e-3  # of a parameter's sigma by hand
_OF_SCREEN = {
    name for name in bench_parameters.NAMES if name.startswith(("b_", "screen_", "bow_", "pitch_"))
}


@dataclass(frozen=True)
class Rim:
    """Edges of the light at the ring."""

    edges_px: FloatArray  # (2, n): column and row
    radius_mm: float
    radius_sigma_mm: float = RADIUS_SIGMA_MM

    @classmethod
    def from_edges(
        cls, edges_px: Sequence[FloatArray], radius_mm: float, radius_sigma_mm: float
    ) -> "Rim | None":
        """Return the edges of several sets together.

        Parameters
        ----------
        edges_px : sequence of (2, n) arrays
            Columns and rows of the edge in each set.
        radius_mm, radius_sigma_mm : float
            Radius of the ring, with its standard uncertainty.

        Returns
        -------
        Rim or None
            None without any edges.
        """
        if edges_px:
            return cls(np.concatenate(edges_px, axis=1), radius_mm, radius_sigma_mm)
        return None

    def make_sums(self, stated: Geometry, common: FloatArray) -> FloatArray:
        """Make the normal equations of the five observations.

        Parameters
        ----------
        stated : Geometry
            The stated bench.
        common : (COMMON,) array
            The common unknowns, about which the observations are linearised.

        Returns
        -------
        (COMMON + 1, COMMON + 1) array
            Normal matrix, with the right-hand side as last column and row.
        """
        now = self._seen_mm(stated, common)
        columns = [np.zeros(now.size)] * common.size

        # Derivatives by the camera's pose and lens and by the ring, by differences; the screen does
        # not matter to the rim.
        names = bench_parameters.NAMES[: bench_poses.OPTICAL]
        of_camera = [k for k, name in enumerate(names) if name not in _OF_SCREEN]
        for k in (*of_camera, *range(RING_PLACE.start, RING_PLACE.stop)):
            unit = 1.0
            if k < len(bench_parameters.NAMES):
                unit = bench_parameters.ALL[k].sigma
            step = _STEP * unit
            there = common.copy()
            there[k] += step
            columns[k] = (self._seen_mm(stated, there) - now) / step

        # The observations are 0 within their sigmas.
        sigmas_mm = self._sigmas_mm(stated)
        rows = np.column_stack([*columns, -now]) / sigmas_mm[:, None]
        return np.asarray(rows.T @ rows)

    def _sigmas_mm(self, stated: Geometry) -> FloatArray:
        """Standard uncertainties (5,) of the observations: their own, and that of finding edges."""
        edge_mm = EDGE_SIGMA_PX * float(np.linalg.norm(stated.pinhole_mm)) / stated.focal_px
        own = np.array([self.radius_sigma_mm, _CENTRE_MM, _CENTRE_MM, _OVAL_MM, _OVAL_MM])
        return np.asarray(np.hypot(own, edge_mm))

    def _seen_mm(self, stated: Geometry, common: FloatArray) -> FloatArray:
        """Mean radius less the ring's, place (2,) and ovalness (2,) of the edges."""
        values = common[: len(bench_parameters.NAMES)]
        geometry = bench_poses.bench_at(stated, values).geometry
        ring = common[RING_PLACE]
        orders = np.arange(1, ring.size // 2 + 1)

        def height(x: FloatArray, y: FloatArray) -> FloatArray:
            """Height of the rim: a constant, and cosines and sines of the azimuth."""
            angles = np.outer(orders, np.arctan2(y, x))
            waves = np.concatenate([np.cos(angles), np.sin(angles)])
            return np.asarray(ring[0] + waves.T @ ring[1:])

        # Where the edges' rays meet that rim, and their distance from the circle.
        x, y = meet_rim(geometry, self.edges_px, height)
        theta = np.arctan2(y, x)

        # Harmonics 0 to 2 of this distance: size, place and ellipse.
        waves = [
            np.ones_like(theta),
            np.cos(theta),
            np.sin(theta),
            np.cos(2 * theta),
            np.sin(2 * theta),
        ]
        off_mm = np.hypot(x, y) - self.radius_mm
        return np.asarray(np.linalg.lstsq(np.stack(waves, axis=1), off_mm, rcond=None)[0])
