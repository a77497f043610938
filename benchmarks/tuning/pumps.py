"""Surveys of random pumps of another physics: curve or refusal, its error, and the excursion.

`python -m benchmarks.tuning.pumps --pumps 40` prints a line for each and the table of
docs/measurements/tuning.md; 5 s of CPU for each. `--first 28 --pumps 1` looks at one, `--shape root
--full-um-per-s 3.1
--leak-um-per-s 2.1` at pumps of a kind.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np

from membrane_ctrl.model.telemetry import State
from tests.studies.pump_curve_error import worst_share
from tests.worlds import foreign_plant
from tuning.identification import pump_survey
from tuning.identification.experiments import ExperimentError
from tuning.identification.pump_survey import PumpSurvey
from tuning.rigs.hold_rig import HoldRig
from tuning.steps import map_pump
from tuning.twin_hold import TwinHold

RATE_HZ = 20.0
SETTLED_S = 60.0
OFF_MOST, OFF_MOST_GUSTY = 0.03, 0.05  # of the full flow


@dataclass(frozen=True)
class DrawnPump:
    """A bench of the second world; the configuration has the defaults."""

    seed: int
    shape: str
    full_um_per_s: float
    leak_um_per_s: float
    delay_s: float
    lag_s: float
    start: float
    stall: float
    play: float
    laser_um: float
    weather: float
    gusts: bool

    def plant(self) -> foreign_plant.ForeignPlant:
        """The bench in weather of its own."""
        pump = foreign_plant.ForeignPump(
            self.shape,
            self.full_um_per_s,
            self.delay_s,
            self.lag_s,
            self.start,
            self.stall,
            self.play,
        )
        return foreign_plant.ForeignPlant(
            pump, self.seed, self.weather, self.leak_um_per_s, self.gusts, self.laser_um
        )

    @property
    def named(self) -> str:
        """The pump in a few words."""
        return (
            f"{self.seed}: {self.shape}, {self.full_um_per_s:.1f} against "
            f"{self.leak_um_per_s:.1f} µm/s, "
            f"{self.delay_s:.2f} + {self.lag_s:.2f} s, laser {self.laser_um:.1f} "
            f"um{', gusty' if self.gusts else ''}"
        )


def drawn(seed: int) -> DrawnPump:
    """Any shape, full flow 1.2 to 20 times a leak of 0.5 to 3 µm/s, delay and lag together 0.15 to
    2 s.
    """
    rng = np.random.default_rng([20261123, seed])

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    shape = str(rng.choice(sorted(foreign_plant.CURVES)))
    leak = log(0.5, 3.0)
    full, late_s, share = leak * log(1.2, 20.0), log(0.15, 2.0), float(rng.uniform(0.2, 0.8))
    starts = next(
        (float(d) for d in np.linspace(0, 1, 1001) if foreign_plant.CURVES[shape](d) > 0), 0.0
    )
    stiction = float(rng.uniform(0.0, 0.08)) if rng.random() < 0.5 else 0.0
    return DrawnPump(
        seed=seed,
        shape=shape,
        full_um_per_s=full,
        leak_um_per_s=leak,
        delay_s=late_s * share,
        lag_s=late_s * (1 - share),
        start=starts + stiction if stiction else 0.0,
        stall=starts + stiction / 2 if stiction else 0.0,
        play=float(rng.uniform(0.01, 0.05)) if shape == "hysteretic" else 0.0,
        weather=log(0.3, 3.0),
        gusts=bool(rng.random() < 0.3),
        laser_um=log(0.3, 1.5),
    )


@dataclass(frozen=True)
class SurveyedPump:
    """What came of one."""

    drawn: DrawnPump
    off_share: float  # worst error of the curve, of the full flow; NaN without one
    levels_off: tuple[float, ...]  # each level's error in its standard errors
    excursion_um: float
    experiments_s: float
    whole_s: float
    refused: str

    @property
    def most(self) -> float:
        """The largest error that it may have."""
        return OFF_MOST_GUSTY if self.drawn.gusts else OFF_MOST


def surveyed(pump: DrawnPump, limit_um: float = 10.0) -> SurveyedPump:
    """Hold the bench with the default gains, then with cautious ones, and survey its pump."""
    plant = pump.plant()
    link = TwinHold(
        foreign_plant.foreign_config(rate_hz=RATE_HZ), bench=foreign_plant.foreign_bench(plant)
    )
    rig = HoldRig(link, "benchmark")
    rig.hold(SETTLED_S)
    map_pump._calm_hold(rig, limit_um)
    before, made = len(link.rows), list[PumpSurvey]()

    def survey(*given: float) -> PumpSurvey:
        made.append(PumpSurvey(*given))
        return made[-1]

    off, refused = math.nan, ""
    with patch.object(pump_survey, "PumpSurvey", survey):
        try:
            off = worst_share(map_pump._survey_pump(rig, limit_um), plant.pump)
        except (ExperimentError, ValueError) as error:
            refused = str(error)
    rows = [row for row in link.rows[before:] if row.state in (State.HOLD, State.TUNE)]
    return SurveyedPump(
        pump,
        off,
        _levels_off(made, plant.pump),
        max(abs(row.truth_displacement_um) for row in rows),
        made[0].duration_s if made else 0.0,
        len(rows) / RATE_HZ,
        refused,
    )


def _levels_off(made: Sequence[PumpSurvey], pump: foreign_plant.ForeignPump) -> tuple[float, ...]:
    found = []
    for level, at in made[0].fit.levels.items() if made else ():
        runs = level.fraction >= (pump.start if level.rising else pump.stall)
        drive = level.fraction + (-pump.play if level.rising else pump.play)
        true = pump.settled(0.0, max(drive, 0.0)) if runs else 0.0
        found.append((at.flow_um_per_s - true) / at.sigma_um_per_s)
    return tuple(found)


def table(rows: Sequence[SurveyedPump]) -> str:
    """The table of docs/measurements/tuning.md, and the pumps that are off, far, or refused, by
    name."""
    found = [row for row in rows if not row.refused]
    off = np.array([100 * row.off_share for row in found] or [math.nan])
    far = np.array([row.excursion_um for row in rows])
    levels = np.abs(np.concatenate([row.levels_off for row in rows]))
    minutes = np.array([(row.experiments_s, row.whole_s) for row in rows]) / 60
    beyond = sum(row.off_share > row.most for row in found)
    lines = [
        f"| {len(rows)} pumps | |",
        "|---|---|",
        f"| a curve is found | {len(found)} |",
        "| worst error over the curve, of the full flow: median, largest | "
        f"{np.median(off):.1f} %, {off.max():.1f} %: {beyond} beyond its limit (3 %, gusty 5 %) |",
        f"| levels within two standard errors | {np.mean(levels <= 2):.0%} of {levels.size} |",
        f"| furthest excursion: median, largest (limit 10 µm) | {np.median(far):.1f}, "
        f"{far.max():.1f} µm |",
        "| experiments; with the holds | {:.0f} min; {:.0f} min in the median |".format(
            *np.median(minutes, axis=0)
        ),
        "",
        "| pump | worst error | furthest | refused |",
        "|---|---|---|---|",
    ]
    for row in rows:
        if row.refused or row.off_share > row.most or row.excursion_um > 10.0:
            share = "" if row.refused else f"{100 * row.off_share:.1f} %"
            lines.append(
                f"| {row.drawn.named} | {share} | {row.excursion_um:.1f} µm | {row.refused} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Survey, a line each, then the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pumps", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--limit-um", type=float, default=10.0)
    parser.add_argument(
        "--shape", choices=sorted(foreign_plant.CURVES), help="of all, instead of any"
    )
    parser.add_argument("--full-um-per-s", type=float, help="likewise")
    parser.add_argument("--leak-um-per-s", type=float, help="likewise")
    given = parser.parse_args()
    common_settings = {
        name: getattr(given, name) for name in ("shape", "full_um_per_s", "leak_um_per_s")
    }
    common_settings = {name: value for name, value in common_settings.items() if value is not None}
    if "shape" in common_settings:  # the others are those of the shape drawn
        common_settings |= {
            "start": 0.0,
            "stall": 0.0,
            "play": 0.02 if given.shape == "hysteretic" else 0.0,
        }
    rows: list[SurveyedPump] = []
    for seed in range(given.first, given.first + given.pumps):
        rows.append(surveyed(replace(drawn(seed), **common_settings), given.limit_um))
        row = rows[-1]
        print(
            f"{row.drawn.named}: off {100 * row.off_share:.1f} %, furthest "
            f"{row.excursion_um:.1f} µm, "
            f"{row.experiments_s / 60:.0f} of {row.whole_s / 60:.0f} min {row.refused}",
            flush=True,
        )
    print(table(rows))


if __name__ == "__main__":
    main()
