"""Reader of SOFAST's HDF5 files: measurement, camera, screen, display response, results (OpenCSP, Sandia).

Lengths become mm here. Vectors and rotations keep SOFAST's names: `r_cam_optic` turns a vector from camera into
optic (facet) coordinates, `v_cam_optic_cam` leads from camera to optic, in camera coordinates.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from membrane_ctrl.metrology.facet.facet import Sight
from membrane_ctrl.metrology.frames.series_integrity import Series, Unwrapped, unwrap
from membrane_ctrl.metrology.optics import screen_face
from membrane_ctrl.metrology.optics.geometry import Geometry
from membrane_ctrl.metrology.phase import equal_shifts, phasors, wrapped_phase

FloatArray = NDArray[np.float64]

STEPS = 4  # SOFAST always takes four
_MM_PER_M = 1e3
_ELEMENTS_MAX = 100_000_000  # 24 frames of 4 megapixels; each takes eight bytes once it is read
_FACET = "DataSofastCalculation/facet/facet_000"


@dataclass(frozen=True)
class SofastMeasurement:
    """Frames of a measurement.

    Attributes
    ----------
    frames_x, frames_y : (F, 4, H, W) arrays
        Fringes that vary along the screen's x and y: frequency, step, row, column.
    periods_x, periods_y : (F,) arrays
        Periods a screen.
    black, white : (H, W) arrays
    distance_mm : float
        Facet's measure point to the screen's origin.
    """

    frames_x: FloatArray
    frames_y: FloatArray
    periods_x: FloatArray
    periods_y: FloatArray
    black: FloatArray
    white: FloatArray
    distance_mm: float


@dataclass(frozen=True)
class SofastCamera:
    """Intrinsics of a camera whose pixels may be oblong; `distortion` is OpenCV's k1, k2, p1, p2, k3."""

    focal_px: tuple[float, float]
    principal_px: tuple[float, float]
    distortion: tuple[float, ...]

    def square_rows(self, rows_px: FloatArray) -> FloatArray:
        """Rows of the same rays on square pixels of the size of the columns: what `Geometry` knows."""
        focal_x, focal_y = self.focal_px
        return self.principal_px[1] + (rows_px - self.principal_px[1]) * (focal_x / focal_y)


@dataclass(frozen=True)
class SofastResult:
    """What SOFAST made of the measurement: its pose of the facet, and results to compare with.

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

        A point p of the camera frame is R (p - v) in the facet's, R = `r_cam_optic`, v = `v_cam_optic`; the rows of
        the pose's rotation are the camera's axes there, the columns of R.
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
            face=screen_face.Face.of(None),
        )


def read_measurement(path: Path) -> SofastMeasurement:
    """Frames and what belongs to them. Raises ValueError, FileNotFoundError or ImportError in one line."""
    with _open(path) as file:
        group = "MeasurementSofastFringe"
        frames = np.moveaxis(_floats(file, f"{group}/fringe_images"), 2, 0)
        black, white = np.moveaxis(_floats(file, f"{group}/mask_images"), 2, 0)
        periods_x, periods_y = (_floats(file, f"{group}/fringe_periods_{axis}") for axis in "xy")
        distance_m = float(_floats(file, f"{group}/dist_optic_screen").item())
    count_y = STEPS * len(periods_y)
    if len(frames) != count_y + STEPS * len(periods_x):
        raise ValueError(
            f"{path}: {group}/fringe_images has {len(frames)} frames, not {STEPS} for each of "
            f"{len(periods_y)} + {len(periods_x)} frequencies"
        )
    size = black.shape
    return SofastMeasurement(
        frames_x=frames[count_y:].reshape(-1, STEPS, *size),
        frames_y=frames[:count_y].reshape(-1, STEPS, *size),  # y comes first in the file
        periods_x=periods_x,
        periods_y=periods_y,
        black=black,
        white=white,
        distance_mm=distance_m * _MM_PER_M,
    )


def read_camera(path: Path) -> SofastCamera:
    """Intrinsics. The matrix' last element is not used: downsampling divides it along with the others."""
    with _open(path) as file:
        matrix = _floats(file, "Camera/intrinsic_mat")
        distortion = _floats(file, "Camera/distortion_coef")
    return SofastCamera(
        (float(matrix[0, 0]), float(matrix[1, 1])),
        (float(matrix[0, 2]), float(matrix[1, 2])),
        tuple(distortion.ravel().tolist()),
    )


def read_screen(path: Path) -> screen_face.ScreenShape:
    """The screen as a rectangle or as measured points, as the file says."""
    with _open(path) as file:
        model = _item(file, "DisplayShape/screen_model").decode()
        if model == "rectangular2D":
            width_m, height_m = (float(_floats(file, f"DisplayShape/screen_{axis}").item()) for axis in "xy")
            return screen_face.RectangularScreen(width_m * _MM_PER_M, height_m * _MM_PER_M)
        if model == "distorted2D":
            points_m = _floats(file, "DisplayShape/xy_screen_coords")
            return screen_face.MeasuredScreen(_floats(file, "DisplayShape/xy_screen_fraction"), points_m * _MM_PER_M)
    raise ValueError(f"{path}: DisplayShape/screen_model is {model!r}, known are rectangular2D and distorted2D")


def read_response(path: Path) -> screen_face.DisplayResponse:
    """Grey value shown against grey value seen."""
    with _open(path) as file:
        group = "ImageCalibration"
        return screen_face.DisplayResponse(
            _floats(file, f"{group}/camera_values"), _floats(file, f"{group}/display_values")
        )


def read_result(path: Path) -> SofastResult:
    """SOFAST's own result for a single facet."""
    with _open(path) as file:
        geometry = f"{_FACET}/CalculationDataGeometryFacet"
        pose = f"{geometry}/SpatialOrientation"
        slopes = f"{_FACET}/SlopeSolverData"
        r_cam_optic, r_cam_screen = (
            Rotation.from_rotvec(_floats(file, f"{pose}/{name}").ravel()).as_matrix()
            for name in ("r_cam_optic", "r_cam_screen")
        )
        return SofastResult(
            mask=_floats(file, f"{_FACET}/CalculationImageProcessingFacet/mask_processed").astype(bool),
            r_cam_optic=r_cam_optic,
            r_cam_screen=r_cam_screen,
            v_cam_optic_mm=_floats(file, f"{pose}/v_cam_optic_cam").ravel() * _MM_PER_M,
            v_cam_screen_mm=_floats(file, f"{pose}/v_cam_screen_cam").ravel() * _MM_PER_M,
            rays=_floats(file, f"{geometry}/u_pixel_pointing_facet"),
            screens=_floats(file, f"{geometry}/v_screen_points_fractional_screens"),
            screen_points_mm=_floats(file, f"{geometry}/v_screen_points_facet") * _MM_PER_M,
            alignment=_floats(file, f"{slopes}/trans_alignment")[:3, :3],
            points_mm=_floats(file, f"{slopes}/v_surf_points_facet") * _MM_PER_M,
            slopes=_floats(file, f"{slopes}/slopes_facet_xy"),
            coefficients=_floats(file, f"{slopes}/surf_coefs_facet"),
        )


def _open(path: Path) -> Any:
    """The file as h5py gives it (untyped). h5py is an optional extra: only this reader needs it."""
    try:
        import h5py
    except ImportError:
        raise ImportError("SOFAST files need h5py: pip install 'membrane-ctrl[sofast]'") from None
    try:
        return h5py.File(path, "r")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except OSError as error:
        raise ValueError(f"{path}: not an HDF5 file ({error})") from None


def _item(file: Any, name: str) -> Any:
    """A data set of the file itself: none behind a link to another file, and none of more than is ever measured."""
    import h5py

    try:
        parts = name.split("/")
        for end in range(1, len(parts) + 1):
            link = file.get("/".join(parts[:end]), getlink=True)
            if link is None:
                raise ValueError(f"{file.filename}: {name} is missing")
            if not isinstance(link, h5py.HardLink):
                raise ValueError(f"{file.filename}: {name} is a link, and links are not followed here")
        found = file[name]
        if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external:
            raise ValueError(f"{file.filename}: {name} is not a data set of this file")
        if found.size is None or found.size > _ELEMENTS_MAX:
            raise ValueError(f"{file.filename}: {name} has {found.shape} elements, more than are read")
        return found[()]
    except (OSError, RuntimeError, KeyError, TypeError) as error:  # what a damaged file makes of HDF5
        raise ValueError(f"{file.filename}: {name} cannot be read ({error})") from None


def _floats(file: Any, name: str) -> FloatArray:
    try:
        return np.asarray(_item(file, name), float)
    except TypeError:
        raise ValueError(f"{file.filename}: {name} holds no numbers") from None


# From SOFAST frames to what each pixel sees on the screen.
#
# SOFAST shows cos(2 pi p s - k pi / 2), s from 1 at column 0 to 0 at the last column, and from 1 at row 0 to 0 at the
# last row; its screen coordinates have y the other way round, so the y fraction is 1 - s.


SHIFTS_RAD = -equal_shifts(STEPS)
_LIT_SHARE = 0.3  # of the swing of the bright pixels


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


def lit_pixels(measurement: SofastMeasurement) -> NDArray[np.bool_]:
    """Pixels (H, W) that see fringes: the median over the series of their swing, which no single frame can spoil."""
    series = (*measurement.frames_y, *measurement.frames_x)
    swing = np.median([np.abs(phasors(steps, SHIFTS_RAD)) for steps in series], axis=0)
    return np.asarray(swing > _LIT_SHARE * np.percentile(swing, 95))


def series_of(measurement: SofastMeasurement, mask: NDArray[np.bool_]) -> tuple[Series, Series]:
    """The axes of a measurement at the pixels in `mask`, in the order in which they were taken."""
    return (
        Series("y", measurement.frames_y[..., mask], measurement.periods_y, SHIFTS_RAD),
        Series("x", measurement.frames_x[..., mask], measurement.periods_x, SHIFTS_RAD),
    )


def wrapped_phases(
    measurement: SofastMeasurement, mask: NDArray[np.bool_], response: screen_face.DisplayResponse | None
) -> tuple[FloatArray, FloatArray]:
    """Wrapped phases (F, N) along x and y of the pixels in `mask`; frames as seen if there is no response."""
    black, white = measurement.black[mask], measurement.white[mask]

    def phases(frames: FloatArray) -> FloatArray:
        seen = frames[..., mask]
        shown = seen if response is None else response.shown_levels(seen, black, white)
        return np.stack([wrapped_phase(phasors(steps, SHIFTS_RAD)) for steps in shown])

    return phases(measurement.frames_x), phases(measurement.frames_y)


def decode(
    measurement: SofastMeasurement, mask: NDArray[np.bool_], response: screen_face.DisplayResponse | None
) -> Decoded:
    """Screen positions of the pixels in `mask`, in reading order."""
    along_x, along_y = wrapped_phases(measurement, mask, response)
    return Decoded(unwrap(along_x, measurement.periods_x), unwrap(along_y, measurement.periods_y))


def sight(decoded: Decoded, mask: NDArray[np.bool_], camera: SofastCamera, screen: screen_face.ScreenShape) -> Sight:
    """What the pixels of `mask` see, those left out whose frequencies disagree or that look past the screen."""
    rows_px, columns_px = (index.astype(float) for index in np.nonzero(mask))
    screen_mm = screen.screen_mm(decoded.screens)
    good = decoded.consistent & np.isfinite(screen_mm).all(axis=0)
    return Sight(columns_px[good], camera.square_rows(rows_px[good]), screen_mm[:, good])
