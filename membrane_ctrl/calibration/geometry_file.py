"""A geometry in a file: by hand, of another set, or the `geometry.toml` that `calibrate` writes.

Of the last also the lens and the screen's pitch count, if they were calibrated. Its `[calibration]` carries a hash of
its numbers, which results and runs name; a file whose numbers are no longer those is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import tomli_w

from membrane_ctrl.config import CameraConfig, GeometryConfig, OpticsConfig, Section
from membrane_ctrl.config_file import parse, prune, read_toml, with_height_map
from membrane_ctrl.errors import InputError
from membrane_ctrl.metrology.calibrate.content_hash import SCHEMA, content_hash

Table = TypeVar("Table", bound=Section)


class LensTable(Section):
    """`[camera]` of a calibrated geometry: the lens, and the camera that it belongs to."""

    width_px: int
    height_px: int
    pixel_um: float
    focal_mm: float
    principal_px: tuple[float, float]
    distortion: tuple[float, ...] = ()

    def over(self, camera: CameraConfig, where: Path) -> CameraConfig:
        """The camera with this lens; raises InputError, naming the file, if it is another camera."""
        for key in ("width_px", "height_px", "pixel_um"):
            if getattr(self, key) != getattr(camera, key):
                raise InputError(
                    f"{where}: camera.{key} = {getattr(self, key):g}, the frames' camera has "
                    f"{getattr(camera, key):g}; a calibrated lens is good for its own camera alone"
                )
        return camera.model_copy(update=self.model_dump())


class PitchTable(Section):
    """`[pattern]` of a calibrated geometry."""

    period_mm: float


class CalibrationTable(Section):
    """What is read of `[calibration]`."""

    date_utc: str
    hash: str
    slope_residual_urad: float
    slope_noise_urad: float
    ring_um: tuple[float, ...]


@dataclass(frozen=True)
class GeometryOrigin:
    """Which geometry a result was made with.

    Attributes
    ----------
    hash : str
        Of its numbers: that of the file, or of what the set itself states.
    file : str
        Where it was read; empty for the set's own.
    calibrated_utc : str
        When; empty if it is not a calibrated one.
    """

    hash: str
    file: str = ""
    calibrated_utc: str = ""

    def table(self) -> dict[str, str | None]:
        """For JSON."""
        return {"hash": self.hash, "file": self.file or None, "calibrated_utc": self.calibrated_utc or None}


@dataclass(frozen=True)
class GeometryFile:
    """A geometry that was read.

    Attributes
    ----------
    path : Path
        The file.
    geometry : GeometryConfig
        Poses.
    lens, pitch : LensTable, PitchTable or None
        If they were calibrated.
    calibration : CalibrationTable or None
        None for what was written by hand.
    text : str
        All that the file says, the screen's height map in it and not beside it.
    """

    path: Path
    geometry: GeometryConfig
    lens: LensTable | None
    pitch: PitchTable | None
    calibration: CalibrationTable | None
    origin: GeometryOrigin
    text: str

    def over(self, optics: OpticsConfig) -> OpticsConfig:
        """The bench with this geometry instead of its own. Raises InputError if it is of another camera."""
        camera, pattern = optics.camera, optics.pattern
        if self.lens is not None:
            camera = self.lens.over(camera, self.path)
        if self.pitch is not None:
            pattern = pattern.model_copy(update=self.pitch.model_dump())
        parts = {"geometry": self.geometry, "camera": camera, "pattern": pattern}
        return parse({**dict(optics), **parts}, OpticsConfig, str(self.path))


def read_geometry(path: Path) -> GeometryFile:
    """A geometry file: a `[geometry]` table as in `capture.toml`, its keys alone, or what `calibrate` wrote.

    Raises
    ------
    InputError
        One line with the file and the field; also for calibrated numbers that were changed by hand.
    """
    tables = read_toml(path)
    calibrated = tables.get("schema") == SCHEMA
    table = tables.get("geometry", tables)
    with_height_map(table, path)
    hashed = content_hash(tables if "geometry" in tables else {"geometry": tables})
    text = tomli_w.dumps(tables)
    if isinstance(table, dict):
        prune(table, GeometryConfig)
    geometry = parse(table, GeometryConfig, str(path))
    if not calibrated:
        return GeometryFile(path, geometry, None, None, None, GeometryOrigin(hashed, str(path)), text)
    calibration = _part(tables, "calibration", CalibrationTable, path)
    if calibration is not None and calibration.hash != hashed:
        raise InputError(
            f"{path}: calibration.hash = {calibration.hash}, but that of the numbers is {hashed}: they were changed "
            "after the calibration; calibrate again, or take [calibration] and schema out to use them as they are"
        )
    origin = GeometryOrigin(hashed, str(path), "" if calibration is None else calibration.date_utc)
    lens, pitch = _part(tables, "camera", LensTable, path), _part(tables, "pattern", PitchTable, path)
    return GeometryFile(path, geometry, lens, pitch, calibration, origin, text)


def origin_of(optics: OpticsConfig) -> GeometryOrigin:
    """Of a bench that states its own geometry."""
    lens = {key: getattr(optics.camera, key) for key in ("focal_mm", "distortion")}
    tables = {
        "geometry": optics.geometry.model_dump(exclude_none=True, exclude={"reference_displacement_um"}),
        "camera": {**lens, "principal_px": optics.camera.principal},
        "pattern": {"period_mm": optics.pattern.period_mm},
    }
    return GeometryOrigin(content_hash(tables))


def _part(tables: dict[str, Any], name: str, model: type[Table], path: Path) -> Table | None:
    table = tables.get(name)
    if isinstance(table, dict):
        prune(table, model)
    return None if table is None else parse(table, model, f"{path}: {name}")
