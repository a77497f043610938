"""How well a geometry is known: the covariance in its file, or the sigmas that it states."""

from pathlib import Path

import numpy as np

from firmware_iface.settings import Section
from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.config.optics import SigmasConfig
from membrane_ctrl.metrology.uncertainty.geometry_spread import (
    OPTIONAL_NAMES,
    PAPER_SPREAD,
    POSE_NAMES,
    GeometrySpread,
    KnownBy,
    moved_bench,
    stated_spread,
)
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
    content = toml_file.parse_tables(table, CovarianceTable, f"{path}: covariance")
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


def geometry_spread(optics: schema.OpticsConfig, file: Path | None) -> tuple[GeometrySpread, str]:
    """Return how well poses, lens and screen are known, and by what.

    The file's covariance, else the geometry's own sigmas of a, b and alpha, else those of the
    paper's instruments. What these do not name has the sigma of `[geometry.sigmas]`; of the poses,
    only where no file has a covariance.

    Parameters
    ----------
    optics : OpticsConfig
        The optics with the geometry in use.
    file : Path or None
        File of that geometry; None: the geometry is stated without a file.

    Returns
    -------
    spread : GeometrySpread
        Covariance of the bench parameters.
    source : str
        Where it is from, for people.

    Raises
    ------
    InputError
        The file cannot be read, or its covariance is for the other form of the geometry.
    """
    geometry = optics.geometry
    given = None if file is None else read_spread(file)
    others = stated_sigmas(optics)
    if given is not None:
        try:
            moved_bench(optics, given.names, np.zeros(len(given.names)))
        except ValueError as error:
            raise InputError(f"{file}: covariance.names: {error}") from None
        optional = {name: sigma for name, sigma in others.items() if name in OPTIONAL_NAMES}
        return given.add_independent(optional), f"covariance in {file}"
    stated = stated_spread(geometry)
    return (PAPER_SPREAD if stated is None else stated).add_independent(others), _sigma_sources(
        geometry, stated is not None
    )


def find_known_by(optics: schema.OpticsConfig, file: Path | None) -> KnownBy:
    """Return what `geometry_spread` of the same arguments rests on.

    Parameters
    ----------
    optics, file
        As for `geometry_spread`.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    if file is not None and read_spread(file) is not None:
        return KnownBy.CALIBRATION
    if stated_spread(optics.geometry) is None:
        return KnownBy.DATA_SHEETS
    return KnownBy.STATED


def _sigma_sources(geometry: schema.GeometryConfig, poses: bool) -> str:
    """Where the sigmas are from: what the geometry does not state has the defaults of
    `SigmasConfig`.
    """
    given = geometry.sigmas.model_fields_set if geometry.sigmas else set()
    missing = []
    if not poses:
        missing = ["a", "b", "alpha"]
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


def stated_sigmas(optics: schema.OpticsConfig) -> dict[str, float]:
    """`[geometry.sigmas]` by the names of `calibrate`'s parameters, without a, b and alpha."""
    stated = optics.geometry.sigmas or SigmasConfig()
    pixels = stated.principal_mm / (optics.camera.pixel_um * 1e-3)
    known = stated.model_dump() | {"principal_x_px": pixels, "principal_y_px": pixels}
    return {name: known[name] for name in (*POSE_NAMES[3:], *OPTIONAL_NAMES)}
