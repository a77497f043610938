"""Whether camera, screen, lens or mirror have moved since the reference of the live cycles.

As in tracking (`tracking.bench_watch`), a cycle is compared with the signatures of all small
motions: by the ring's tilt, and by the phases that no surface explains, both since the reference
cycle.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.numerics.grouped_sums import sum_by_group
from membrane_ctrl.metrology.rays import bench_motions, ray_tracing
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.uncertainty.motion_evidence import (
    MotionEffects,
    MotionFinding,
    MotionTest,
    SlopeEvidence,
    ring_tilt,
    ring_tilt_urad,
)
from membrane_ctrl.model.arrays import FloatArray, IntArray

_STEP_MM = 0.01  # of a parameter, for the derivatives
_SQUARES = 14  # along the diameter, whose errors count as independent


@dataclass(frozen=True)
class CycleMotion:
    """Signatures at some points of the reference cycle, in mm on the screen.

    Attributes
    ----------
    effects : MotionEffects
    surface : Surface
        Of the reference.
    covariance_mm2 : (parameters, parameters) array
        Of its parameters.
    index : (n,) array
        Bins of the points, ascending.
    square : (n,) array
        Square of the mirror that each point is in.
    changed_mm : (2, n) array
        As in `find`, of the reference.
    """

    effects: MotionEffects
    surface: Surface
    covariance_mm2: FloatArray
    index: IntArray
    square: IntArray
    changed_mm: FloatArray

    @classmethod
    def from_reference(
        cls,
        tracer: ray_tracing.Tracer,
        points: ray_tracing.Points,
        index: IntArray,
        surface: Surface,
        covariance_mm2: FloatArray,
        changed_mm: FloatArray,
    ) -> "CycleMotion":
        """Compute the signatures of all motions at some points of the reference cycle.

        Section 7 of docs/explanation/tracking.md.

        Parameters
        ----------
        tracer : Tracer
            The bench of the reference.
        points : Points
            They stand on the reference's surface.
        index : (n,) array
            Their bins, in any order.
        surface : Surface
            Of the reference.
        covariance_mm2 : (parameters, parameters) array
            Of its parameters.
        changed_mm : (2, n) array
            As in `find`, of the reference.

        Returns
        -------
        CycleMotion
        """
        order = np.argsort(index)
        points, index = points.subset(order), index[order]

        # Effect of each motion of the bench on the screen points.
        changes = bench_motions.screen_changes(
            tracer.geometry, points.rays, points.t_mm, surface, tracer.vertex_z_mm
        )

        # Effect of each parameter of the surface, by central differences.
        jacobian = np.empty((2, PARAMETERS, index.size))
        for k, step in enumerate(_STEP_MM * np.eye(PARAMETERS)):
            seen = []
            for sign in (1, -1):
                shape = Surface.from_parameters(surface.parameters + sign * step, surface.radius_mm)
                tracer.intersect(points, shape, newton=2)
                seen.append(tracer.predict_screen(points, shape))
            jacobian[:, k] = (seen[0] - seen[1]) / (2 * _STEP_MM)
        tracer.intersect(points, surface, newton=2)

        # The square of the mirror in which each bin is.
        place = tracer.position_mm(points) / surface.radius_mm
        column, row = np.floor((place + 1) / 2 * _SQUARES).astype(int)
        effects = MotionEffects.from_changes(changes, jacobian, np.ones((2, index.size)))
        square = (row + 1) * (_SQUARES + 2) + column + 1
        return cls(effects, surface, covariance_mm2, index, square, changed_mm[:, order])

    def find(
        self,
        surface: Surface,
        index: IntArray,
        changed_mm: FloatArray,
        covariance_mm2: FloatArray,
    ) -> MotionFinding:
        """The motions that explain a later cycle.

        Parameters
        ----------
        surface : Surface
            Of the cycle.
        index : (n,) array
            Bins at which the next is known.
        changed_mm : (2, n) array
            Screen points that no surface explains, less those of a common cycle; NaN where unknown.
        covariance_mm2 : (parameters, parameters) array
            Of the cycle's parameters.
        """
        # The bins that both cycles have, and by how much their screen points changed.
        place = np.minimum(np.searchsorted(self.index, index), self.index.size - 1)
        changed_mm = changed_mm - np.take(self.changed_mm, place, axis=1)
        known = np.isfinite(changed_mm).all(axis=0) & (self.index[place] == index)
        place = place[known]

        # Sums over the squares: independent errors of each show what scatter alone gives.
        left = self.effects.left[:, :, place]
        parts = np.einsum("kan,an->kn", left, changed_mm[:, known])
        squares = sum_by_group(self.square[place], parts, (_SQUARES + 2) ** 2)
        flat = left.reshape(len(left), -1)

        # The test of each motion, with the tilt of the ring, which the mirror's own change also
        # shows.
        ring = ring_tilt()
        test = MotionTest(
            self.effects,
            ring @ (covariance_mm2 + self.covariance_mm2) @ ring.T,
            SlopeEvidence(squares @ squares.T, flat @ flat.T),
            None,
        )
        moved_mm = surface.parameters - self.surface.parameters
        return test.find_motions(ring @ moved_mm, np.zeros(2), parts.sum(axis=1))

    def tilt_urad(self, surface: Surface) -> float:
        """Tilt of the ring since the reference, in µrad."""
        return ring_tilt_urad(self.surface, surface)
