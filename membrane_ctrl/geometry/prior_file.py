"""The file of a prior: what `calibrate-camera` or `calibrate-pose` found."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import tomli_w
from pydantic import Field

from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.config.origin import OriginSection
from membrane_ctrl.geometry.file import LensTable
from membrane_ctrl.metrology.rays.bench_parameters import NAMES
from membrane_ctrl.model import errors, files, program

SCHEMA = "membrane-prior/1"


class PriorFile(OriginSection):
    """The file of a prior.

    `camera` and `geometry` replace those stated in the sets; `sigmas` are those of `calibrate`'s
    parameters.
    """

    schema_: Annotated[str, Field(alias="schema")]
    camera: LensTable | None = None
    geometry: schema.GeometryConfig | None = None
    sigmas: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)
    made: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True)
class Prior:
    """A prior and its source."""

    path: Path
    content: PriorFile

    def apply_to_optics(self, optics: schema.OpticsConfig) -> schema.OpticsConfig:
        """The bench with this prior. Raises InputError for a different camera."""
        if self.content.camera is not None:
            optics = optics.model_copy(
                update={"camera": self.content.camera.apply_to_camera(optics.camera, self.path)}
            )
        if self.content.geometry is None:
            return optics
        geometry = self.content.geometry
        if geometry.reference_displacement_um is None:
            known = {"reference_displacement_um": optics.geometry.reference_displacement_um}
            geometry = geometry.model_copy(update=known)
        return toml_file.parse_tables(
            {**dict(optics), "geometry": geometry}, schema.OpticsConfig, str(self.path)
        )


def read_prior(path: Path) -> Prior:
    """Read a prior. Raises InputError."""
    content = toml_file.load_toml(path, PriorFile)
    if content.schema_ != SCHEMA:
        raise errors.InputError(
            f"{path}: schema = {content.schema_}: a prior has {SCHEMA}; pass a geometry with "
            "--geometry"
        )
    if unknown := set(content.sigmas) - set(NAMES):
        raise errors.InputError(
            f"{path}: sigmas.{min(unknown)}: not a parameter; known: {', '.join(NAMES)}"
        )
    return Prior(path, content)


def write_prior(
    path: Path, tables: dict[str, Any], made_by: str, made_of: Sequence[str], rms_px: float
) -> None:
    """Write `camera`, `geometry` or `sigmas` with their origin.

    Parameters
    ----------
    path : Path
        File to write.
    tables : dict
        The tables.
    made_by : str
        Command that made them.
    made_of : sequence of str
        What it was given.
    rms_px : float
        Residual of its fit.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    made = {
        "by": made_by,
        "date_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "of": list(made_of),
        "rms_px": rms_px,
    }
    with errors.convert_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_text_atomic(
            files.resolve_user_path(path),
            tomli_w.dumps({**program.file_origin(SCHEMA), **tables, "made": made}),
        )
