"""Raw data of a session: one compressed file per record, checked by its hash when read."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path

import numpy as np

from membrane_ctrl.model import errors, files, program
from tuning.identification.record import COLUMNS, Record

_BYTES_MAX = 200_000_000  # four columns of a day at 50 Hz are 140 MB
# Exceptions of NumPy and the archive, depending on the damaged byte.
_DAMAGED = (
    *(
        OSError,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        MemoryError,
        EOFError,
        NotImplementedError,
    ),
    *(zipfile.BadZipFile, zlib.error),
)


def save_record(path: Path, record: Record) -> None:
    """Write a record atomically.

    Parameters
    ----------
    path : Path
        A compressed NumPy archive (`.npz`): the columns of `COLUMNS`, `dt_s`, the origin, and the
        hash that `load_record` checks.
    record : Record
        Evenly sampled readings and commanded flows.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    file = io.BytesIO()
    columns = {name: getattr(record, name) for name in COLUMNS}
    np.savez_compressed(
        file,
        origin=np.array(program.describe_origin("membrane-tuning-record/1")),
        dt_s=np.float64(record.dt_s),
        sha256=np.array(record.sha256()),
        **columns,
    )
    files.write_bytes_atomic(files.resolve_user_path(path), file.getvalue())


def load_record(path: Path) -> Record:
    """Read a record. Raises InputError if it is missing, damaged, or altered."""
    try:
        with (
            files.open_plain(files.resolve_user_path(path)) as file,
            np.load(file, allow_pickle=False) as found,
        ):
            if sum(member.file_size for member in found.zip.infolist()) > _BYTES_MAX:
                raise ValueError("more than a record holds")
            record = Record(float(found["dt_s"]), *(found[name] for name in COLUMNS))
            hashed = str(found["sha256"])
    except FileNotFoundError:
        raise errors.InputError(f"{path}: no such file") from None
    except _DAMAGED as error:
        raise errors.InputError(
            f"{path}: damaged ({error}); repeat the step that wrote it"
        ) from None
    if record.sha256() != hashed:
        raise errors.InputError(f"{path}: the data have been altered (hash differs)")
    return record
