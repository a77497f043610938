"""A geometry in a file: by hand, of another set, or the `geometry.toml` that `calibrate` writes.

The latter also gives the lens and the screen's pitch, if calibrated. Its `[calibration]` carries a
hash of its numbers, which results and runs name; a file with edited numbers is refused.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import tomli_w

from firmware_iface.settings import Section
from membrane_ctrl.config import toml_file
from membrane_ctrl.config.optics import Distortion
from membrane_ctrl.config.schema import CameraConfig, GeometryConfig, OpticsConfig
from membrane_ctrl.model import errors, geometry_hash

Table = TypeVar("Table", bound=Section)


class LensTable(Section):
    """`[camera]` of a calibrated geometry: the lens, and the camera it belongs to."""

    width_px: int
    height_px: int
    pixel_um: float
    focal_mm: float
    principal_px: tuple[float, float]
    distortion: Distortion = ()

    def apply_to_camera(self, camera: CameraConfig, where: Path) -> CameraConfig:
        """Return the camera with this calibrated lens.

        Parameters
        ----------
        camera : CameraConfig
            The camera of the frames.
        where : Path
            The geometry's file, for the message.

        Raises
        ------
        InputError
            Number or pitch of the pixels differ: the lens was calibrated on another camera.
        """
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
    """Origin of the geometry used for a result.

    Attributes
    ----------
    hash : str
        Hash of its numbers, from the file or from the set's own statement.
    file : str
        Path; empty for the set's own.
    calibrated_utc : str
        Date; empty if not calibrated.
    """

    hash: str
    file: str = ""
    calibrated_utc: str = ""

    def make_table(self) -> dict[str, str | None]:
        """The origin as a table for JSON."""
        return {
            "hash": self.hash,
            "file": self.file or None,
            "calibrated_utc": self.calibrated_utc or None,
        }


@dataclass(frozen=True)
class GeometryFile:
    """A geometry read from a file.

    Attributes
    ----------
    path : Path
    geometry : GeometryConfig
        Poses.
    lens : LensTable, optional
        None unless calibrated.
    pitch : PitchTable, optional
    calibration : CalibrationTable, optional
        None for a file written by hand.
    origin : GeometryOrigin
    text : str
        Content of the file, with the screen's height map included.
    """

    path: Path
    geometry: GeometryConfig
    lens: LensTable | None
    pitch: PitchTable | None
    calibration: CalibrationTable | None
    origin: GeometryOrigin
    text: str

    def apply_to_optics(self, optics: OpticsConfig) -> OpticsConfig:
        """The bench with this geometry instead of its own. Raises InputError for a different
        camera.
        """
        camera = optics.camera
        pattern = optics.pattern
        if self.lens is not None:
            camera = self.lens.apply_to_camera(camera, self.path)
        if self.pitch is not None:
            pattern = pattern.model_copy(update=self.pitch.model_dump())
        parts = {"geometry": self.geometry, "camera": camera, "pattern": pattern}
        return toml_file.parse_tables({**dict(optics), **parts}, OpticsConfig, str(self.path))


def read_geometry(path: str | Path) -> GeometryFile:
    """Read a geometry file: a `[geometry]` table as in `capture.toml`, its keys alone, or a file
    from `calibrate`.

    Raises InputError, also for calibrated numbers edited by hand.
    """
    path = Path(path)
    tables = toml_file.read_toml(path)
    calibrated = tables.get("schema") == geometry_hash.SCHEMA
    table = tables.get("geometry", tables)
    toml_file.with_height_map(table, path)

    # The hash of the numbers as written in the file.
    hashed = geometry_hash.hash_content(tables if "geometry" in tables else {"geometry": tables})
    text = tomli_w.dumps(tables)
    if isinstance(table, dict):
        toml_file.prune_unknown_keys(table, GeometryConfig)

    # The geometry; one measured by hand has nothing else.
    geometry = toml_file.parse_tables(table, GeometryConfig, str(path))
    if not calibrated:
        return GeometryFile(
            path, geometry, None, None, None, GeometryOrigin(hashed, str(path)), text
        )

    # A calibrated one must have the hash that its calibration states.
    calibration = _optional_table(tables, "calibration", CalibrationTable, path)
    if calibration is not None and calibration.hash != hashed:
        raise errors.InputError(
            f"{path}: calibration.hash = {calibration.hash}, but the numbers have {hashed}: "
            "they were edited "
            "after the calibration; calibrate again, or remove [calibration] and schema to "
            "use them anyway"
        )
    origin = GeometryOrigin(hashed, str(path), "" if calibration is None else calibration.date_utc)
    lens = _optional_table(tables, "camera", LensTable, path)
    pitch = _optional_table(tables, "pattern", PitchTable, path)
    return GeometryFile(path, geometry, lens, pitch, calibration, origin, text)


def list_numbers(optics: OpticsConfig) -> dict[str, dict[str, Any]]:
    """The numbers of a geometry, by their tables."""
    lens = {key: getattr(optics.camera, key) for key in ("focal_mm", "distortion")}
    return {
        "geometry": optics.geometry.model_dump(
            exclude_none=True, exclude={"reference_displacement_um"}
        ),
        "camera": {**lens, "principal_px": optics.camera.principal},
        "pattern": {"period_mm": optics.pattern.period_mm},
    }


def stated_origin(optics: OpticsConfig) -> GeometryOrigin:
    """Origin of a bench's own stated geometry."""
    return GeometryOrigin(geometry_hash.hash_content(list_numbers(optics)))


def _optional_table(
    tables: dict[str, Any], name: str, model: type[Table], path: Path
) -> Table | None:
    table = tables.get(name)
    if isinstance(table, dict):
        toml_file.prune_unknown_keys(table, model)
    if table is None:
        return None
    return toml_file.parse_tables(table, model, f"{path}: {name}")
