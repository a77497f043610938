"""What an auxiliary calibration has found, for `calibrate --prior`: a camera or a geometry, and their sigmas."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import tomli_w
from pydantic import Field

from membrane_ctrl.config.schema import GeometryConfig, OpticsConfig
from membrane_ctrl.config.section import Section
from membrane_ctrl.config.toml_file import load, parse
from membrane_ctrl.geometry.file import LensTable
from membrane_ctrl.metrology.calibrate.parameters import NAMES
from membrane_ctrl.model import errors, files

SCHEMA = "membrane-prior/1"


class PriorFile(Section):
    """The file.

    `camera` and `geometry` stand instead of what the sets state; `sigmas` are those of `calibrate`'s parameters.
    """

    schema_: Annotated[str, Field(alias="schema")]
    camera: LensTable | None = None
    geometry: GeometryConfig | None = None
    sigmas: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)
    made: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True)
class Prior:
    """A prior and where it was read."""

    path: Path
    content: PriorFile

    def over(self, optics: OpticsConfig) -> OpticsConfig:
        """The bench with it. Raises InputError if it is of another camera."""
        if self.content.camera is not None:
            optics = optics.model_copy(update={"camera": self.content.camera.over(optics.camera, self.path)})
        if self.content.geometry is None:
            return optics
        geometry = self.content.geometry
        if geometry.reference_displacement_um is None:
            known = {"reference_displacement_um": optics.geometry.reference_displacement_um}
            geometry = geometry.model_copy(update=known)
        return parse({**dict(optics), "geometry": geometry}, OpticsConfig, str(self.path))


def read_prior(path: Path) -> Prior:
    """Read one. Raises InputError."""
    content = load(path, PriorFile)
    if content.schema_ != SCHEMA:
        raise errors.InputError(
            f"{path}: schema = {content.schema_}: a prior is {SCHEMA}; a geometry goes by --geometry"
        )
    if unknown := set(content.sigmas) - set(NAMES):
        raise errors.InputError(f"{path}: sigmas.{min(unknown)}: not a parameter; known are {', '.join(NAMES)}")
    return Prior(path, content)


def write_prior(path: Path, tables: dict[str, Any], made_by: str, made_of: Sequence[str], rms_px: float) -> None:
    """Write `camera`, `geometry` or `sigmas` with where they come from. Raises InputError."""
    made = {
        "by": made_by,
        "date_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "of": list(made_of),
        "rms_px": rms_px,
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_text_atomic(files.users(path), tomli_w.dumps({"schema": SCHEMA, **tables, "made": made}))
    except OSError as error:
        raise errors.InputError(f"{path}: cannot be written: {error.strerror or error}") from None
