"""A bench under the tuner's control: bumpless holds and experiments on one loop, each of which
gives a record.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.control import inner_loop, pump_curve
from membrane_ctrl.control.experiments import experiment, operating_point, trial
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.controller.commands import Command
from membrane_ctrl.model import events, shape_estimate, telemetry
from membrane_ctrl.sessions.live_hold import HoldError, HoldLink
from tuning.identification.loop_model import Record, Series


class DrivenBench(Protocol):
    """The bench a rig drives: the twin, a fitted model, or a live hold in its `tune` state."""

    def exchange(self, pump_fraction: float, vent_fraction: float) -> experiment.BenchSample:
        """Write the commands, wait for the next tick and return its reading."""
        ...


class Rig:
    """One loop on one bench, tick by tick; it starts with the flow `leak_um_per_s`."""

    def __init__(
        self, bench: DrivenBench, loop: LoopConfig, pump: PumpConfig, leak_um_per_s: float
    ) -> None:
        self._bench = bench
        self._config, self._pump = loop, pump
        self._loop = inner_loop.InnerLoop(loop, pump)
        self.dt_s = 1 / loop.rate_hz
        fraction = (
            pump_curve.PumpCurve(pump).command(leak_um_per_s, self.dt_s)
            if leak_um_per_s > 0
            else 0.0
        )
        self._last = bench.exchange(fraction, loop.bleed_fraction)
        self._loop.start(self._last.displacement_um, leak_um_per_s)

    def set_gains(self, loop: LoopConfig) -> None:
        """Change the gains without a bump."""
        self._config = loop
        self._loop.set_gains(loop)

    def hold(self, duration_s: float, target_um: float = 0.0) -> Record:
        """Hold at a target."""
        flows: list[float] = []
        samples: list[experiment.BenchSample] = []
        for _ in range(round(duration_s / self.dt_s)):
            out = self._loop.step(self._given(target_um), self.dt_s)
            flows.append(out.flow_um_per_s)
            samples.append(self._last)
            self._last = self._bench.exchange(out.pump_fraction, self._config.bleed_fraction)
        return Record.from_samples(self.dt_s, flows, samples)

    def perform(self, spec: ExperimentSpec) -> tuple[Record, experiment.Finished]:
        """Run an experiment about 0 until it finishes; the loop can hold afterwards."""
        begun = trial.begin_trial(spec, self._config, self._pump, 0.0)
        return self._run(trial.Trial(begun, self._config.rate_hz), spec.holding_flow_um_per_s)

    def _run(
        self, guard: experiment.Experiment, holding_flow_um_per_s: float
    ) -> tuple[Record, experiment.Finished]:
        flows: list[float] = []
        samples: list[experiment.BenchSample] = []
        while True:
            wanted = guard.step(self._last, self.dt_s)
            if isinstance(wanted, experiment.Finished):
                self._loop.resume(self._given(0.0), holding_flow_um_per_s, self.dt_s)
                return Record.from_samples(self.dt_s, flows, samples), wanted
            out = self._loop.follow(self._given(0.0), wanted, self.dt_s)
            flows.append(out.flow_um_per_s)
            samples.append(self._last)
            self._last = self._bench.exchange(out.pump_fraction, self._config.bleed_fraction)

    def around(self, held: Record, limit_um: float = 10.0) -> operating_point.Around:
        """Operating point of an experiment, from the hold before it."""
        return around_of(held, self._config, self._pump, limit_um)

    def _given(self, target_um: float) -> inner_loop.LoopInput:
        now = self._last
        return inner_loop.LoopInput(
            target_um, 0.0, now.displacement_um, now.ambient_pressure_pa, now.air_temperature_c
        )


def around_of(
    held: Record, loop: LoopConfig, pump: PumpConfig, limit_um: float
) -> operating_point.Around:
    """Operating point of an experiment, from the hold before it and the pump's range."""
    return operating_point.Around(
        holding_flow_um_per_s=float(held.flow_um_per_s.mean()),
        least_flow_um_per_s=pump_curve.PumpCurve(pump).least_flow_um_per_s,
        full_flow_um_per_s=loop.flow_most_um_per_s(pump),
        laser_um=laser_noise_um(held),
        limit_um=limit_um,
    )


def laser_noise_um(record: Record) -> float:
    """Standard deviation of a reading, from differences of successive readings: the mirror hardly
    moves in a tick.

    Uses the median, so that jumps do not count. Raises ValueError for fewer than two readings.
    """
    steps_um = np.diff(record.displacement_um[np.isfinite(record.displacement_um)])
    if steps_um.size == 0:
        raise ValueError("no reading of the mirror in the record")
    return float(np.median(np.abs(steps_um)) / 0.6745 / math.sqrt(2))


# A running hold under the tuner's control: the supervisor stays in charge; its ticks are the
# record.
#
# Successive records have no gap: each starts with the tick after the last one taken, so that what
# happens in between (a fit takes a second) is in the next record and not lost.

_FIGURE_LATE_S = 1.5  # a figure takes 0.1 s; after this long, none shows the tick
_WITHIN = 0.1  # of a tick: figures of about its time
_FIGURES_APART_S = 0.4  # further apart, a line between them shows nothing


class TicksByFigures:
    """Gives the ticks of a hold without a laser the displacement that the figures show at their
    time.

    A figure shows the mirror of some time before it arrives: a tick waits for the figures before
    and after it. In the telemetry it has the last figure that had arrived by then.
    """

    def __init__(self, config: Config) -> None:
        self._zero_um = 1e3 * config.optics.mirror.sag_mm
        self._asked_s = 1 / config.shape.track_rate_hz
        self._waiting: deque[telemetry.TelemetryRow] = deque()
        self._shown: deque[tuple[float, float]] = deque(
            [(-math.inf, math.nan)]
        )  # time, displacement
        self._intervals_s: list[float] = []

    @property
    def interval_s(self) -> float:
        """Time between figures: as asked for, or the median so far if that is longer."""
        return max(self._asked_s, float(np.median(self._intervals_s)) if self._intervals_s else 0.0)

    def take(
        self, rows: Sequence[telemetry.TelemetryRow], shapes: Sequence[shape_estimate.ShapeEstimate]
    ) -> list[telemetry.TelemetryRow]:
        """Return the ticks that are complete, of these and earlier ones; NaN where no figure shows
        the mirror.
        """
        self._waiting.extend(rows)
        for shape in shapes:
            newest_s = self._shown[-1][0]
            if shape.verdict != "rejected" and shape.kind != "full" and shape.time_s > newest_s:
                self._shown.append((shape.time_s, shape.sag_um - self._zero_um))
                self._intervals_s += [shape.time_s - newest_s] if math.isfinite(newest_s) else []
        done: list[telemetry.TelemetryRow] = []
        while self._waiting and (
            self._waiting[0].mono_s <= self._shown[-1][0]
            or self._waiting[-1].mono_s - self._waiting[0].mono_s > _FIGURE_LATE_S
        ):
            row = self._waiting.popleft()
            done.append(replace(row, displacement_um=self._at(row.mono_s)))
        return done

    def _at(self, time_s: float) -> float:
        while len(self._shown) > 1 and self._shown[1][0] <= time_s:
            self._shown.popleft()
        (before_s, before_um), (after_s, after_um) = (
            self._shown[0],
            self._shown[min(1, len(self._shown) - 1)],
        )
        if not before_s <= time_s <= after_s or after_s - before_s > _FIGURES_APART_S:
            return math.nan
        return before_um + (after_um - before_um) * (time_s - before_s) / max(
            after_s - before_s, 1e-9
        )


Progress = Callable[[float], None]  # seconds of hold recorded since the last call
_HELD = frozenset({telemetry.State.HOLD, telemetry.State.TUNE})
_ANSWER_TICKS = 500  # for the state to change after a command: 10 s at 50 Hz


class HoldRig:
    """Runs holds and experiments and sets gains on a running hold; every command is recorded with
    `who`.
    """

    def __init__(self, link: HoldLink, who: str, progress: Progress = lambda seconds: None) -> None:
        self._link, self._who, self._progress = link, who, progress
        self.seen: Callable[[telemetry.TelemetryRow], None] = lambda row: None  # each recorded tick
        self._rows: deque[telemetry.TelemetryRow] = deque()
        self._events: deque[events.Event] = deque()
        self._figures = TicksByFigures(link.config) if link.config.by_optics else None
        self._every = 0  # ticks of a reading; 0: not known yet
        self._state = math.nan  # of the newest tick
        self.loop, self.pump = link.config.loop, link.config.pump  # as last set
        self.good = self.loop, self.pump  # to go back to
        self.dt_s = 1 / self.loop.rate_hz
        self.shapes: list[shape_estimate.ShapeEstimate] = []  # all so far

    def hold(self, duration_s: float) -> Record:
        """Record the next seconds of hold. Raises HoldError if the
        mirror is not held throughout.
        """
        return self.record(self.ticks(duration_s))

    def ticks(self, duration_s: float) -> list[telemetry.TelemetryRow]:
        """As `hold`, but the ticks themselves."""
        return [self._next_held() for _ in range(round(duration_s / self.dt_s))]

    def hold_about(self, duration_s: float) -> tuple[Record, Series]:
        """As `hold`, with each sample's setpoint in µm, because the shape loop moves setpoint and
        mirror.
        """
        rows = self.ticks(duration_s)
        record = self.record(rows)
        ticks = np.array([row.tick + row.missed_ticks for row in rows])
        read = ticks[0] + self._every * np.arange(len(record))
        setpoints = np.interp(read, ticks, [row.setpoint_um for row in rows])
        return record, setpoints

    def around(self, held: Record, limit_um: float = 10.0) -> operating_point.Around:
        """Operating point of an experiment, from the hold before it."""
        return around_of(held, self.loop, self.pump, limit_um)

    def perform(self, spec: ExperimentSpec) -> tuple[Record, experiment.Finished]:
        """Let the controller run an experiment; the record ends with the tick that returns to hold.

        Raises HoldError if the experiment is refused or ends in a state other than hold.
        """
        rows, finished = self.performed(spec)
        return self.record(rows), finished

    def performed(
        self, spec: ExperimentSpec
    ) -> tuple[list[telemetry.TelemetryRow], experiment.Finished]:
        """As `perform`, with the ticks instead of a record."""
        self._events.clear()
        self._link.ask(Command("tune", self._who, f"tuning session: {spec.kind}", experiment=spec))
        rows: list[telemetry.TelemetryRow] = []
        begun = False
        while not begun or rows[-1].state == telemetry.State.TUNE:
            rows.append(self._next_held())
            begun = begun or rows[-1].state == telemetry.State.TUNE
            if not begun and len(rows) > _ANSWER_TICKS:
                raise HoldError("the hold accepted the experiment but did not begin it")
        told = self._experiment_ended()
        return rows, experiment.Finished(experiment.ExperimentEnd(told.end), told.reason)

    def set_gains(
        self,
        loop: LoopConfig,
        why: str = "tuning session",
        trial_s: float = math.nan,
        shape_s: float = math.nan,
        pump: PumpConfig | None = None,
        setpoint_step_um: float = math.nan,
    ) -> None:
        """Set gains without a bump; on trial, the hold restores the old ones unless `keep` follows.

        `shape_s`: time constant of the shape loop, `pump`: the pump's curve; NaN and None leave
        them. With `setpoint_step_um` the trial moves the setpoint too, with the shape loop off.
        """
        told = Command(
            "gains", self._who, why, trial_s, loop=loop, shape_time_constant_s=shape_s, pump=pump
        )
        self._link.ask(replace(told, setpoint_step_um=setpoint_step_um))
        self.loop, self.pump = loop, pump or self.pump

    def keep(self) -> None:
        """Keep the gains that are on trial."""
        self._link.ask(Command("keep", self._who, "verified"))

    def go_back(self) -> None:
        """End any running experiment and set the last good gains and curve."""
        self.end_experiment()
        if self.good != (self.loop, self.pump):
            self.set_gains(self.good[0], "back to the last good gains", pump=self.good[1])

    def end_experiment(self) -> None:
        """End the experiment that runs, perhaps that of a session that was killed, and discard its
        ticks.
        """
        self._take()
        if self._state != telemetry.State.TUNE:
            return
        self._link.ask(Command("hold", self._who, "tuning session interrupted"))
        while not self._rows or self._rows[-1].state == telemetry.State.TUNE:
            self._rows.clear()
            self._take()
        while self._rows[0].state == telemetry.State.TUNE:
            self._rows.popleft()

    def catch_up(self) -> None:
        """Discard the ticks so far: while a person thinks, nothing is recorded."""
        self._take()
        self._rows.clear()

    def record(self, rows: Sequence[telemetry.TelemetryRow]) -> Record:
        """Return ticks as an evenly sampled record; a skipped tick has no reading and keeps the
        flow.

        Without a laser there is a reading for each figure, and further ticks are taken until they
        are whole ones.
        """
        self._every = self._every or self._ticks_of_a_figure()
        rows = list(rows)
        while (
            rows
            and round(
                rows[-1].tick + rows[-1].missed_ticks - rows[0].tick - rows[0].missed_ticks + 1
            )
            % self._every
        ):
            rows.append(self._next_held())
        flows: list[float] = []
        samples: list[experiment.BenchSample] = []
        flow = next((row.flow_um_per_s for row in rows if math.isfinite(row.flow_um_per_s)), 0.0)
        tick = rows[0].tick + rows[0].missed_ticks if rows else 0.0
        for row in rows:
            place = row.tick + row.missed_ticks
            gap = max(0, round(place - tick))
            flows += [flow] * gap
            samples += [
                experiment.BenchSample(math.nan, row.ambient_pressure_pa, row.air_temperature_c)
            ] * gap
            flow = row.flow_um_per_s if math.isfinite(row.flow_um_per_s) else flow
            flows.append(flow)
            samples.append(
                experiment.BenchSample(
                    row.displacement_um, row.ambient_pressure_pa, row.air_temperature_c
                )
            )
            tick = place + 1
        return Record.from_samples(self.dt_s, flows, samples).every(self._every)

    def _ticks_of_a_figure(self) -> int:
        return (
            1
            if self._figures is None
            else max(1, math.ceil(self._figures.interval_s / self.dt_s - _WITHIN))
        )

    def _next_held(self) -> telemetry.TelemetryRow:
        while not self._rows:
            self._take()
        row = self._rows[0]
        if row.state not in _HELD:
            raise HoldError(
                "the mirror is not held (state "
                f"{telemetry.State(int(row.state)).name.lower()}): {self._why()}; "
                "start or resume the hold, then repeat this step"
            )
        self._progress(self.dt_s)
        self.seen(row)
        return self._rows.popleft()

    def _take(self) -> None:
        news = self._link.news()
        self._state = news.rows[-1].state if news.rows else self._state
        self._rows.extend(
            news.rows if self._figures is None else self._figures.take(news.rows, news.shapes)
        )
        self._events.extend(news.events)
        self.shapes += news.shapes

    def _experiment_ended(self) -> events.ExperimentEnded:
        """Return the newest end event, which may come a moment after its tick."""
        for _ in range(20):
            found = [event for event in self._events if isinstance(event, events.ExperimentEnded)]
            if found:
                return found[-1]
            self._take()
        raise HoldError("the hold did not report the end of the experiment")

    def _why(self) -> str:
        said = [event.why for event in self._events if isinstance(event, events.StateEntered)]
        return said[-1] if said else "no reason was given"
