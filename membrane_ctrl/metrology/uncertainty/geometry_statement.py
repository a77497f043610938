"""How well the geometry of a measured set is known: a statement beside the set's own verdict.

The verdict states whether the frames gave a sound figure. The figure's absolute error is mostly
that of the geometry, which no frame shows, so it is stated separately: a sound set on a bench that
was measured with a ruler is `ok` and `uncalibrated`.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from membrane_ctrl.metrology.uncertainty.geometry_spread import KnownBy
from membrane_ctrl.metrology.uncertainty.rim_check import RimMisfit
from membrane_ctrl.metrology.uncertainty.slope_misfit import SlopeMisfit


class GeometryState(StrEnum):
    """How well a geometry is known."""

    CALIBRATED = "calibrated"  # it has a covariance from a calibration, and the rim agrees
    UNCALIBRATED = "uncalibrated"  # rulers or data sheets; the rim agrees with their sigmas
    CONTRADICTED = "contradicted"  # no stated uncertainty explains the rim or the slopes

    @property
    def next_step(self) -> str:
        """What to do, in words; empty: nothing."""
        if self is GeometryState.UNCALIBRATED:
            return (
                "`membrane-ctrl calibrate` makes the error bar of the geometry smaller; changes "
                "between sets of this bench do not need it"
            )
        if self is GeometryState.CONTRADICTED:
            return (
                "check the camera's pose, the lens and mirror.radius_mm, then run `membrane-ctrl "
                "calibrate`"
            )
        return ""


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
    def from_evidence(
        cls, known_by: KnownBy, source: str, rim: RimMisfit | None, slopes: SlopeMisfit
    ) -> "GeometryStatement":
        """Judge how well the geometry is known.

        Parameters
        ----------
        known_by : KnownBy
            What the stated uncertainty rests on.
        source : str
            The same for people, with the file.
        rim : RimMisfit or None
            The rim in the picture against its prediction.
        slopes : SlopeMisfit
            Slopes that belong to no surface.

        Returns
        -------
        GeometryStatement
            Contradicted by either, else calibrated or uncalibrated.
        """
        state = GeometryState.UNCALIBRATED
        if slopes.contradicts_bench or (rim is not None and rim.contradicts):
            state = GeometryState.CONTRADICTED
        elif known_by is KnownBy.CALIBRATION:
            state = GeometryState.CALIBRATED
        return cls(state, source, rim, slopes)

    @property
    def doubts(self) -> tuple[str, ...]:
        """What contradicts the geometry; empty if nothing does."""
        found = []
        if self.rim is not None and self.rim.contradicts:
            found.append(f"{self.rim.describe()}: {GeometryState.CONTRADICTED.next_step}")
        if self.slopes.contradicts and self.slopes.harmonics is not None:
            found.append(f"{self.slopes.describe()}: {self.slopes.harmonics.describe()}")
        elif self.slopes.contradicts:
            found.append(
                f"{self.slopes.describe()}: cause unknown; it looks like a camera, screen or lens "
                "that is not as stated, or like light from a second reflection"
            )
        return tuple(found)

    def describe(self) -> str:
        """State, source and the next step in words."""
        finding = f"{self.state}: {self.source}"
        if not self.state.next_step:
            return finding
        return f"{finding}; {self.state.next_step}"

    def table(self) -> dict[str, Any]:
        """The block `geometry_known` of `result.json`."""
        rim = self.rim
        return {
            "state": self.state.value,
            "source": self.source,
            "next_step": self.state.next_step,
            "rim_offset_mm": None if rim is None else rim.offset_mm,
            "rim_size_ratio": None if rim is None else rim.size_ratio,
            "rim_sigmas": None if rim is None else rim.sigmas,
            "slopes_of_no_surface_urad": self.slopes.seen_urad,
            "slopes_explained_urad": self.slopes.explained_urad,
        }
