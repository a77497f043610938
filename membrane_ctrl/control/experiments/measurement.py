"""What an experiment sees of a tick."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Measurement:
    """One sample of the bench; NaN for what the bench does not have or has lost."""

    displacement_um: float
    ambient_pressure_pa: float = float("nan")
    air_temperature_c: float = float("nan")
