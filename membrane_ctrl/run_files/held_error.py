"""The headline figures of a hold: the error of its settled parts, in means of one second.

Console, end of a run, `runs` and report show these figures, with these words and digits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import telemetry
from membrane_ctrl.model.arrays import BoolArray
from membrane_ctrl.model.state_tree import StateNode
from membrane_ctrl.run_files.hold_parts import PARTS, HoldParts
from membrane_ctrl.run_files.run_statistics import SecondMeans, count_least_ticks

ErrorOf = Literal["true", "reading"]
_NAMES: dict[ErrorOf, str] = {"true": "true centre", "reading": "reading"}
_MISSING = "–"


@dataclass(frozen=True, slots=True)
class HeldError:
    """Target minus true centre (on the twin) or setpoint minus reading, in means of one second.

    Attributes
    ----------
    of : "true" or "reading"
    seconds : int
        Number of means.
    mean_um, std_um : float
        Their mean and standard deviation; NaN without means, and the latter of a single one.
    in_band : float
        Share of them within the band.
    """

    of: ErrorOf
    seconds: int
    mean_um: float
    std_um: float
    in_band: float

    @classmethod
    def from_table(cls, held: Mapping[str, Any]) -> HeldError:
        """The figures of `held` in `summary.json`; raises nothing for values that are missing."""

        def read_number(name: str) -> float:
            value = held.get(name)
            if not isinstance(value, (int, float)):
                return math.nan
            return float(value)

        seconds = read_number("seconds")
        return cls(
            "true" if held.get("of") == "true" else "reading",
            int(seconds) if math.isfinite(seconds) else 0,
            read_number("mean_um"),
            read_number("std_um"),
            read_number("in_band"),
        )

    @property
    def name(self) -> str:
        """What was held, in words."""
        return _NAMES[self.of]

    @property
    def std_text(self) -> str:
        """Standard deviation in µm, without the unit."""
        return format_std_um(self.std_um)

    @property
    def mean_text(self) -> str:
        """Mean error in µm, without the unit."""
        if not math.isfinite(self.mean_um):
            return _MISSING
        return f"{self.mean_um:+.3f}"

    @property
    def in_band_text(self) -> str:
        """Share within the band."""
        return format_in_band(self.in_band)

    @property
    def figures_text(self) -> str:
        """The figures in a few words."""
        return f"std {self.std_text} µm, mean error {self.mean_text} µm"


def format_std_um(std_um: float) -> str:
    """A standard deviation in µm, without the unit."""
    if not math.isfinite(std_um):
        return _MISSING
    return f"{std_um:.3f}"


def format_in_band(share: float) -> str:
    """A share of seconds within the band; 100 % only if every one was."""
    if not math.isfinite(share):
        return _MISSING
    return f"{math.floor(1e4 * share + 1e-6) / 100:.4g} %"


@dataclass(slots=True)
class HeldErrorMeter(StateNode):
    """Accumulates the error of a hold over blocks of telemetry rows, in their order."""

    parts: HoldParts
    true_1s_um: SecondMeans
    reading_1s_um: SecondMeans
    parts_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))

    @classmethod
    def for_config(cls, config: Config) -> HeldErrorMeter:
        """Return a meter without rows."""
        band_um = config.limits.band_um
        least = count_least_ticks(1.0, config.loop.rate_hz)
        return cls(HoldParts(band_um), SecondMeans(band_um, least), SecondMeans(band_um, least))

    def add_rows(self, rows: telemetry.Rows) -> BoolArray:
        """Add (n, len(FIELDS)) telemetry rows; returns (n,) whether each is of the settled hold."""
        parts = self.parts.classify_block(telemetry.get_columns(rows))
        dt_s = telemetry.get_column(rows, "dt_s")
        for name, part in parts.items():
            self.parts_s[name] += float(dt_s[part].sum())
        settled = telemetry.get_columns(rows[parts["held"]])
        self.true_1s_um.add(settled["mono_s"], telemetry.true_error_um(settled))
        reading_um = settled["setpoint_um"] - settled["displacement_um"]
        self.reading_1s_um.add(settled["mono_s"], reading_um)
        return parts["held"]

    def result(self) -> HeldError:
        """The figures until now: of the true centre if it is known, else of the reading."""
        true = self.true_1s_um.result()
        of: ErrorOf = "true" if true["seconds"] else "reading"
        found = true if of == "true" else self.reading_1s_um.result()
        return HeldError(
            of, int(found["seconds"]), found["mean_um"], found["std_um"], found["in_band"]
        )
