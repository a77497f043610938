"""The tables of the optics: camera, screen, pattern, mirror, and where they are."""

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from firmware_iface.settings import Micrometres, Section
from membrane_ctrl.config.front_film import FrontFilmConfig

Length = Annotated[float, Field(ge=-1e6, le=1e6)]  # of whatever unit: a kilometre of mm
Vector3 = tuple[Length, Length, Length]
Sigma = Annotated[float, Field(ge=0, le=1e5)]  # of whatever unit; 0: exact
Axis = Annotated[tuple[Length, ...], Field(min_length=2, max_length=500)]

_DISTORTION_LENGTHS = (0, 4, 5, 8)
_EVEN = 1e-6  # of the node spacing: rounding of written decimals
# of the squared length, from rounding to five digits, and of the cosine
_UNIT = 1.1e-5
_SQUARE = 1e-6
Share = Annotated[float, Field(ge=0, le=0.5)]


def _check_distortion(numbers: tuple[float, ...]) -> tuple[float, ...]:
    """Raise ValueError for a number of coefficients that no lens model has."""
    if len(numbers) in _DISTORTION_LENGTHS:
        return numbers
    raise ValueError(
        f"{len(numbers)} coefficients; give none, 4 (k1, k2, p1, p2), 5 (and k3) or 8 (and k3, k4, "
        "k5, k6), with 0 for those that the lens does not need"
    )


Distortion = Annotated[tuple[Length, ...], AfterValidator(_check_distortion)]
"""Coefficients of a lens: OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]."""


class HeightMapConfig(Section):
    """Heights of the screen's face towards the mirror, interpolated by a bicubic spline through an
    even grid.

    `heights_mm[r][c]` belongs to `s_y_mm[r]` and `s_x_mm[c]`. With three nodes along an axis the
    spline is quadratic there, with two linear. In TOML, `file` may replace `heights_mm`: a text
    file of numbers, one row per line.
    """

    model_config = ConfigDict(json_schema_extra=lambda schema: _or_file(schema))

    s_x_mm: Axis
    """Columns of the grid along s_x, from O'. Set it to a grid that covers the pattern."""
    s_y_mm: Axis
    """Rows of the grid along s_y, from O'. Set it to a grid that covers the pattern."""
    heights_mm: tuple[Axis, ...]
    """Height at each node, a row for each `s_y_mm`. Set it from a measurement of the screen's face.
    """

    @model_validator(mode="after")
    def _check_grid(self) -> "HeightMapConfig":
        """Refuse a grid that is uneven or has another shape than its heights."""
        # Even steps: the interpolation finds the cell of a point by one division
        for name, axis in (("s_x_mm", self.s_x_mm), ("s_y_mm", self.s_y_mm)):
            steps = [b - a for a, b in pairwise(axis)]
            if not (steps[0] > 0 and max(steps) - min(steps) <= _EVEN * steps[0]):
                raise ValueError(f"{name} must rise in even steps")
        rows, columns = len(self.s_y_mm), len(self.s_x_mm)
        if len(self.heights_mm) != rows or any(len(row) != columns for row in self.heights_mm):
            shape = (
                f"{len(self.heights_mm)} rows of "
                f"{', '.join(sorted({str(len(row)) for row in self.heights_mm}))}"
            )
            raise ValueError(
                f"heights_mm has {shape} numbers; s_y_mm and s_x_mm require {rows} rows of "
                f"{columns}"
            )
        # no screen is that crooked: µm taken for mm?
        if max(abs(h) for row in self.heights_mm for h in row) > 100:
            raise ValueError("heights_mm has a height beyond 100 mm")
        return self


class ScreenPoseConfig(Section):
    """Any screen pose (O' in world, unit vectors `s_x` and `s_y`) and its face; both may be
    omitted.

    The face departs from the plane along s_x x s_y, towards the mirror, by the bow plus the height
    map.
    """

    origin_mm: Vector3 | None = None
    """O' in world. Set it from a calibration, together with `s_x` and `s_y`."""
    s_x: Vector3 | None = None
    """Direction of the screen's columns. Set it from a calibration."""
    s_y: Vector3 | None = None
    """Direction of the screen's rows, upwards. Set it from a calibration."""
    bow_mm: Annotated[float, Field(ge=-100, le=100)] = 0.0
    """Paraboloid of the face: its height 200 mm from O', towards the mirror. Change it to the
    calibrated one.
    """
    height_map: HeightMapConfig | None = None

    @property
    def pose(self) -> tuple[Vector3, Vector3, Vector3] | None:
        """Origin, s_x and s_y; None if the short form is used."""
        if self.origin_mm is None or self.s_x is None or self.s_y is None:
            return None
        return self.origin_mm, self.s_x, self.s_y

    @model_validator(mode="after")
    def _check_complete(self) -> "ScreenPoseConfig":
        given = [value is not None for value in (self.origin_mm, self.s_x, self.s_y)]
        if any(given) and not all(given):
            raise ValueError("origin_mm, s_x and s_y belong together: give all or none")
        if (
            self.s_x is not None
            and self.s_y is not None
            and not _is_orthonormal((self.s_x, self.s_y))
        ):
            raise ValueError("s_x and s_y are not two unit vectors at a right angle")
        return self

    def covers(self, half_side_mm: float) -> bool:
        """Whether the height map, if any, covers the pattern."""
        if self.height_map is None:
            return True
        axes = (self.height_map.s_x_mm, self.height_map.s_y_mm)
        return all(axis[0] <= -half_side_mm and axis[-1] >= half_side_mm for axis in axes)


class PatternConfig(Section):
    """Fringes on the screen (docs/reference/interfaces.md)."""

    steps: Annotated[int, Field(ge=3, le=64)] = 4
    """Phase steps per axis. Raise it against harmonics of the display; each step takes a frame."""
    periods: Annotated[int, Field(ge=1, le=8)] = 8
    """Fringes across the pattern. Change it with `period_mm`, so that the pattern fits the screen.
    """
    period_mm: Annotated[float, Field(ge=1, le=2000)] = 49.82
    """Width of a fringe on the screen. Change it so that the reflected pattern covers the mirror.
    """


class CameraPoseConfig(Section):
    """Any camera pose."""

    position_mm: Vector3
    """Pinhole in world. Set it from a calibration or a survey."""
    rotation: tuple[Vector3, Vector3, Vector3]
    """Rows: the camera's x right, y down, z forward in world. Set it from a calibration."""

    @model_validator(mode="after")
    def _is_rotation(self) -> "CameraPoseConfig":
        (a, b, c), (d, e, f), (g, h, i) = self.rotation
        determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        if not _is_orthonormal(self.rotation) or determinant < 0:
            raise ValueError(
                "rotation is not a rotation matrix (rows: right, down, forward in world)"
            )
        return self


class SigmasConfig(Section):
    """Standard uncertainties of what is not calibrated; the defaults are those of rulers and data
    sheets.

    Those of a, b and alpha are beside them. A calibrated geometry replaces those that its
    calibration freed.
    """

    screen_x_mm: Sigma = 1.0
    """Place of O' along s_x. Set it to that of your measurement."""
    screen_y_mm: Sigma = 1.0
    """Place of O' along s_y. Set it to that of your measurement."""
    screen_turn_x_deg: Sigma = 0.5
    """Turn of the screen about s_x. Set it to that of your measurement."""
    screen_turn_y_deg: Sigma = 0.5
    """Turn of the screen about s_y. Set it to that of your measurement."""
    screen_turn_z_deg: Sigma = 0.2
    """Turn of the screen in its plane. Set it to that of your measurement."""
    camera_yaw_deg: Sigma = 0.1
    """Turn of the camera to the right. Set it to that of your measurement."""
    camera_pitch_deg: Sigma = 0.1
    """Turn of the camera up. Set it to that of your measurement."""
    camera_roll_deg: Sigma = 0.1
    """Turn of the camera about its axis. Set it to that of your measurement."""
    focal_relative: Sigma = 0.01
    """Focal length, of its value: a data sheet's 1 %. Set it to the lens calibration's."""
    principal_mm: Sigma = 0.07
    """Principal point, along rows and along columns. Set it to the lens calibration's."""
    k1: Sigma = 0.02
    """Radial distortion with r^2. Set it to the lens calibration's."""
    k2: Sigma = 0.05
    """Radial distortion with r^4. Set it to the lens calibration's."""
    p1: Sigma = 1e-3
    """Decentring of the lens. Set it to the lens calibration's."""
    p2: Sigma = 1e-3
    """Decentring of the lens. Set it to the lens calibration's."""
    bow_mm: Sigma = 1.5
    """Bow of the screen, 200 mm from O'. Set it to that of your measurement."""
    pitch_relative: Sigma = 1e-3
    """Pixel pitch of the screen, of its value. Set it to that of your measurement."""
    laser_relative: Sigma = 1e-3
    """Scale of the laser, of its value. Set it from the laser's data sheet."""
    glass_mm: Sigma = 1.0
    """Thickness of the glass in front of the screen's pixels, which bends the rays. Lower it if b
    includes it.
    """
    air_k_per_m: Sigma = 0.5
    """Vertical gradient of the air's temperature, which bends the rays. Change it to the room's."""
    temperature_k: Sigma = 2.0
    """Change of temperature since the distances were measured: steel grows. Change it to the
    room's.
    """


class GeometryConfig(Section):
    """Camera and screen: the paper's a, b, alpha, or two general poses
    (docs/reference/interfaces.md).

    In either form, `screen` may give the departure of the screen's face from its plane.
    """

    a_mm: Annotated[float, Field(ge=100, le=100_000)] | None = None
    """Distance from the mirror's vertex to the camera's pinhole. Set it to the measured distance.
    """
    b_mm: Annotated[float, Field(ge=100, le=100_000)] | None = None
    """Distance from the mirror's vertex to O', the pattern's centre. Set it to the measured
    distance.
    """
    alpha_deg: Annotated[float, Field(gt=0, lt=180)] | None = None
    """Angle of either line of sight above the mirror's plane. Set it to the measured angle."""
    a_sigma_mm: Annotated[float, Field(ge=0, le=1e5)] | None = None
    """Standard uncertainty of `a_mm`. Set it to get the error bars of the height."""
    b_sigma_mm: Annotated[float, Field(ge=0, le=1e5)] | None = None
    """Standard uncertainty of `b_mm`. Set it to get the error bars of the height."""
    alpha_sigma_deg: Annotated[float, Field(ge=0, le=180)] | None = None
    """Standard uncertainty of `alpha_deg`. Set it to get the error bars of the height."""
    sigmas: SigmasConfig | None = None
    reference_displacement_um: Micrometres | None = None
    """Displacement when measured; the first frame's when absent. Set it if the mirror stood
    elsewhere then.
    """
    camera: CameraPoseConfig | None = None
    screen: ScreenPoseConfig | None = None

    @model_validator(mode="after")
    def _require_one_form(self) -> "GeometryConfig":
        short = (self.a_mm, self.b_mm, self.alpha_deg)
        general = (self.camera, None if self.screen is None else self.screen.pose)
        if all(v is not None for v in short) and all(v is None for v in general):
            return self
        if all(v is None for v in short) and all(v is not None for v in general):
            return self
        raise ValueError(
            "give either a_mm, b_mm and alpha_deg, or both [camera] and [screen] poses"
        )


class CameraConfig(Section):
    """Sensor and lens."""

    width_px: Annotated[int, Field(ge=8, le=20_000)] = 2448
    """Columns of the sensor. Set it to the camera's; another size is refused."""
    height_px: Annotated[int, Field(ge=8, le=20_000)] = 2048
    """Rows of the sensor. Set it to the camera's; another size is refused."""
    focal_mm: Annotated[float, Field(ge=1, le=1000)] = 16.0
    """Focal length. Set it to the lens's, or better the calibrated one."""
    pixel_um: Annotated[float, Field(ge=0.5, le=500)] = 3.45
    """Pitch of the pixels. Set it from the camera's data sheet."""
    principal_px: tuple[Length, Length] | None = None
    """Principal point (column, row); the sensor's middle when absent. Set it from
    `calibrate-camera`.
    """
    distortion: Distortion = ()
    """OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]. Set it from `calibrate-camera`."""
    noise_adu: Annotated[float, Field(ge=0, le=65_535)] = 0.4
    """Noise of a pixel, for the error bars. Change it to the measured one."""
    bits: Annotated[int, Field(ge=8, le=16)] = 8
    """Depth of a pixel. Change it with `devices.camera.pixel_format`."""

    @property
    def principal(self) -> tuple[float, float]:
        """Principal point as (column, row) in pixels."""
        return self.principal_px or ((self.width_px - 1) / 2, (self.height_px - 1) / 2)


class MirrorConfig(Section):
    """The film's rim and its measured part."""

    radius_mm: Annotated[float, Field(ge=10, le=50_000)] = 500.0
    """Radius of the ring, and of the Zernike terms. Set it to the mirror's."""
    analysis_radius_mm: Annotated[float, Field(ge=10, le=50_000)] = 475.0
    """Radius of the part that is measured. Lower it to leave out a bad edge."""
    sag_mm: Annotated[float, Field(ge=0.1, le=10_000)] = 37.1
    """Depth of the bowl at displacement 0. Set it for another film: laser and gauge are compared
    with it.
    """
    pressure_pa: Annotated[float, Field(ge=0, le=5000)] = 600.0
    """Gauge reading at displacement 0; 0: unknown. Set it for another film."""
    front_film: FrontFilmConfig | None = None

    wavelength_um: Annotated[float, Field(ge=0.01, le=1e6)] = 1000.0
    """Wavelength at which the report shows the image of a star. Change it to the one that the
    mirror is used at."""

    @model_validator(mode="after")
    def _check_radius(self) -> "MirrorConfig":
        if self.analysis_radius_mm > self.radius_mm:
            raise ValueError("analysis_radius_mm is larger than radius_mm")
        return self


class OpticsConfig(Section):
    """What deflectometry needs of the bench."""

    geometry: GeometryConfig = GeometryConfig(a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9)
    camera: CameraConfig = CameraConfig()
    pattern: PatternConfig = PatternConfig()
    mirror: MirrorConfig = MirrorConfig()
    geometry_file: Path | None = None
    """Geometry written by `calibrate`; replaces `geometry`. Set it after a calibration."""

    @model_validator(mode="after")
    def _map_covers_pattern(self) -> "OpticsConfig":
        half_mm = self.pattern.periods * self.pattern.period_mm / 2
        if self.geometry.screen is not None and not self.geometry.screen.covers(half_mm):
            raise ValueError(
                f"geometry.screen.height_map must reach over the pattern, {half_mm:g} mm "
                "from O' each way"
            )
        return self


class DisturbancesConfig(Section):
    """What disturbs the twin's pictures, and those of `simulate`: amplitudes; 0 switches an effect
    off.
    """

    brightness_fraction: Share = 0.0
    """Wandering of the screen's light, RMS, in waves of 75 mm. Raise it to see changing light or
    colour.
    """
    dimming_fraction_per_h: Share = 0.0
    """Share of the screen's light that is lost in an hour. Raise it to see an ageing backlight."""
    ambient_fraction: Share = 0.0
    """Room light on the mirror, of full scale, with a slope and a swing. Raise it to see an
    unshaded bench.
    """
    backlight_hz: Annotated[float, Field(ge=0, le=1e5)] = 0.0
    """Pulses of the screen's backlight; 0: steady. Set it to your screen's to see what an exposure
    of 20 ms sees.
    """
    sticking_fraction: Share = 0.0
    """Light lost where the panel has shown white for hours. Raise it to see a picture that sticks.
    """
    dust: Annotated[int, Field(ge=0, le=1000)] = 0
    """Spots on the mirror, elsewhere every 25 s. Raise it to see a dusty room."""
    rolling_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Time from the first to the last row of a picture; 0: a global shutter. Set it to your
    camera's.
    """
    camera_mount_k: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Swing of the temperature of the camera's mount, which grows by 60 µm/K. Raise it to see the
    sag follow it.
    """
    seeing_um: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Where rays meet the screen, wandering within half a second. Raise it to see warm air over the
    mirror.
    """


def _or_file(schema: dict[str, Any]) -> None:
    """Let `file` replace `heights_mm` in the JSON schema, as `toml_file` does when it reads."""
    schema["properties"]["file"] = {
        "type": "string",
        "description": "Text file with the rows of `heights_mm`. Set it for a large map.",
    }
    schema["required"].remove("heights_mm")


def _is_orthonormal(rows: tuple[Vector3, ...]) -> bool:
    """Whether the rows are unit vectors at right angles."""
    for row in rows:
        for other in rows:
            product = sum(x * y for x, y in zip(row, other, strict=True))
            is_same = row is other
            wanted, tolerance = (1.0, _UNIT) if is_same else (0.0, _SQUARE)
            if not abs(product - wanted) <= tolerance:
                return False
    return True
