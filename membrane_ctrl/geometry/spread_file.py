"""Files that state how well a geometry is known: its covariance, and the results of auxiliary
calibrations.

A geometry file carries a `[covariance]` table beside `[geometry]`: names = ["a_mm", "b_mm",
"alpha_deg"], or of the twelve of the general form (see `metrology.uncertainty.geometry_spread`),
and matrix = rows of their covariance. A prior (`calibrate --prior`) is a camera or a geometry with
the sigmas of `calibrate`'s parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomli_w
from pydantic import Field

from firmware_iface.settings import Section
from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.config.optics import SigmasConfig
from membrane_ctrl.config.origin import OriginSection
from membrane_ctrl.geometry.file import LensTable
from membrane_ctrl.metrology.rays.bench_parameters import NAMES
from membrane_ctrl.metrology.uncertainty.geometry_spread import (
    OPTIONAL_NAMES,
    PAPER_SPREAD,
    POSE_NAMES,
    GeometrySpread,
    moved_bench,
    stated_spread,
)
from membrane_ctrl.model import errors, files, program
from membrane_ctrl.model.errors import InputError

_NAMED = 6  # inputs without a stated sigma; the others are counted


class CovarianceTable(Section):
    """The `[covariance]` table."""

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


def read_spread(path: Path) -> GeometrySpread | None:
    """The covariance in a geometry file; None if it has none. Raises InputError."""
    table = toml_file.read_toml(path).get("covariance")
    if table is None:
        return None
    content = toml_file.parse(table, CovarianceTable, f"{path}: covariance")
    if any(len(row) != len(content.names) for row in content.matrix) or len(content.matrix) != len(
        content.names
    ):
        raise InputError(
            f"{path}: covariance.matrix: needs {len(content.names)} rows and columns, one per name"
        )
    try:
        return GeometrySpread(content.names, np.array(content.matrix, float))
    except ValueError as error:
        raise InputError(f"{path}: covariance.{error}") from None


def spread_of(optics: schema.OpticsConfig, file: Path | None) -> tuple[GeometrySpread, str]:
    """How well poses, lens and screen are known, and the source of that.

    The file's covariance, else the geometry's own sigmas of a, b and alpha, else those of the
    paper's instruments. What these do not name has the sigma of `[geometry.sigmas]`; of the poses,
    only where no file has a covariance.

    Raises InputError if the file's covariance is for the other form.
    """
    geometry, given = optics.geometry, None if file is None else read_spread(file)
    others = sigmas_of(optics)
    if given is not None:
        try:
            moved_bench(optics, given.names, np.zeros(len(given.names)))
        except ValueError as error:
            raise InputError(f"{file}: covariance.names: {error}") from None
        optional = {name: sigma for name, sigma in others.items() if name in OPTIONAL_NAMES}
        return given.with_others(optional), f"covariance in {file}"
    stated = stated_spread(geometry)
    return (PAPER_SPREAD if stated is None else stated).with_others(others), _stated(
        geometry, stated is not None
    )


def _stated(geometry: schema.GeometryConfig, poses: bool) -> str:
    """Where the sigmas are from: what the geometry does not state has the defaults of
    `SigmasConfig`.
    """
    given = geometry.sigmas.model_fields_set if geometry.sigmas else set()
    missing = [] if poses else ["a", "b", "alpha"]
    missing += [name for name in SigmasConfig.model_fields if name not in given]
    if not missing:
        return "sigmas stated with the geometry"
    named = ", ".join(missing[:_NAMED]) + (
        f" and {len(missing) - _NAMED} others" if len(missing) > _NAMED else ""
    )
    return (
        f"no sigma is stated for {named if given or poses else 'any input'}; data-sheet defaults "
        "apply"
    )


def sigmas_of(optics: schema.OpticsConfig) -> dict[str, float]:
    """`[geometry.sigmas]` by the names of `calibrate`'s parameters, without a, b and alpha."""
    stated = optics.geometry.sigmas or SigmasConfig()
    pixels = stated.principal_mm / (optics.camera.pixel_um * 1e-3)
    known = stated.model_dump() | {"principal_x_px": pixels, "principal_y_px": pixels}
    return {name: known[name] for name in (*POSE_NAMES[3:], *OPTIONAL_NAMES)}


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

    def over(self, optics: schema.OpticsConfig) -> schema.OpticsConfig:
        """The bench with this prior. Raises InputError for a different camera."""
        if self.content.camera is not None:
            optics = optics.model_copy(
                update={"camera": self.content.camera.over(optics.camera, self.path)}
            )
        if self.content.geometry is None:
            return optics
        geometry = self.content.geometry
        if geometry.reference_displacement_um is None:
            known = {"reference_displacement_um": optics.geometry.reference_displacement_um}
            geometry = geometry.model_copy(update=known)
        return toml_file.parse(
            {**dict(optics), "geometry": geometry}, schema.OpticsConfig, str(self.path)
        )


def read_prior(path: Path) -> Prior:
    """Read a prior. Raises InputError."""
    content = toml_file.load(path, PriorFile)
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
    """Write `camera`, `geometry` or `sigmas` with their origin. Raises InputError."""
    made = {
        "by": made_by,
        "date_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "of": list(made_of),
        "rms_px": rms_px,
    }
    with errors.writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_text_atomic(
            files.users(path),
            tomli_w.dumps({**program.file_origin(SCHEMA), **tables, "made": made}),
        )
