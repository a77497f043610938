"""Error of a correction for the film's motion, because the bench is not known exactly.

Phases are corrected by the change of the screen points per µm of displacement, which depends on the
geometry: a hand measurement leaves 10 % of a motion, a calibration 0.1 %.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, moves_mm
from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class SensitivityError:
    """Errors of the screen points' change per µm of displacement.

    Attributes
    ----------
    moved_mm : (2, n) array
        The change per µm at n points.
    errors_mm : (k, 2, n) array
        Its independent errors, of 1 sigma each; sets of a bench share them in this order.
    """

    moved_mm: FloatArray
    errors_mm: FloatArray

    @classmethod
    def from_spread(
        cls, bench: TrialBench, spread: GeometrySpread, laser_relative: float
    ) -> "SensitivityError":
        """Return the errors that the geometry's spread and the laser's scale cause.

        Parameters
        ----------
        bench : TrialBench
            n points of the set.
        spread : GeometrySpread
            Covariance of the geometry; one error for each column of its root.
        laser_relative : float
            Standard uncertainty of the laser's scale.
        """
        moved_mm = moves_mm(bench)
        errors_mm = [laser_relative * moved_mm]
        for change in spread.covariance_root().T:
            there = bench.geometry(spread.names, change)
            errors_mm.append(moves_mm(bench, there) - moved_mm)
        return cls(moved_mm, np.stack(errors_mm))

    @property
    def relative(self) -> float:
        """Their size, as a share of the change."""
        return math.sqrt(float(np.sum(self.errors_mm**2) / np.sum(self.moved_mm**2)))

    def source(self, bench: TrialBench, x_um: float, y_um: float) -> Source:
        """The row for motion from the x frames to the y frames that the phases are corrected for.

        Parameters
        ----------
        bench : TrialBench
            The n points of the set.
        x_um, y_um : float
            Mean displacement of the x and of the y frames.
        """
        nominal = bench.geometry()
        corrected_um = np.array([[x_um], [y_um]])
        solved = [
            bench.solve(nominal, error_mm * corrected_um, linear=True)
            for error_mm in self.errors_mm
        ]
        effects_mm = np.stack(solved, axis=1) - bench.surface.parameters[:, None]
        description = "correction for the film's motion from x to y, on a bench that is not exact"
        return Source("film_corrected", description, math.nan, effects_mm, common=False)
