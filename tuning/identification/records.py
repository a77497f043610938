"""The data of a tuning step: evenly sampled columns of commands and readings."""

from __future__ import annotations

import hashlib
import io
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from membrane_ctrl.control.experiments.machine import BenchSample
from membrane_ctrl.model import errors, files
from membrane_ctrl.model.arrays import FloatArray

Series = FloatArray


@dataclass(frozen=True, slots=True)
class Record:
    """Evenly sampled readings and the flow commanded right after each of them."""

    dt_s: float  # sample time
    flow_um_per_s: Series  # (n,): commanded flow as the pump's nominal curve has it, from each reading until the next
    displacement_um: Series  # (n,): laser readings; NaN where one was lost
    ambient_pressure_pa: Series  # (n,): all NaN without the sensor
    air_temperature_c: Series  # (n,)

    @classmethod
    def from_samples(cls, dt_s: float, flows_um_per_s: Sequence[float], samples: Sequence[BenchSample]) -> Record:
        """Make a record from samples and the flows that followed them."""
        columns = [[getattr(sample, field.name) for sample in samples] for field in fields(BenchSample)]
        return cls(dt_s, np.array(flows_um_per_s, dtype=float), *(np.array(c, dtype=float) for c in columns))

    def __len__(self) -> int:
        return int(self.displacement_um.size)

    @property
    def duration_s(self) -> float:
        """Length of the record."""
        return len(self) * self.dt_s

    @property
    def has_barometer(self) -> bool:
        """Air pressure was read throughout."""
        return bool(np.isfinite(self.ambient_pressure_pa).all())

    @property
    def has_thermometer(self) -> bool:
        """Air temperature was read throughout."""
        return bool(np.isfinite(self.air_temperature_c).all())

    @property
    def lost_fraction(self) -> float:
        """Share of laser readings that were lost."""
        return float(np.mean(~np.isfinite(self.displacement_um)))

    def part(self, start_s: float, stop_s: float) -> Record:
        """The samples from `start_s` up to, but excluding, `stop_s`."""
        cut = slice(round(start_s / self.dt_s), round(stop_s / self.dt_s))
        return Record(self.dt_s, *(column[cut] for column in self._columns()))

    def followed_by(self, *later: Record) -> Record:
        """Join this record and its continuation. Raises ValueError for different sample times."""
        if any(part.dt_s != self.dt_s for part in later):
            raise ValueError("records of different sample times cannot be joined")
        columns = zip(*(part._columns() for part in (self, *later)), strict=True)
        return Record(self.dt_s, *(np.concatenate(parts) for parts in columns))

    def filled_displacement_um(self) -> Series:
        """Readings with lost ones interpolated. Raises ValueError if all are lost."""
        good = np.isfinite(self.displacement_um)
        if not good.any():
            raise ValueError("no laser reading in the record")
        return np.interp(np.arange(len(self)), np.flatnonzero(good), self.displacement_um[good])

    def sha256(self) -> str:
        """Hash of the data, which identifies the origin of gains."""
        digest = hashlib.sha256(np.float64(self.dt_s).tobytes())
        for column in self._columns():
            digest.update(np.ascontiguousarray(column).tobytes())
        return digest.hexdigest()

    def _columns(self) -> tuple[Series, ...]:
        return tuple(getattr(self, name) for name in _COLUMNS)


# Raw data of a session: one compressed file per record, checked by its hash when read.

_BYTES_MAX = 200_000_000  # four columns of a day at 50 Hz are 140 MB
# Exceptions of NumPy and the archive, depending on the damaged byte.
_DAMAGED = (
    *(OSError, ValueError, TypeError, KeyError, AttributeError, MemoryError, EOFError, NotImplementedError),
    *(zipfile.BadZipFile, zlib.error),
)
_COLUMNS = ("flow_um_per_s", "displacement_um", "ambient_pressure_pa", "air_temperature_c")


def save_record(path: Path, record: Record) -> None:
    """Write a record atomically."""
    file = io.BytesIO()
    columns = {name: getattr(record, name) for name in _COLUMNS}
    np.savez_compressed(file, dt_s=np.float64(record.dt_s), sha256=np.array(record.sha256()), **columns)
    files.write_bytes_atomic(files.users(path), file.getvalue())


def load_record(path: Path) -> Record:
    """Read a record. Raises InputError if it is missing, damaged, or altered."""
    try:
        with files.open_plain(files.users(path)) as file, np.load(file, allow_pickle=False) as found:
            if sum(member.file_size for member in found.zip.infolist()) > _BYTES_MAX:
                raise ValueError("more than a record holds")
            record = Record(float(found["dt_s"]), *(found[name] for name in _COLUMNS))
            hashed = str(found["sha256"])
    except FileNotFoundError:
        raise errors.InputError(f"{path}: no such file") from None
    except _DAMAGED as error:
        raise errors.InputError(f"{path}: damaged ({error}); repeat the step that wrote it") from None
    if record.sha256() != hashed:
        raise errors.InputError(f"{path}: the data have been altered (hash differs)")
    return record
