"""The data of a tuning step: evenly sampled readings, and the flow commanded after each."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from membrane_ctrl.control.experiments.experiment import BenchSample
from membrane_ctrl.model.arrays import FloatArray

Series = FloatArray
COLUMNS = ("flow_um_per_s", "displacement_um", "ambient_pressure_pa", "air_temperature_c")


@dataclass(frozen=True, slots=True)
class Record:
    """Evenly sampled readings and the flow commanded right after each of them."""

    dt_s: float  # sample time
    # (n,): commanded flow as the pump's nominal curve has it, from each reading until the next
    flow_um_per_s: Series
    displacement_um: (
        Series  # (n,): by the laser, or the figures of a hold without one; NaN where one was lost
    )
    ambient_pressure_pa: Series  # (n,): all NaN without the sensor
    air_temperature_c: Series  # (n,)

    @classmethod
    def from_samples(
        cls, dt_s: float, flows_um_per_s: Sequence[float], samples: Sequence[BenchSample]
    ) -> Record:
        """Make a record from samples and the flows that followed them.

        Parameters
        ----------
        dt_s : float
            Time between samples.
        flows_um_per_s : sequence of float
            Commanded after each sample.
        samples : sequence of BenchSample
            As many.
        """
        columns = [
            [getattr(sample, field.name) for sample in samples] for field in fields(BenchSample)
        ]
        return cls(
            dt_s,
            np.array(flows_um_per_s, dtype=float),
            *(np.array(c, dtype=float) for c in columns),
        )

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
        """Share of readings that were lost."""
        return float(np.mean(~np.isfinite(self.displacement_um)))

    @property
    def gaps_s(self) -> list[float]:
        """Duration of each time without a reading."""
        is_lost = np.concatenate(([False], ~np.isfinite(self.displacement_um), [False]))
        edges = np.flatnonzero(np.diff(is_lost.astype(int)))
        begins = edges[::2]
        ends = edges[1::2]
        return [float(samples) * self.dt_s for samples in ends - begins]

    def cut(self, start_s: float, stop_s: float) -> Record:
        """Return the samples of a part of the record.

        Parameters
        ----------
        start_s : float
            From here on, counted from the first sample.
        stop_s : float
            Up to here, excluded.
        """
        cut = slice(round(start_s / self.dt_s), round(stop_s / self.dt_s))
        return Record(self.dt_s, *(column[cut] for column in self._list_columns()))

    def every(self, ticks: int) -> Record:
        """One reading of so many, and the mean flow until the next one."""
        whole = len(self) // ticks * ticks
        flow_um_per_s, *read = (column[:whole] for column in self._list_columns())
        means_um_per_s = flow_um_per_s.reshape(-1, ticks).mean(axis=1)
        return Record(ticks * self.dt_s, means_um_per_s, *(column[::ticks] for column in read))

    def followed_by(self, *later: Record) -> Record:
        """Join this record and its continuation. Raises ValueError for different sample times."""
        if any(part.dt_s != self.dt_s for part in later):
            raise ValueError("records of different sample times cannot be joined")
        columns = zip(*(part._list_columns() for part in (self, *later)), strict=True)
        return Record(self.dt_s, *(np.concatenate(parts) for parts in columns))

    def filled_displacement_um(self) -> Series:
        """Readings with lost ones interpolated. Raises ValueError if all are lost."""
        good = np.isfinite(self.displacement_um)
        if not good.any():
            raise ValueError("no reading of the mirror in the record")
        ticks = np.arange(len(self))
        ticks_with_reading = np.flatnonzero(good)
        return np.interp(ticks, ticks_with_reading, self.displacement_um[good])

    def sha256(self) -> str:
        """Hash of the data, which identifies the origin of gains."""
        digest = hashlib.sha256(np.float64(self.dt_s).tobytes())
        for column in self._list_columns():
            digest.update(np.ascontiguousarray(column).tobytes())
        return digest.hexdigest()

    def _list_columns(self) -> tuple[Series, ...]:
        return tuple(getattr(self, name) for name in COLUMNS)
