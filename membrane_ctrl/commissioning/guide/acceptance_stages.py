"""Step 6: tune, hold for an hour, sign."""

import math
from dataclasses import dataclass, field

from membrane_ctrl.commissioning.guide import thresholds
from membrane_ctrl.commissioning.guide.inflation_stages import hold_depth, run_tuning_in_hold
from membrane_ctrl.commissioning.guide.stage import (
    StageContext,
)
from membrane_ctrl.commissioning.guide.stage_words import format_duration
from membrane_ctrl.model import events
from membrane_ctrl.model.telemetry import State, TelemetryRow
from membrane_ctrl.sessions.live_hold import HoldError

_REPORT_S = 600.0


@dataclass(slots=True)
class HoldFigures:
    """Sums over the ticks of a hold."""

    ticks: int = 0
    lost: int = 0  # ticks outside the state hold, or without an error
    sum_um: float = 0.0
    squares_um2: float = 0.0
    pump: float = 0.0
    worst_um: float = 0.0
    first_s: float = math.nan
    last_s: float = math.nan
    _second: list[float] = field(default_factory=list)

    def add_row(self, row: TelemetryRow) -> None:
        """Add a tick."""
        if math.isnan(self.first_s):
            self.first_s = row.mono_s
        self.last_s = row.mono_s
        self.ticks += 1
        if row.state != State.HOLD or not math.isfinite(row.error_um):
            self.lost += 1
            return
        self.sum_um += row.error_um
        self.squares_um2 += row.error_um**2
        self.pump += row.pump_fraction
        self._second.append(row.error_um)

    def end_second(self) -> None:
        """Judge the mean error of the ticks since the last call."""
        if self._second:
            mean_um = sum(self._second) / len(self._second)
            self.worst_um = max(self.worst_um, abs(mean_um))
        self._second.clear()

    @property
    def held(self) -> int:
        """Ticks in the state hold."""
        return self.ticks - self.lost

    @property
    def duration_s(self) -> float:
        """From the first to the last tick."""
        return self.last_s - self.first_s

    @property
    def std_um(self) -> float:
        """Standard deviation of the error; NaN if the mirror was not held."""
        if not self.held:
            return math.nan
        return math.sqrt(max(self.squares_um2 / self.held - (self.sum_um / self.held) ** 2, 0.0))

    @property
    def mean_pump(self) -> float:
        """Mean pump command; NaN if the mirror was not held."""
        return self.pump / self.held if self.held else math.nan


def tune_loop(context: StageContext) -> None:
    """Tune the loop with `tune run`."""
    context.dialogue.show("  `membrane-ctrl tune run` does it; about half an hour at a real bench")
    code = run_tuning_in_hold(context, "tune", "run")
    if code == 0 and context.access.simulated:
        context.note("gains", "tuned on the twin; not saved into a configuration with devices")
    context.require(
        "tuning",
        code == 0,
        f"exit code {code}",
        "read its messages; the default gains stay, which the hold below then judges",
    )


def hold_hour(context: StageContext) -> None:
    """Hold the mirror for an hour and judge it."""
    figures = HoldFigures()
    faults: list[str] = []
    rate_hz = context.config.loop.rate_hz
    try:
        with context.access.start_hold(context.folder, context.config, "acceptance") as link:
            hold_depth(context, link, context.config.loop.setpoint_um)
            shown_s = 0.0
            # Until the time is over; a fault ends it early.
            while not figures.duration_s >= context.plan.hold_s:
                news = link.read_news()
                faults += [
                    event.sentence for event in news.events if isinstance(event, events.Fault)
                ]
                if faults:
                    break
                for row in news.rows:
                    figures.add_row(row)
                    if figures.ticks % round(rate_hz) == 0:
                        figures.end_second()
                if figures.duration_s - shown_s >= _REPORT_S:
                    shown_s = figures.duration_s
                    context.dialogue.show(
                        f"  {format_duration(shown_s)}: std {figures.std_um:.3f} µm, pump "
                        f"{figures.mean_pump:.2f}"
                    )
    except HoldError as error:
        faults.append(str(error))
    _judge_hold(context, figures, faults)


def _judge_hold(context: StageContext, figures: HoldFigures, faults: list[str]) -> None:
    # Ticks that a hold of this duration has at its rate; the first tick begins the duration.
    expected = max(1.0, figures.duration_s * context.config.loop.rate_hz)
    if not math.isfinite(expected):
        expected = 1.0
    missed = max(0.0, 1.0 - (figures.ticks - 1) / expected)
    context.note("held", format_duration(figures.duration_s))
    context.judge(
        "faults during the hold", float(len(faults)), thresholds.HOLD_FAULTS, "; ".join(faults)
    )
    if not figures.held:
        context.leave_out("error, pump and ticks of the hold", "the mirror was not held")
        return
    context.judge(
        "standard deviation of the error during the hold",
        figures.std_um,
        thresholds.HOLD_STD,
        "tune the loop; look for draught and vibration",
    )
    context.judge(
        "largest mean error of one second during the hold",
        figures.worst_um,
        thresholds.HOLD_WORST,
        "look at that time in `membrane-ctrl review last`",
    )
    context.judge(
        "mean pump command during the hold",
        figures.mean_pump,
        thresholds.HOLD_PUMP,
        "find the leak, or fit a larger pump",
    )
    context.judge(
        "ticks that did not run",
        missed,
        thresholds.HOLD_MISSED,
        "move other work off this machine (docs/how-to/operations.md, Deadlines)",
    )
