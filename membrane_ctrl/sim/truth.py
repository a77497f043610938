"""The true state of the simulated bench, as one message of a ring."""

import math
import struct
from dataclasses import astuple, dataclass, fields


@dataclass(frozen=True, slots=True)
class Truth:
    """State of the simulated bench at one moment."""

    time_s: float  # plant time; on the run's clock once the bench process has published it
    # mirror centre from its nominal sag (600 Pa, settled), positive when the bowl deepens
    displacement_um: float
    sag_mm: float  # depth of the mirror film
    back_sag_mm: float  # depth of the other film
    gauge_pressure_pa: float
    ambient_pressure_pa: float
    air_temperature_c: float
    gas_temperature_c: float
    laser_bias_um: float  # error of the laser due to its mount
    laser_lost: float  # 1 while the laser receives no light
    leak_um_per_s: float  # speed at which the leak alone lowers the centre
    pump_um_per_s: float  # speed at which the pump's flow lifts it
    vent_um_per_s: float
    film_temperature_c: float = math.nan
    ring_temperature_c: float = math.nan
    humidity_percent: float = math.nan
    excess_strain_ppm: float = 0.0  # strain of the film above that of its ring
    patch_k: float = 0.0  # warming of the middle of a lamp's patch

    def pack(self) -> bytes:
        """The fields as doubles in their order."""
        return _STRUCT.pack(*astuple(self))

    @classmethod
    def unpack(cls, message: bytes) -> "Truth":
        """Inverse of `pack`. Raises struct.error on a message of another length."""
        return cls(*_STRUCT.unpack(message))


_STRUCT = struct.Struct(f"<{len(fields(Truth))}d")
TRUTH_BYTES = _STRUCT.size
