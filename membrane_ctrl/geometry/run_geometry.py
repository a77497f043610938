"""The geometry that a run uses: that of `optics.geometry_file`, copied to the run's folder."""

from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.config import sight
from membrane_ctrl.config.schema import Config, OpticsConfig
from membrane_ctrl.geometry.file import (
    CalibrationTable,
    GeometryOrigin,
    read_geometry,
    stated_origin,
)
from membrane_ctrl.model import errors, files

GEOMETRY_COPY = "geometry.toml"  # in the run's folder


@dataclass(frozen=True)
class RunGeometry:
    """The geometry used by the cycles of a run.

    Attributes
    ----------
    optics : OpticsConfig
        The configuration's, with the calibrated geometry if there is one.
    origin : GeometryOrigin
        Its origin.
    calibration : CalibrationTable, optional
        Reference for drift.
    text : str
        Content of the file; empty without one.
    note : str
        Why the stated geometry is used although the configuration names a file.
    """

    optics: OpticsConfig
    origin: GeometryOrigin
    calibration: CalibrationTable | None = None
    text: str = ""
    note: str = ""

    def copy_to_run(self, run_dir: Path) -> None:
        """Copy the file to the run's folder, for its cycles and later reviews.
        Raises InputError.
        """
        if not self.text:
            return
        with errors.convert_write_errors(run_dir / GEOMETRY_COPY):
            files.write_text_atomic(run_dir / GEOMETRY_COPY, self.text)


def read_configured_geometry(config: Config) -> RunGeometry:
    """Read the file named in the configuration.

    A missing file is not an error: the first calibration of a bench has to use the geometry
    measured by hand. The note states it.

    Raises InputError if the file exists but cannot be used.
    """
    there = _read_if_present(config.optics.geometry_file, config)
    if there.origin.file:
        require_plausible(there.optics, Path(there.origin.file))
    return there


def read_run_geometry(run_dir: Path | None, config: Config) -> RunGeometry:
    """Read the geometry that a started run uses from its folder.

    Parameters
    ----------
    run_dir : Path or None
        The run's folder; None, or a folder without a copy: the configuration's own geometry.
    config : Config
        The run's configuration.

    Raises
    ------
    InputError
        The copy cannot be used.
    """
    return _read_if_present(None if run_dir is None else run_dir / GEOMETRY_COPY, config)


def _read_if_present(path: Path | None, config: Config) -> RunGeometry:
    optics = config.optics
    if path is None or not path.exists():
        wanted = optics.geometry_file
        note = ""
        if wanted:
            note = f"{wanted} does not exist yet: [optics.geometry] is used, as measured by hand"
        return RunGeometry(optics, stated_origin(optics), note=note)
    file = read_geometry(path)
    return RunGeometry(file.apply_to_optics(optics), file.origin, file.calibration, file.text)


def require_plausible(optics: OpticsConfig, where: Path, depth_known: bool = True) -> None:
    """Refuse a geometry with which less than half of the mirror can be measured.

    Parameters
    ----------
    optics : OpticsConfig
        The optics with this geometry.
    where : Path
        Its file, for the message.
    depth_known : bool
        Whether the film's depth is stated. Unless it is, any depth that the film can have counts.

    Raises
    ------
    InputError
        Names the table and the key that are most probably wrong, and the remedy.
    """
    found = sight.find_doubt(optics, depth_known)
    if found is not None and found.hopeless:
        raise errors.InputError(f"{where}: {found.table}.{found.key}: {found.why}; {found.remedy}")
