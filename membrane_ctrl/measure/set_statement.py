"""Two statements on a set, for every analysis that uses it: how good it is, and how well its
geometry is known.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from membrane_ctrl.geometry.file import GeometryFile
from membrane_ctrl.measure.measure import light_and_rim
from membrane_ctrl.measure.measurement import measure_set
from membrane_ctrl.measure.results import apply_doubts, error_bars
from membrane_ctrl.metrology.uncertainty.budget import Budget
from membrane_ctrl.metrology.uncertainty.geometry_statement import GeometryStatement
from membrane_ctrl.model import errors, shape_estimate


@dataclass(frozen=True)
class SetStatement:
    """What `measure` states of a set.

    Attributes
    ----------
    verdict : "ok" or "degraded"
        How good the set is.
    reason : str
        Why it is degraded; empty if it is not.
    geometry : GeometryStatement
        How well its geometry is known.
    budget : Budget
        Its error budget.
    """

    verdict: shape_estimate.Verdict
    reason: str
    geometry: GeometryStatement
    budget: Budget

    def table(self) -> dict[str, Any]:
        """The set's verdict, its reason and what is known of the geometry."""
        known = self.geometry.table()
        return {"verdict": self.verdict, "reason": self.reason, "geometry_known": known}


def state_set(folder: Path, given: GeometryFile | None, geometry: Path | None) -> SetStatement:
    """Measure a set and judge it as `measure` does.

    Parameters
    ----------
    folder : Path
        The set.
    given, geometry : GeometryFile, Path or None
        The geometry that replaces the set's own, and its file, which has the covariance.

    Raises
    ------
    InputError
        If the set, its reference or the covariance is invalid.
    RejectedError
        If the set gives no usable figure.
    """
    measured = measure_set(folder, given)
    bars = error_bars(measured, geometry, light_and_rim(measured)[1])
    judged = apply_doubts(measured, bars)
    if bars is None or judged.verdict == "rejected":
        raise errors.RejectedError(f"{folder}: rejected: {judged.reason}")
    return SetStatement(judged.verdict, judged.reason, bars.statement, bars.budget)
