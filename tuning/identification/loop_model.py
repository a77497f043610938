"""The loop as tuning sees it: a record of its readings, the model of its plant, and the closed loop
of both.

A record has evenly sampled columns. The closed loop is in the frequency domain, with its exact
delay:

    L = C F P,   P = k exp(-j w (theta + h / 2 + write)) / (j w (1 + j w T)),
    C = K (1 + 1 / (j w Ti) + j w Td),   F = 1 / (1 + j w Tf)

h / 2 is the mean delay of a command held for a sample. A Pade approximation would shift the margins
by as much as the designs differ; a frequency response needs none.
"""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import control
import numpy as np
from scipy.signal import lfilter

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.control.experiments.experiment import BenchSample
from membrane_ctrl.model import errors, files
from membrane_ctrl.model.arrays import ComplexArray, FloatArray

Series = FloatArray


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
        """Make a record from samples and the flows that followed them."""
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

    def part(self, start_s: float, stop_s: float) -> Record:
        """The samples from `start_s` up to, but excluding, `stop_s`."""
        cut = slice(round(start_s / self.dt_s), round(stop_s / self.dt_s))
        return Record(self.dt_s, *(column[cut] for column in self._columns()))

    def every(self, ticks: int) -> Record:
        """One reading of so many, and the mean flow until the next one."""
        whole = len(self) // ticks * ticks
        flow_um_per_s, *read = (column[:whole] for column in self._columns())
        means_um_per_s = flow_um_per_s.reshape(-1, ticks).mean(axis=1)
        return Record(ticks * self.dt_s, means_um_per_s, *(column[::ticks] for column in read))

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
            raise ValueError("no reading of the mirror in the record")
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
_COLUMNS = ("flow_um_per_s", "displacement_um", "ambient_pressure_pa", "air_temperature_c")


def save_record(path: Path, record: Record) -> None:
    """Write a record atomically."""
    file = io.BytesIO()
    columns = {name: getattr(record, name) for name in _COLUMNS}
    np.savez_compressed(
        file, dt_s=np.float64(record.dt_s), sha256=np.array(record.sha256()), **columns
    )
    files.write_bytes_atomic(files.users(path), file.getvalue())


def load_record(path: Path) -> Record:
    """Read a record. Raises InputError if it is missing, damaged, or altered."""
    try:
        with (
            files.open_plain(files.users(path)) as file,
            np.load(file, allow_pickle=False) as found,
        ):
            if sum(member.file_size for member in found.zip.infolist()) > _BYTES_MAX:
                raise ValueError("more than a record holds")
            record = Record(float(found["dt_s"]), *(found[name] for name in _COLUMNS))
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


# The mirror as tuning sees it: an integrator behind the pump's transport delay and lag.
#
#     dy/dt = k q(t) - leak + disturbance,    T dq/dt = v(t - theta) - q
#
# v is the commanded flow on the pump's nominal curve, as speed of the centre: k = 1 on a bench as
# configured.


@dataclass(frozen=True, slots=True)
class PlantModel:
    """Gain, delay and leak."""

    gain: float  # k, speed of the centre per commanded flow
    # theta, from a reading's tick to the first gas in the mirror (half a sample of holding comes on
    # top)
    dead_time_s: float
    lag_s: float  # T
    leak_um_per_s: float  # loss through leak and bleed

    @property
    def delay_s(self) -> float:
        """Dead time plus lag, the delay of a ramp."""
        return self.dead_time_s + self.lag_s

    @property
    def holding_flow_um_per_s(self) -> float:
        """Commanded flow that balances the leak."""
        return self.leak_um_per_s / self.gain


def delayed(series: Series, delay_s: float, dt_s: float) -> Series:
    """Values `delay_s` ago, linear between samples; the first value before the record."""
    if delay_s == 0:
        return series
    ticks = np.arange(series.size, dtype=float)
    return np.asarray(np.interp(ticks - delay_s / dt_s, ticks, series), dtype=float)


def driven_um(flow_um_per_s: Series, dead_time_s: float, lag_s: float, dt_s: float) -> Series:
    """Path of the centre for unit gain, at each reading, for a flow held between readings; exact.

    From T dq/dt = v - q follows the integral of q = integral of v - T q (+ constant). The integral
    of a held flow is a broken line, so interpolating it between samples is exact for any delay.
    Within a sample the delayed flow changes once, after the share f of the sample: q[i+1] = a q[i]
    + b1 v[i-m-1] + b2 v[i-m]. The flow before the record is assumed equal to its first value; the
    path is 0 at the first reading.
    """
    first = flow_um_per_s[0]
    change = flow_um_per_s - first
    way = np.concatenate(([0.0], np.cumsum(change[:-1]) * dt_s))
    way = delayed(way, dead_time_s, dt_s)
    if lag_s > 0:
        whole = math.floor(dead_time_s / dt_s)
        left_s = (1.0 - (dead_time_s / dt_s - whole)) * dt_s
        late, now = (
            math.exp(-left_s / lag_s) - math.exp(-dt_s / lag_s),
            -math.expm1(-left_s / lag_s),
        )
        weights = np.concatenate((np.zeros(whole + 1), [now, late]))
        way = way - lag_s * np.asarray(lfilter(weights, [1.0, -math.exp(-dt_s / lag_s)], change))
    return np.asarray(way + first * dt_s * np.arange(flow_um_per_s.size), dtype=float)


_SLOWEST_RAD_PER_S = 1e-4


def pump_share_um(record: Record, model: PlantModel) -> Series:
    """Motion of the centre due to pump and leak alone, with the mean of a record's readings,
    (n,).
    """
    x = driven_um(record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s)
    way = model.gain * x - model.leak_um_per_s * np.arange(len(record)) * record.dt_s
    return way + float(np.mean(record.filled_displacement_um() - way))


@dataclass(frozen=True, slots=True)
class Gains:
    """A controller: K in 1/s, times in s; the filter precedes all three terms."""

    kp_per_s: float
    ti_s: float
    td_s: float = 0.0
    filter_s: float = 0.0

    @classmethod
    def of(cls, loop: LoopConfig) -> Gains:
        """Gains of a configured loop."""
        return cls(loop.kp_per_s, loop.ti_s, loop.td_s, loop.measurement_filter_s)

    def rounded(self) -> Gains:
        """To four digits: more mean nothing, and people copy them."""
        return Gains(
            *(
                float(f"{value:.4g}")
                for value in (self.kp_per_s, self.ti_s, self.td_s, self.filter_s)
            )
        )

    def applied_to(self, loop: LoopConfig) -> LoopConfig:
        """The loop with these gains, validated. Raises pydantic.ValidationError outside the
        permitted range.
        """
        times = {"ti_s": self.ti_s, "td_s": self.td_s, "measurement_filter_s": self.filter_s}
        return LoopConfig.model_validate(loop.model_dump() | times | {"kp_per_s": self.kp_per_s})


def frequencies(dt_s: float, points: int = 400) -> Series:
    """Angular frequencies from far below any loop to Nyquist, evenly in their logarithm."""
    return np.geomspace(_SLOWEST_RAD_PER_S, np.pi / dt_s, points)


def pump_response(model: PlantModel, w_rad_per_s: Series, dt_s: float) -> ComplexArray:
    """From commanded flow to speed of the centre, without the leak."""
    s = 1j * w_rad_per_s
    return np.asarray(
        model.gain * np.exp(-s * (model.dead_time_s + dt_s / 2)) / (1 + s * model.lag_s)
    )


def controller_response(gains: Gains, w_rad_per_s: Series) -> ComplexArray:
    """From error to commanded flow."""
    s = 1j * w_rad_per_s
    return np.asarray(
        gains.kp_per_s * (1 + 1 / (s * gains.ti_s) + s * gains.td_s) / (1 + s * gains.filter_s)
    )


def loop_response(
    gains: Gains, model: PlantModel, w_rad_per_s: Series, dt_s: float
) -> ComplexArray:
    """L."""
    integrator = 1 / (1j * w_rad_per_s)
    return (
        controller_response(gains, w_rad_per_s)
        * pump_response(model, w_rad_per_s, dt_s)
        * integrator
    )


# Stability margins of a loop, from the exact frequency response.

_POINTS = 3000  # 0.3 % apart: margins to better than 1 %
_FINE_DT_S = 1e-3


@dataclass(frozen=True, slots=True)
class Margins:
    """Margins of a loop."""

    ms: float  # largest sensitivity, max |1 / (1 + L)|
    gain_margin: float  # factor on the gain at which the loop oscillates
    phase_margin_deg: float
    delay_margin_s: float  # additional dead time at which the loop oscillates
    # balanced disk margin, 2 / max |S - T|: gain and phase may change together within that disk
    disk_margin: float
    stable: bool  # by Nyquist's criterion; if false, the other figures mean nothing


def margins(gains: Gains, model: PlantModel, dt_s: float) -> Margins:
    """Margins of a loop sampled every `dt_s`.

    L has two poles at the origin (mirror and integrator) and none to the right, so that the loop is
    stable if and only if the phase at every gain crossing is above -180 deg. Stability is read from
    the number of turns of 1 + L about 0, which also sees loops with several crossings.
    """
    w = np.geomspace(1e-4, max(np.pi / dt_s, 20 / max(model.delay_s, _FINE_DT_S)), _POINTS)
    response = loop_response(gains, model, w, dt_s)
    sensitivity = 1 / (1 + response)
    frd = control.FrequencyResponseData(response, w, smooth=True)
    gain_margin, phase_margin_deg, _, _, crossing, _ = control.stability_margins(frd)
    return Margins(
        ms=float(np.max(np.abs(sensitivity))),
        gain_margin=float(gain_margin),
        phase_margin_deg=float(phase_margin_deg),
        delay_margin_s=math.radians(float(phase_margin_deg)) / float(crossing)
        if crossing > 0
        else math.inf,
        disk_margin=float(1 / np.max(np.abs(sensitivity - 0.5))),
        stable=_is_stable(response),
    )


def _is_stable(response: ComplexArray) -> bool:
    """From the double pole at the origin 1 + L starts at -180 deg (just above it if stable) and
    must end at 0.
    """
    turned = float(np.sum(np.angle((1 + response)[1:] / (1 + response)[:-1])))
    return abs(float(np.angle(1 + response[0])) % (-2 * math.pi) + turned) < math.pi / 2


def sensitivity_peak(gains: Gains, model: PlantModel, dt_s: float) -> float:
    """Ms on a coarse grid (to 1 %), for searches; infinite for an unstable loop."""
    response = loop_response(gains, model, frequencies(dt_s), dt_s)
    return float(np.max(1 / np.abs(1 + response))) if _is_stable(response) else math.inf


# The loop's answer to a step of the leak.

# a load step is over when the centre stays this near, the limit for a mean of 60 s
RECOVERED_UM = 0.5
_LOOK_S, _LOOKS = (
    0.04,
    2**14,
)  # 655 s, of which the first half is used: the transform takes the answer as periodic


@dataclass(frozen=True, slots=True)
class LoadStep:
    """After a step of the leak: furthest excursion, and time until the centre stays within
    `RECOVERED_UM`.
    """

    peak_um: float
    recovery_s: float  # infinite if longer than five minutes


def load_step(gains: Gains, model: PlantModel, step_um_per_s: float, dt_s: float) -> LoadStep:
    """The exact answer of a stable loop with its delay: D / s^2 / (1 + L),
    transformed into time.
    """
    w: Series = np.asarray(2 * np.pi * np.fft.rfftfreq(_LOOKS, _LOOK_S), dtype=float)
    w[0] = _SLOWEST_RAD_PER_S  # L has two integrators: the answer is finite there
    answer = -step_um_per_s / w**2 / (1 + loop_response(gains, model, w, dt_s))
    away_um = np.abs(np.fft.irfft(answer, _LOOKS)[: _LOOKS // 2]) / _LOOK_S
    away = np.flatnonzero(away_um > RECOVERED_UM)
    over_s = (int(away[-1]) + 1) * _LOOK_S if away.size else 0.0
    return LoadStep(float(away_um.max()), over_s if over_s < _LOOKS // 2 * _LOOK_S else math.inf)


@dataclass(frozen=True, slots=True)
class LoopFigures:
    """What a set of gains gives and costs, as predicted; or how well that is known (1 sigma)."""

    std_um: float  # of the true centre
    load_peak_um: float  # after a step of the leak
    load_recovery_s: float
    ms: float
