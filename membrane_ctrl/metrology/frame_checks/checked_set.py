"""A capture set whose frames have been checked and whose bins have been fitted."""

import math
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks import (
    band_removal,
    bin_view,
    film_image,
    frame_faults,
    image_lag,
    light_response,
    second_reflection,
)
from membrane_ctrl.metrology.frame_checks.phase_drift import PhaseShifts
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.reconstruction import tracked_points
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray
from membrane_ctrl.model.shape_estimate import Verdict


@dataclass(frozen=True)
class Anchor:
    """What a full set passes on to the fringes sets that refer to it.

    Attributes
    ----------
    phase_rad : (2, rows, columns) array
        Absolute phases of the bins; NaN where unknown.
    light : (rows, columns) array
        Light of the bins.
    image : FilmImage
        A second reflection of the screen that the full set shows.
    """

    phase_rad: FloatArray
    light: FloatArray
    image: film_image.FilmImage = film_image.NO_FILM_IMAGE


@dataclass(frozen=True)
class Checked:
    """A set whose frames have been checked and whose bins have been fitted.

    Attributes
    ----------
    stack : FrameStack
        The frames, swapped ones put back.
    binned : Binned
        The frames as means over bins.
    view : BinView
        Light, contrast and wrapped phase of the bins, from the usable frames.
    phase_rad : (2, rows, columns) array
        Absolute phases of the bins.
    near : (rows, columns) bool array
        Bins that may see the mirror.
    tracer : Tracer
        The bench, with the vertex where the laser saw it.
    state : TrackedPoints
        The bins' points with their surface.
    flags : tuple of Flag
        Frames that do not belong.
    film_um : (n,) array
        Displacement of the film during the used sinusoids, x and then y, as the fringes show it,
        about its mean.
    film_noise_um : float
        Standard uncertainty of each of these displacements.
    shifts : two PhaseShifts
        Shifts of the phases of the used sinusoids of x and of y beyond the film's motion.
    light_left : float
        RMS difference between the light of the used sinusoids and the light with which the phases
        were computed, relative.
    lag : ImageLag
        Share of the previous picture in each frame.
    second : SecondReflection
        A second image of the screen.
    response : LightResponse
        Response of panel and camera, and how even the light is.
    image : FilmImage
        A part of the mirror that shows the screen a second time.
    blur_px : float
        Sigma of the picture's blur.
    """

    stack: frame_stack.FrameStack
    binned: frame_stack.Binned
    view: bin_view.BinView
    phase_rad: FloatArray
    near: BoolArray
    tracer: ray_tracing.Tracer
    state: tracked_points.TrackedPoints
    flags: tuple[frame_faults.Flag, ...]
    film_um: FloatArray
    film_noise_um: float
    shifts: tuple[PhaseShifts, PhaseShifts]
    light_left: float
    lag: image_lag.ImageLag = field(default_factory=image_lag.ImageLag.unknown)
    second: second_reflection.SecondReflection = field(
        default_factory=second_reflection.SecondReflection.unknown
    )
    response: light_response.LightResponse = field(
        default_factory=light_response.LightResponse.unknown
    )
    image: film_image.FilmImage = film_image.NO_FILM_IMAGE
    blur_px: float = 0.0

    @property
    def verdict(self) -> tuple[Verdict, str]:
        """Verdict from the frames alone: "ok", or "degraded" with all reasons."""
        flagged = ""
        if self.flags:
            flagged = f"{len(self.flags)} frame(s) flagged; the figure excludes the affected data"
        doubts = (
            flagged,
            band_removal.describe_bands(self.stack.gain),
            image_lag.describe_image_lag(self.lag),
            second_reflection.describe_second_reflection(self.second),
            self.image.describe(),
            light_response.describe_response(self.response),
        )
        reason = "; ".join(doubt for doubt in doubts if doubt)
        if reason:
            return "degraded", reason
        return "ok", ""

    def places_px(self, index: IntArray) -> FloatArray:
        """Column and row (2, n) of bins' centres."""
        row, column = np.divmod(index, self.phase_rad.shape[2])
        return self.binned.bin_px * np.stack([column, row]) + (self.binned.bin_px - 1) / 2

    def make_anchor(self) -> Anchor:
        """For the sets that refer to this one."""
        return Anchor(self.phase_rad, self.view.light, self.image)


class RejectedSetError(bin_view.NoFigureError):
    """A set that gives no figure, with the bad frames.

    Parameters
    ----------
    reason : str
        For people.
    flags : tuple of Flag
        Frames that do not belong to the set.
    saturated_fraction : float
        Share of bins clipped at white; NaN if it was not determined.
    """

    def __init__(
        self,
        reason: str,
        flags: tuple[frame_faults.Flag, ...],
        saturated_fraction: float = math.nan,
    ) -> None:
        super().__init__(reason)
        self.flags = flags
        self.saturated_fraction = saturated_fraction


def vertex_z_mm(optics: OpticsConfig, displacement_um: float) -> float:
    """Position of the vertex at a displacement, with the ring at z = 0.

    A deeper bowl has a lower vertex: z = -(displacement - reference). Section 3 of
    docs/explanation/metrology.md.

    Parameters
    ----------
    optics : OpticsConfig
        Its geometry states the reference displacement.
    displacement_um : float
        Reading of the laser; NaN without one.

    Returns
    -------
    float
        In mm in world; 0 if the reference or the reading is unknown.
    """
    reference_um = optics.geometry.reference_displacement_um
    if reference_um is None or not math.isfinite(displacement_um):
        return 0.0
    return -(displacement_um - reference_um) * 1e-3
