"""A geometry in a file: by hand, of another set, or the `geometry.toml` that `calibrate` writes.

The latter also gives the lens and the screen's pitch, if calibrated. Its `[calibration]` carries a
hash of its numbers, which results and runs name; a file with edited numbers is refused.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import tomli_w
from pydantic import Field

from firmware_iface.settings import Section
from membrane_ctrl.config import sight, toml_file
from membrane_ctrl.config.optics import CameraPoseConfig, ScreenPoseConfig
from membrane_ctrl.config.schema import CameraConfig, Config, GeometryConfig, OpticsConfig
from membrane_ctrl.metrology.rays.artefacts import Artefact
from membrane_ctrl.model import errors, files, plain_json
from membrane_ctrl.model.arrays import FloatArray

Table = TypeVar("Table", bound=Section)


class LensTable(Section):
    """`[camera]` of a calibrated geometry: the lens, and the camera it belongs to."""

    width_px: int
    height_px: int
    pixel_um: float
    focal_mm: float
    principal_px: tuple[float, float]
    distortion: tuple[float, ...] = ()

    def over(self, camera: CameraConfig, where: Path) -> CameraConfig:
        """The camera with this lens. Raises InputError, naming the file, for a different camera."""
        for key in ("width_px", "height_px", "pixel_um"):
            if getattr(self, key) != getattr(camera, key):
                raise errors.InputError(
                    f"{where}: camera.{key} = {getattr(self, key):g}, the frames' camera has "
                    f"{getattr(camera, key):g}; a calibrated lens is valid only for its own camera"
                )
        return camera.model_copy(update=self.model_dump())


class PitchTable(Section):
    """`[pattern]` of a calibrated geometry."""

    period_mm: float


class CalibrationTable(Section):
    """The fields read from `[calibration]`."""

    date_utc: str
    hash: str
    slope_residual_urad: float
    slope_noise_urad: float
    ring_um: tuple[float, ...]


@dataclass(frozen=True)
class GeometryOrigin:
    """Origin of the geometry used for a result."""

    hash: str  # hash of its numbers, from the file or from the set's own statement
    file: str = ""  # path; empty for the set's own
    calibrated_utc: str = ""  # date; empty if not calibrated

    def table(self) -> dict[str, str | None]:
        """The origin as a table for JSON."""
        return {
            "hash": self.hash,
            "file": self.file or None,
            "calibrated_utc": self.calibrated_utc or None,
        }


@dataclass(frozen=True)
class GeometryFile:
    """A geometry read from a file."""

    path: Path
    geometry: GeometryConfig  # poses
    lens: LensTable | None  # None unless calibrated
    pitch: PitchTable | None
    calibration: CalibrationTable | None  # None for a file written by hand
    origin: GeometryOrigin
    text: str  # content of the file, with the screen's height map included

    def over(self, optics: OpticsConfig) -> OpticsConfig:
        """The bench with this geometry instead of its own. Raises InputError for a different
        camera.
        """
        camera, pattern = optics.camera, optics.pattern
        if self.lens is not None:
            camera = self.lens.over(camera, self.path)
        if self.pitch is not None:
            pattern = pattern.model_copy(update=self.pitch.model_dump())
        parts = {"geometry": self.geometry, "camera": camera, "pattern": pattern}
        return toml_file.parse({**dict(optics), **parts}, OpticsConfig, str(self.path))


def read_geometry(path: str | Path) -> GeometryFile:
    """Read a geometry file: a `[geometry]` table as in `capture.toml`, its keys alone, or a file
    from `calibrate`.

    Raises InputError, also for calibrated numbers edited by hand.
    """
    path = Path(path)
    tables = toml_file.read_toml(path)
    calibrated = tables.get("schema") == plain_json.SCHEMA
    table = tables.get("geometry", tables)
    toml_file.with_height_map(table, path)
    hashed = plain_json.content_hash(tables if "geometry" in tables else {"geometry": tables})
    text = tomli_w.dumps(tables)
    if isinstance(table, dict):
        toml_file.prune(table, GeometryConfig)
    geometry = toml_file.parse(table, GeometryConfig, str(path))
    if not calibrated:
        return GeometryFile(
            path, geometry, None, None, None, GeometryOrigin(hashed, str(path)), text
        )
    calibration = _part(tables, "calibration", CalibrationTable, path)
    if calibration is not None and calibration.hash != hashed:
        raise errors.InputError(
            f"{path}: calibration.hash = {calibration.hash}, but the numbers have {hashed}: "
            "they were edited "
            "after the calibration; calibrate again, or remove [calibration] and schema to "
            "use them anyway"
        )
    origin = GeometryOrigin(hashed, str(path), "" if calibration is None else calibration.date_utc)
    lens, pitch = (
        _part(tables, "camera", LensTable, path),
        _part(tables, "pattern", PitchTable, path),
    )
    return GeometryFile(path, geometry, lens, pitch, calibration, origin, text)


def origin_of(optics: OpticsConfig) -> GeometryOrigin:
    """Origin of a bench's own stated geometry."""
    lens = {key: getattr(optics.camera, key) for key in ("focal_mm", "distortion")}
    tables = {
        "geometry": optics.geometry.model_dump(
            exclude_none=True, exclude={"reference_displacement_um"}
        ),
        "camera": {**lens, "principal_px": optics.camera.principal},
        "pattern": {"period_mm": optics.pattern.period_mm},
    }
    return GeometryOrigin(plain_json.content_hash(tables))


def _part(tables: dict[str, Any], name: str, model: type[Table], path: Path) -> Table | None:
    table = tables.get(name)
    if isinstance(table, dict):
        toml_file.prune(table, model)
    return None if table is None else toml_file.parse(table, model, f"{path}: {name}")


# The geometry that a run uses: that of `optics.geometry_file`, copied to the run's folder.

KEPT = "geometry.toml"  # in the run's folder


@dataclass(frozen=True)
class InForce:
    """The geometry used by the cycles of a run."""

    optics: OpticsConfig  # the configuration's, with the calibrated geometry if there is one
    origin: GeometryOrigin  # its origin
    calibration: CalibrationTable | None = None  # reference for drift
    text: str = ""  # content of the file; empty without one
    note: str = ""  # why the stated geometry is used although the configuration names a file

    def keep(self, run_dir: Path) -> None:
        """Copy the file to the run's folder, for its cycles and later reviews.
        Raises InputError.
        """
        if not self.text:
            return
        with errors.writing(run_dir / KEPT):
            files.write_text_atomic(run_dir / KEPT, self.text)


def geometry_in_force(config: Config) -> InForce:
    """Read the file named in the configuration.

    A missing file is not an error: the first calibration of a bench has to use the geometry
    measured by hand. The note says so.

    Raises InputError if the file exists but cannot be used.
    """
    there = _read(config.optics.geometry_file, config)
    if there.origin.file:
        require_plausible(there.optics, Path(there.origin.file))
    return there


def geometry_of_run(run_dir: Path | None, config: Config) -> InForce:
    """The geometry in force of a started run, from its folder."""
    return _read(None if run_dir is None else run_dir / KEPT, config)


def _read(path: Path | None, config: Config) -> InForce:
    optics = config.optics
    if path is None or not path.exists():
        wanted = optics.geometry_file
        note = (
            f"{wanted} does not exist yet: [optics.geometry] is used, as measured by hand"
            if wanted
            else ""
        )
        return InForce(optics, origin_of(optics), note=note)
    file = read_geometry(path)
    return InForce(file.over(optics), file.origin, file.calibration, file.text)


def require_plausible(optics: OpticsConfig, where: Path, depth_known: bool = True) -> None:
    """Raises InputError for a geometry from `where` with which less than half of the mirror can be
    measured.
    """
    found = sight.doubt(optics, depth_known)
    if found is not None and found.hopeless:
        raise errors.InputError(f"{where}: geometry.{found.key}: {found.why}; {found.remedy}")


# What a capture set says of its bench beyond the geometry.

_Length = Annotated[float, Field(gt=0, le=1e6)]


class ArtefactTable(Section):
    """The `[artefact]` table: what is seen instead of the film."""

    form: Literal["flat", "sphere", "screen"]
    curvature_radius_mm: _Length | None = None  # of a concave sphere
    curvature_radius_sigma_mm: _Length | None = None
    form_sigma_um: Annotated[float, Field(ge=1e-3, le=1e3)] = 0.1  # of each Zernike term
    # above the film's vertex at the reference displacement
    vertex_mm: Annotated[float, Field(ge=-1e3, le=1e3)] = 0.0
    vertex_sigma_mm: _Length = 1.0

    def artefact(self, radius_mm: float, path: Path) -> Artefact | Literal["screen"]:
        """The surface, over its disc, or the screen itself. Raises InputError."""
        if self.form == "screen":
            if len(self.model_fields_set) > 1:
                raise errors.InputError(
                    f"{path}: artefact: the screen itself needs nothing but its form"
                )
            return self.form
        curvature, spread = self.curvature_radius_mm, self.curvature_radius_sigma_mm
        for name, value in (
            ("curvature_radius_mm", curvature),
            ("curvature_radius_sigma_mm", spread),
        ):
            if (value is None) != (self.form == "flat"):
                says = "a sphere needs it" if value is None else "a flat has none"
                raise errors.InputError(f"{path}: artefact.{name}: {says}")
        known = {"form_sigma_mm": 1e-3 * self.form_sigma_um, "vertex_mm": self.vertex_mm}
        known |= {"vertex_sigma_mm": self.vertex_sigma_mm, "radius_mm": radius_mm}
        if curvature is None or spread is None:
            return Artefact(0.0, 0.0, **known)
        if curvature <= radius_mm:
            raise errors.InputError(
                f"{path}: artefact.curvature_radius_mm = {curvature:g} must exceed mirror.radius_mm"
            )
        return Artefact(1 / curvature, spread / curvature**2, **known)


class ScreenMovedTable(Section):
    """The `[screen_moved]` table: the screen stood elsewhere than `[geometry]` says."""

    shift_mm: tuple[float, float, float]  # along s_x, along s_y, towards the mirror, as measured
    shift_sigma_mm: _Length = 1.0  # of its length
    # of its direction; and how parallel the screen stayed
    turn_sigma_deg: Annotated[float, Field(gt=0, le=30)] = 0.5


def screen_elsewhere(
    geometry: GeometryConfig, shift_mm: tuple[float, float, float], turn: FloatArray | None = None
) -> GeometryConfig:
    """The bench with its screen shifted in its own axes, and then turned by a matrix (3, 3) from
    world to world.
    """
    pinhole, rotation, origin, s_x, s_y = sight.poses(geometry)
    origin = origin + np.array(shift_mm) @ np.stack([s_x, s_y, np.cross(s_x, s_y)])
    if turn is not None:
        s_x, s_y = turn @ s_x, turn @ s_y
    vectors = {"origin_mm": origin, "s_x": s_x, "s_y": s_y}
    screen = (geometry.screen or ScreenPoseConfig()).model_copy(
        update={name: tuple(value.tolist()) for name, value in vectors.items()}
    )
    camera = CameraPoseConfig(position_mm=pinhole.tolist(), rotation=rotation.tolist())
    short = dict.fromkeys(("a_mm", "b_mm", "alpha_deg"))
    return geometry.model_copy(update={**short, "camera": camera, "screen": screen})
