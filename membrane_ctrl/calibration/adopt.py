"""Puts a new geometry where the configuration looks for it."""

from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl.geometry.file import read_geometry
from membrane_ctrl.model import errors, files


def adopt_geometry(new: Path, place: Path) -> Path | None:
    """Put a geometry where the configuration looks for it.

    Parameters
    ----------
    new : Path
        The file of the geometry.
    place : Path
        Where the configuration looks.

    Returns
    -------
    Path or None
        Where the previous one is kept; None if there was none.

    Raises
    ------
    DeviceError
        It cannot be written; the old one then stays in place.
    """
    with errors.convert_write_errors(place, errors.DeviceError):
        place.parent.mkdir(parents=True, exist_ok=True)
        place = files.resolve_user_path(place)
        kept = None
        if place.exists():
            kept = _backup_path(place)
        if kept is not None:
            files.write_bytes_atomic(kept, files.read_bytes(place, files.SMALL_BYTES, follow=True))
        files.write_text_atomic(place, files.read_text(new))
    return kept


def _backup_path(place: Path) -> Path:
    """A free name with the date of the calibration, or of the file if a person wrote it."""
    try:
        written = datetime.fromisoformat(read_geometry(place).origin.calibrated_utc)
    except (errors.InputError, ValueError):
        written = datetime.fromtimestamp(place.stat().st_mtime, UTC)
    stem = f"{place.stem}-{written.astimezone(UTC):%Y%m%dT%H%M%SZ}"
    for number in range(1, 1000):
        kept = place.with_name(f"{stem}{'' if number == 1 else f'-{number}'}{place.suffix}")
        if not kept.exists():
            return kept
    raise OSError(f"a thousand files {stem} exist")
