"""How well the geometry of a measured set is known: a statement beside the set's own verdict.

The verdict says whether the frames gave a sound figure. The figure's absolute error is mostly the
geometry's, which no frame shows, so it is stated apart: a sound set on a bench that was measured
with a ruler is `ok` and `uncalibrated`.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from membrane_ctrl.geometry.spread_file import KnownBy
from membrane_ctrl.metrology.uncertainty.rim_check import RimMisfit
from membrane_ctrl.metrology.uncertainty.slope_misfit import SlopeMisfit


class GeometryState(StrEnum):
    """How well a geometry is known."""

    CALIBRATED = "calibrated"  # it has a covariance from a calibration, and the rim agrees
    UNCALIBRATED = "uncalibrated"  # rulers or data sheets; the rim agrees with their sigmas
    CONTRADICTED = "contradicted"  # rim or slopes are what no stated uncertainty explains


_NEXT_STEP = {
    GeometryState.CALIBRATED: "",
    GeometryState.UNCALIBRATED: "`membrane-ctrl calibrate` makes the error bar of the geometry "
    "smaller; changes between sets of this bench do not need it",
    GeometryState.CONTRADICTED: "check the camera's pose, the lens and mirror.radius_mm, then run "
    "`membrane-ctrl calibrate`",
}


@dataclass(frozen=True)
class GeometryStatement:
    """How well the geometry of a set is known.

    Attributes
    ----------
    state : GeometryState
        The finding.
    source : str
        Where its uncertainty is from.
    rim : RimMisfit or None
        The rim against the prediction; None if the picture does not show it.
    slopes : SlopeMisfit
        Slopes that belong to no surface.
    """

    state: GeometryState
    source: str
    rim: RimMisfit | None
    slopes: SlopeMisfit

    @classmethod
    def of(
        cls, known_by: KnownBy, source: str, rim: RimMisfit | None, slopes: SlopeMisfit
    ) -> "GeometryStatement":
        """Judge by what the uncertainty rests on, by the rim and by the slopes."""
        state = GeometryState.UNCALIBRATED
        if slopes.contradicts or (rim is not None and rim.contradicts):
            state = GeometryState.CONTRADICTED
        elif known_by is KnownBy.CALIBRATION:
            state = GeometryState.CALIBRATED
        return cls(state, source, rim, slopes)

    @property
    def doubts(self) -> tuple[str, ...]:
        """What it says against the figure; empty unless it is contradicted."""
        found = []
        if self.rim is not None and self.rim.contradicts:
            found.append(f"{self.rim.describe()}: {_NEXT_STEP[GeometryState.CONTRADICTED]}")
        if self.slopes.contradicts:
            found.append(
                f"{self.slopes.describe()}: cause unknown; it looks like a camera, screen or lens "
                "that is not as stated, or like light from a second reflection"
            )
        return tuple(found)

    def describe(self) -> str:
        """State, source and the next step in words."""
        next_step = _NEXT_STEP[self.state]
        return f"{self.state}: {self.source}" + (f"; {next_step}" if next_step else "")

    def table(self) -> dict[str, Any]:
        """The block `geometry_known` of `result.json`."""
        rim = self.rim
        return {
            "state": self.state.value,
            "source": self.source,
            "next_step": _NEXT_STEP[self.state],
            "rim_offset_mm": None if rim is None else rim.offset_mm,
            "rim_size_ratio": None if rim is None else rim.size_ratio,
            "rim_sigmas": None if rim is None else rim.sigmas,
            "slopes_of_no_surface_urad": self.slopes.seen_urad,
            "slopes_explained_urad": self.slopes.explained_urad,
        }
