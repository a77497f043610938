"""What really is, beside what the sensors say: for the recording and the optics, never for the controller."""

from __future__ import annotations

import struct
from dataclasses import astuple, dataclass, fields


@dataclass(frozen=True, slots=True)
class Truth:
    """State of the simulated bench at one moment.

    Attributes
    ----------
    time_s : float
        Plant time; on the run's clock once the bench process has published it.
    displacement_um : float
        Mirror centre from its nominal sag (600 Pa, settled), positive when the bowl deepens.
    sag_mm : float
        Depth of the mirror film.
    back_sag_mm : float
        Depth of the other film.
    gauge_pressure_pa, ambient_pressure_pa : float
        Pressures.
    air_temperature_c, gas_temperature_c : float
        Temperatures.
    laser_bias_um : float
        What the laser reads too much, from its mount.
    laser_lost : float
        1 while the laser gets no light back.
    leak_um_per_s : float
        Speed at which the leak alone lets the centre down.
    pump_um_per_s, vent_um_per_s : float
        Speed at which the pump's flow lifts it and the vent's lets it down.
    """

    time_s: float
    displacement_um: float
    sag_mm: float
    back_sag_mm: float
    gauge_pressure_pa: float
    ambient_pressure_pa: float
    air_temperature_c: float
    gas_temperature_c: float
    laser_bias_um: float
    laser_lost: float
    leak_um_per_s: float
    pump_um_per_s: float
    vent_um_per_s: float

    def pack(self) -> bytes:
        """The fields as doubles in their order."""
        return _STRUCT.pack(*astuple(self))

    @classmethod
    def unpack(cls, message: bytes) -> Truth:
        """Inverse of `pack`. Raises struct.error on a message of another length."""
        return cls(*_STRUCT.unpack(message))


_STRUCT = struct.Struct(f"<{len(fields(Truth))}d")
TRUTH_BYTES = _STRUCT.size
