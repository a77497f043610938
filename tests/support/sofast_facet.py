"""SOFAST's result for a measured facet, and its frames as screen points of pixels: the reference
for our fit.

Vectors and rotations keep SOFAST's names: `r_cam_optic` turns a vector from camera into optic
(facet) coordinates, `v_cam_optic_cam` leads from camera to optic, in camera coordinates.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial.transform import Rotation

from membrane_ctrl.measure.sofast_file import (
    MM_PER_M,
    SHIFTS_RAD,
    SofastMeasurement,
    open_hdf5,
    read_floats,
    read_item,
)
from membrane_ctrl.metrology.phase.phase_steps import compute_phasors
from membrane_ctrl.metrology.phase.temporal_unwrap import Unwrapped, unwrap_in_time
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.screen_face import Face
from tests.support.facet import Sight

FloatArray = NDArray[np.float64]

_FACET = "DataSofastCalculation/facet/facet_000"


# The screen as measured: where a fraction of it lies in mm, and what grey value it showed.
#
# Both are curves through calibration points; the other code uses only the curves.


class ScreenShape(Protocol):
    """Position on the screen plane of a fraction of the pattern."""

    def screen_mm(self, screens: FloatArray) -> FloatArray:
        """Screen coordinates (2, N) in mm of fractions (2, N); NaN off the screen."""
        ...


@dataclass(frozen=True)
class RectangularScreen:
    """A flat screen with square corners and an even raster; (0.5, 0.5) is its origin."""

    width_mm: float
    height_mm: float

    def screen_mm(self, screens: FloatArray) -> FloatArray:
        """Screen coordinates (2, N) in mm of fractions (2, N)."""
        size = np.array([[self.width_mm], [self.height_mm]])
        return np.asarray(np.where((screens >= 0) & (screens <= 1), (screens - 0.5) * size, np.nan))


@dataclass(frozen=True)
class MeasuredScreen:
    """A flat screen on which the raster was measured at points.

    Between the points it is linear on triangles: no assumption on the projector's lens, and the
    error is the sagitta of the distortion over one cell.
    """

    points_screens: FloatArray
    points_mm: FloatArray

    @cached_property
    def _interpolate(self) -> LinearNDInterpolator:
        return LinearNDInterpolator(self.points_screens.T, self.points_mm.T)

    def screen_mm(self, screens: FloatArray) -> FloatArray:
        """Screen coordinates (2, N) in mm of fractions (2, N); NaN outside the measured points."""
        return np.asarray(self._interpolate(screens.T).T)


@dataclass(frozen=True)
class DisplayResponse:
    """Grey value shown against grey value seen, `camera_adu` rising."""

    camera_adu: FloatArray
    display_levels: FloatArray

    def __post_init__(self) -> None:
        """Refuse a curve that cannot be read backwards."""
        if len(self.camera_adu) != len(self.display_levels) or not np.all(
            np.diff(self.camera_adu) > 0
        ):
            raise ValueError("display response: camera values must rise with every display value")

    def shown_levels(self, frames: FloatArray, black: FloatArray, white: FloatArray) -> FloatArray:
        """Levels the screen showed, (N, ...), from frames (N, ...), black and white (...) as seen.

        The curve is that of a bright pixel; each pixel's own gain and stray light are taken out by
        stretching its levels so that black and white are 0 and the curve's end. NaN where white is
        not above black.
        """
        low, high = self._levels(black), self._levels(white)
        span = np.where(high > low, high - low, np.nan)
        return np.asarray((self._levels(frames) - low) * (self.display_levels[-1] / span))

    def _levels(self, adu: FloatArray) -> FloatArray:
        return np.asarray(np.interp(adu, self.camera_adu, self.display_levels))


@dataclass(frozen=True)
class SofastCamera:
    """Intrinsics of a camera whose pixels may be oblong; `distortion` is OpenCV's k1, k2, p1, p2,
    k3.
    """

    focal_px: tuple[float, float]
    principal_px: tuple[float, float]
    distortion: tuple[float, ...]

    def square_rows(self, rows_px: FloatArray) -> FloatArray:
        """Rows of the same rays on square pixels of the size of the columns:
        what `Geometry` knows.
        """
        focal_x, focal_y = self.focal_px
        return self.principal_px[1] + (rows_px - self.principal_px[1]) * (focal_x / focal_y)


@dataclass(frozen=True)
class SofastResult:
    """SOFAST's result for the measurement: its pose of the facet, and figures to compare with.

    Attributes
    ----------
    mask : (H, W) bool array
        Pixels used, N of them, in reading order in the arrays below.
    r_cam_optic, r_cam_screen : (3, 3) arrays
    v_cam_optic_mm, v_cam_screen_mm : (3,) arrays
        In camera coordinates.
    rays : (3, N) array
        In facet coordinates, before the alignment.
    screens : (2, N) array
        Fractions of the screen.
    screen_points_mm : (3, N) array
        In facet coordinates, before the alignment.
    alignment : (3, 3) array
        Turn of camera and screen about the facet's vertex that SOFAST found.
    points_mm : (3, N) array
    slopes : (2, N) array
    coefficients : (6,) array
        1, x, x^2, y, x y, y^2 of the fitted height, in m.
    """

    mask: NDArray[np.bool_]
    r_cam_optic: FloatArray
    r_cam_screen: FloatArray
    v_cam_optic_mm: FloatArray
    v_cam_screen_mm: FloatArray
    rays: FloatArray
    screens: FloatArray
    screen_points_mm: FloatArray
    alignment: FloatArray
    points_mm: FloatArray
    slopes: FloatArray
    coefficients: FloatArray

    def geometry(self, camera: SofastCamera) -> Geometry:
        """Camera and screen in the facet's frame, before any alignment.

        A point p of the camera frame is R (p - v) in the facet's, R = `r_cam_optic`, v =
        `v_cam_optic`; the rows of the pose's rotation are the camera's axes there, the columns of
        R.
        """
        r_screen_optic = self.r_cam_optic @ self.r_cam_screen.T
        return Geometry(
            pinhole_mm=-self.r_cam_optic @ self.v_cam_optic_mm,
            rotation=self.r_cam_optic.T,
            focal_px=camera.focal_px[0],
            principal_px=camera.principal_px,
            distortion=camera.distortion,
            screen_origin_mm=self.r_cam_optic @ (self.v_cam_screen_mm - self.v_cam_optic_mm),
            screen_s_x=r_screen_optic[:, 0],
            screen_s_y=r_screen_optic[:, 1],
            face=Face.from_config(None),
        )


def read_camera(path: Path) -> SofastCamera:
    """Intrinsics. The matrix' last element is not used: downsampling divides it along with the
    others.
    """
    with open_hdf5(path) as file:
        matrix = read_floats(file, "Camera/intrinsic_mat")
        distortion = read_floats(file, "Camera/distortion_coef")
    return SofastCamera(
        (float(matrix[0, 0]), float(matrix[1, 1])),
        (float(matrix[0, 2]), float(matrix[1, 2])),
        tuple(distortion.ravel().tolist()),
    )


def read_screen(path: Path) -> ScreenShape:
    """The screen as a rectangle or as measured points, as the file says."""
    with open_hdf5(path) as file:
        model = read_item(file, "DisplayShape/screen_model").decode()
        if model == "rectangular2D":
            width_m, height_m = (
                float(read_floats(file, f"DisplayShape/screen_{axis}").item()) for axis in "xy"
            )
            return RectangularScreen(width_m * MM_PER_M, height_m * MM_PER_M)
        if model == "distorted2D":
            points_m = read_floats(file, "DisplayShape/xy_screen_coords")
            return MeasuredScreen(
                read_floats(file, "DisplayShape/xy_screen_fraction"), points_m * MM_PER_M
            )
    raise ValueError(
        f"{path}: DisplayShape/screen_model is {model!r}, known are rectangular2D and distorted2D"
    )


def read_response(path: Path) -> DisplayResponse:
    """Grey value shown against grey value seen."""
    with open_hdf5(path) as file:
        group = "ImageCalibration"
        return DisplayResponse(
            read_floats(file, f"{group}/camera_values"),
            read_floats(file, f"{group}/display_values"),
        )


def read_result(path: Path) -> SofastResult:
    """SOFAST's own result for a single facet."""
    with open_hdf5(path) as file:
        geometry = f"{_FACET}/CalculationDataGeometryFacet"
        pose = f"{geometry}/SpatialOrientation"
        slopes = f"{_FACET}/SlopeSolverData"
        r_cam_optic, r_cam_screen = (
            Rotation.from_rotvec(read_floats(file, f"{pose}/{name}").ravel()).as_matrix()
            for name in ("r_cam_optic", "r_cam_screen")
        )
        return SofastResult(
            mask=read_floats(
                file, f"{_FACET}/CalculationImageProcessingFacet/mask_processed"
            ).astype(bool),
            r_cam_optic=r_cam_optic,
            r_cam_screen=r_cam_screen,
            v_cam_optic_mm=read_floats(file, f"{pose}/v_cam_optic_cam").ravel() * MM_PER_M,
            v_cam_screen_mm=read_floats(file, f"{pose}/v_cam_screen_cam").ravel() * MM_PER_M,
            rays=read_floats(file, f"{geometry}/u_pixel_pointing_facet"),
            screens=read_floats(file, f"{geometry}/v_screen_points_fractional_screens"),
            screen_points_mm=read_floats(file, f"{geometry}/v_screen_points_facet") * MM_PER_M,
            alignment=read_floats(file, f"{slopes}/trans_alignment")[:3, :3],
            points_mm=read_floats(file, f"{slopes}/v_surf_points_facet") * MM_PER_M,
            slopes=read_floats(file, f"{slopes}/slopes_facet_xy"),
            coefficients=read_floats(file, f"{slopes}/surf_coefs_facet"),
        )


@dataclass(frozen=True)
class Decoded:
    """Screen positions of N pixels along both axes."""

    x: Unwrapped
    y: Unwrapped

    @property
    def screens(self) -> FloatArray:
        """Fractions of the screen, (2, N), in SOFAST's sense."""
        return np.stack([self.x.screens, 1 - self.y.screens])

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """Pixels whose frequencies agree on both axes."""
        return self.x.consistent & self.y.consistent


def wrapped_phases(
    measurement: SofastMeasurement, mask: NDArray[np.bool_], response: DisplayResponse | None
) -> tuple[FloatArray, FloatArray]:
    """Wrapped phases (F, N) along x and y of the pixels in `mask`; frames as seen if there is no
    response.
    """
    black, white = measurement.black[mask], measurement.white[mask]

    def phases(frames: FloatArray) -> FloatArray:
        seen = frames[..., mask]
        shown = seen if response is None else response.shown_levels(seen, black, white)
        return np.stack([np.angle(compute_phasors(steps, SHIFTS_RAD)) for steps in shown])

    return phases(measurement.frames_x), phases(measurement.frames_y)


def decode(
    measurement: SofastMeasurement, mask: NDArray[np.bool_], response: DisplayResponse | None
) -> Decoded:
    """Screen positions of the pixels in `mask`, in reading order."""
    along_x, along_y = wrapped_phases(measurement, mask, response)
    return Decoded(
        unwrap_in_time(along_x, measurement.periods_x),
        unwrap_in_time(along_y, measurement.periods_y),
    )


def sight(
    decoded: Decoded, mask: NDArray[np.bool_], camera: SofastCamera, screen: ScreenShape
) -> Sight:
    """Screen points of the pixels of `mask`, except where frequencies disagree or the screen is
    missed.
    """
    rows_px, columns_px = (index.astype(float) for index in np.nonzero(mask))
    screen_mm = screen.screen_mm(decoded.screens)
    good = decoded.consistent & np.isfinite(screen_mm).all(axis=0)
    return Sight(columns_px[good], camera.square_rows(rows_px[good]), screen_mm[:, good])
