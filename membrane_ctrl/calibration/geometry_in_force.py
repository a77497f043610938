"""The geometry that a run measures with: that of `optics.geometry_file`, kept in the run's folder as it was."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.calibration.geometry_file import CalibrationTable, GeometryOrigin, origin_of, read_geometry
from membrane_ctrl.config import Config, OpticsConfig
from membrane_ctrl.errors import InputError
from membrane_ctrl.recording.atomic import write_text_atomic

KEPT = "geometry.toml"  # in the run's folder


@dataclass(frozen=True)
class InForce:
    """What the cycles of a run measure with.

    Attributes
    ----------
    optics : OpticsConfig
        The configuration's, with the calibrated geometry if there is one.
    origin : GeometryOrigin
        Its name.
    calibration : CalibrationTable or None
        What a drift is seen against.
    text : str
        What the file says; empty without one.
    note : str
        Why what the configuration states by hand is used although it names a file.
    """

    optics: OpticsConfig
    origin: GeometryOrigin
    calibration: CalibrationTable | None = None
    text: str = ""
    note: str = ""

    def keep(self, run_dir: Path) -> None:
        """Leave a copy in the run's folder: whoever measures or looks back takes that. Raises InputError."""
        if not self.text:
            return
        try:
            write_text_atomic(run_dir / KEPT, self.text)
        except OSError as error:
            raise InputError(f"{run_dir / KEPT}: cannot be written: {error.strerror or error}") from None


def geometry_in_force(config: Config) -> InForce:
    """Read the file that the configuration names.

    A file that is not there yet is no error: the first calibration of a bench has to be taken with what was measured
    by hand. The note says so.

    Raises
    ------
    InputError
        If the file is there and cannot be used.
    """
    return _read(config.optics.geometry_file, config)


def geometry_of_run(run_dir: Path | None, config: Config) -> InForce:
    """The same of a run that has begun, from its folder."""
    return _read(None if run_dir is None else run_dir / KEPT, config)


def _read(path: Path | None, config: Config) -> InForce:
    optics = config.optics
    if path is None or not path.exists():
        wanted = optics.geometry_file
        note = f"{wanted} is not there yet: [optics.geometry] is used, as measured by hand" if wanted else ""
        return InForce(optics, origin_of(optics), note=note)
    file = read_geometry(path)
    return InForce(file.over(optics), file.origin, file.calibration, file.text)
