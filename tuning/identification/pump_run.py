"""Commands and readings of an experiment with constant pump commands."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True, slots=True, order=True)
class Level:
    """A constant command, reached from a smaller one or from a larger one."""

    fraction: float
    rising: bool = True


@dataclass(frozen=True, slots=True)
class PumpRun:
    """Commands and readings of one experiment, evenly sampled, arrays (n,);
    NaN for missing values.
    """

    dt_s: float
    fraction: FloatArray  # from each reading until the next
    displacement_um: FloatArray
    ambient_pressure_pa: FloatArray

    @property
    def has_sunk(self) -> bool:
        """Whether the mirror was below where it began at the end."""
        read_um = self.displacement_um[np.isfinite(self.displacement_um)]
        return bool(read_um.size and read_um[-1] < read_um[0])


def list_levels(run: PumpRun) -> list[Level | None]:
    """The level at each sample; None for no command."""
    found: list[Level | None] = []
    before, level = 0.0, None
    for fraction in np.round(run.fraction, 4).tolist():
        if fraction != before:
            level = Level(fraction, fraction > before) if fraction > 0 else None
            before = fraction
        found.append(level)
    return found
