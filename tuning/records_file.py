"""Raw data of a session: one compressed file a record, checked by its hash when it is read back."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from membrane_ctrl.errors import InputError
from membrane_ctrl.recording.atomic import open_plain, users, write_bytes_atomic
from tuning.records import Record

_BYTES_MAX = 200_000_000  # four columns of a day at 50 Hz are 140 MB
_COLUMNS = ("flow_um_per_s", "displacement_um", "ambient_pressure_pa", "air_temperature_c")


def save_record(path: Path, record: Record) -> None:
    """Write a record in one step."""
    file = io.BytesIO()
    columns = {name: getattr(record, name) for name in _COLUMNS}
    np.savez_compressed(file, dt_s=np.float64(record.dt_s), sha256=np.array(record.sha256()), **columns)
    write_bytes_atomic(users(path), file.getvalue())


def load_record(path: Path) -> Record:
    """Read a record. Raises InputError if it is not there, damaged, or not what was written."""
    try:
        with open_plain(users(path)) as file, np.load(file, allow_pickle=False) as found:
            if sum(member.file_size for member in found.zip.infolist()) > _BYTES_MAX:
                raise ValueError("more than a record holds")
            record = Record(float(found["dt_s"]), *(found[name] for name in _COLUMNS))
            hashed = str(found["sha256"])
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError, TypeError, KeyError, AttributeError, MemoryError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: damaged ({error}); repeat the step that wrote it") from None
    if record.sha256() != hashed:
        raise InputError(f"{path}: the data are not those that were written (hash differs)")
    return record
