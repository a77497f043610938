"""Motions of the bench between two sets, which a change of the figure contains.

A set is measured with the geometry of its bench. If camera, screen or lens move before the next
set, the change of the figure contains what the motion does to it. The ring's tilt shows such
motions (`motion_evidence`); slopes that no surface has are not compared. Hidden motions are assumed
to be within their allowances.
"""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.rays import bench_motions
from membrane_ctrl.metrology.uncertainty.motion_evidence import (
    MotionEffects,
    MotionFinding,
    MotionTest,
    ring_tilt,
)
from membrane_ctrl.metrology.uncertainty.tilt_causes import find_tilt_causes
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, traced_points
from membrane_ctrl.model.arrays import FloatArray

# A motion of 100 µm or 100 µrad: the fit is linear there
_AMOUNT = 100.0


@dataclass(frozen=True)
class PairMotion:
    """What motions after a set would do to the next figure.

    Attributes
    ----------
    effects : MotionEffects
    parameters_mm : (parameters,) array
        Of the set's surface.
    """

    effects: MotionEffects
    parameters_mm: FloatArray

    @classmethod
    def from_changes(cls, bench: TrialBench, changes: FloatArray) -> "PairMotion":
        """Make the effects of the motions of one set's bench.

        Parameters
        ----------
        bench : TrialBench
            n points of the set.
        changes : (components, 2, n) array
            As `motion_changes` returns them.

        Returns
        -------
        PairMotion

        Raises
        ------
        ArithmeticError
            A fit diverges.
        """
        nominal = bench.geometry()
        found = [bench.solve(nominal, _AMOUNT * change, linear=True) for change in changes]
        figure_mm = (np.stack(found, axis=1) - bench.surface.parameters[:, None]) / _AMOUNT
        none = np.zeros((bench_motions.COMPONENTS, 2, 0))
        return cls(MotionEffects(figure_mm, none), bench.surface.parameters)

    def find(self, earlier: "PairMotion", covariance_mm2: FloatArray) -> MotionFinding:
        """Return the motions of the bench since an earlier set, by the ring's tilt.

        Parameters
        ----------
        earlier : PairMotion
            Of the earlier set.
        covariance_mm2 : (parameters, parameters) array
            Of the change of the surface's parameters on a bench at rest.
        """
        ring = ring_tilt()
        test = MotionTest(self.effects, ring @ covariance_mm2 @ ring.T, None, None)
        moved_mm = self.parameters_mm - earlier.parameters_mm
        none = np.zeros(bench_motions.COMPONENTS)
        finding = test.find_motions(ring @ moved_mm, np.zeros(2), none)
        # The bar of the change is the wider of two. The worst body alone covers a knock along a
        # direction that hardly tilts the ring (a camera's yaw of 30 µrad); the weighted causes
        # cover two bodies that tilt it in opposite directions.
        causes = find_tilt_causes(
            self.effects.figure_mm, ring, ring @ moved_mm, ring @ covariance_mm2 @ ring.T
        )
        by_causes_mm2 = causes.knocked_mm2 + causes.allowed_mm2
        if np.trace(by_causes_mm2) <= np.trace(finding.covariance_mm2):
            return finding
        return replace(finding, found_mm2=causes.knocked_mm2, allowed_mm2=causes.allowed_mm2)


def motion_changes(bench: TrialBench) -> FloatArray:
    """Change (components, 2, n) of the screen points of a set by each motion of the bench, in mm
    per µm or µrad.
    """
    geometry = bench.geometry().geometry
    tracer, points = traced_points(bench, geometry)
    tracer.intersect(points, bench.surface, newton=3)
    return bench_motions.screen_changes(
        geometry, points.rays, points.t_mm, bench.surface, bench.vertex_z_mm
    )
