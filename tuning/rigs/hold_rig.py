"""A running hold under the tuner's control; its ticks are the record.

The supervisor stays in charge.

Successive records have no gap: each starts with the tick after the last one taken, so that what
happens in between (a fit takes a second) is in the next record and not lost.
"""

import itertools
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control.experiments import experiment, operating_point
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.controller.command import Command
from membrane_ctrl.model import events, shape_estimate, telemetry
from membrane_ctrl.sessions.live_hold import HoldError, HoldLink
from tuning.identification.record import Record, Series
from tuning.rigs.operating_point import make_operating_point
from tuning.rigs.ticks_by_figures import TicksByFigures

_WITHIN = 0.1  # of a tick: figures of about its time
# Repeats for each sample of the laser up to which a tick is a reading; the fit bears them
_REPEATS_TOLERATED = 0.35
Progress = Callable[[float], None]  # seconds of hold recorded since the last call
_HELD = frozenset({telemetry.State.HOLD, telemetry.State.TUNE})
# Ticks after a command in which its experiment must begin: 10 s at 50 Hz
_ANSWER_TICKS = 500
# An experiment whose reading was lost is repeated so often, after so long with a reading
_REPEATS_MOST = 3
_READING_BACK_S = 5.0
_REFUSALS_MOST = 5  # of an experiment, while the safety table holds the mean flow


class HoldRig:
    """Runs holds and experiments and sets gains on a running hold.

    Parameters
    ----------
    link : HoldLink
        To the hold, whose command this session has.
    who : str
        Recorded with every command.
    progress : callable
        Gets the seconds of hold recorded since its last call.
    """

    def __init__(self, link: HoldLink, who: str, progress: Progress = lambda seconds: None) -> None:
        self._link = link
        self._who = who
        self._progress = progress
        self.seen: Callable[[telemetry.TelemetryRow], None] = lambda row: None  # each recorded tick
        self._rows: deque[telemetry.TelemetryRow] = deque()
        self._events: deque[events.Event] = deque()
        self._figures = TicksByFigures(link.config) if link.config.by_optics else None
        self._every = 0  # ticks of a reading; 0: not known yet
        self._state = math.nan  # of the newest tick
        self._tick = math.nan  # its number
        self._reads = 0  # of news
        self.held_s = 0.0  # of all ticks so far
        self.gaps_s: list[float] = []  # times without a reading in them, the last one perhaps open
        self._was_lost = False
        self.repeated = 0  # experiments that were repeated because the reading was lost
        self.loop, self.pump = link.config.loop, link.config.pump  # as last set
        self.good = self.loop, self.pump  # to go back to
        self.dt_s = 1 / self.loop.rate_hz
        self.shapes: list[shape_estimate.ShapeEstimate] = []  # all so far

    def hold(self, duration_s: float) -> Record:
        """Record the next seconds of hold.

        Raises HoldError if the mirror is not held throughout.
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

    def around(self, held: Record, limit_um: float = 10.0) -> operating_point.OperatingPoint:
        """Return the operating point of an experiment.

        Parameters
        ----------
        held : Record
            The hold before it: its mean flow and noise.
        limit_um : float
            How far the mirror may move from the setpoint.
        """
        return make_operating_point(held, self.loop, self.pump, limit_um)

    def perform(self, spec: ExperimentSpec) -> tuple[Record, experiment.Finished]:
        """Let the controller run an experiment; the record ends with the tick that returns to hold.

        Raises HoldError if the experiment is refused or ends in a state other than hold.
        """
        rows, finished = self.perform_ticks(spec)
        return self.record(rows), finished

    def perform_ticks(
        self, spec: ExperimentSpec
    ) -> tuple[list[telemetry.TelemetryRow], experiment.Finished]:
        """As `perform`, with the ticks instead of a record.

        An experiment that a lost reading ended is repeated, and the ticks of both are returned. A
        pump map is not: its session plans the next round by what the ended one has shown.
        """
        rows, finished = self._perform_once(spec)
        for _ in range(_REPEATS_MOST):
            lost = finished.end is experiment.ExperimentEnd.READING_LOST
            if not lost or spec.kind == "pump_map":
                break
            self.repeated += 1
            rows += self._wait_for_reading()
            more, finished = self._perform_once(spec)
            rows += more
        return rows, finished

    def _wait_for_reading(self) -> list[telemetry.TelemetryRow]:
        """Ticks until the safety table has held no mean flow for some seconds."""
        latest = rows = self.ticks(_READING_BACK_S)
        while any(row.safe_level for row in latest):
            latest = self.ticks(_READING_BACK_S)
            rows += latest
        return rows

    def _perform_once(
        self, spec: ExperimentSpec
    ) -> tuple[list[telemetry.TelemetryRow], experiment.Finished]:
        rows = self._request_experiment(spec)
        # Ticks that were queued before the request belong to the record, and are no answer to it:
        # the first read after the request has them all
        reads = self._reads
        asked_tick = math.nan
        begun = False
        while not begun or rows[-1].state == telemetry.State.TUNE:
            rows.append(self._next_held())
            begun = begun or rows[-1].state == telemetry.State.TUNE
            if math.isnan(asked_tick) and self._reads > reads:
                asked_tick = self._tick
            if not begun and rows[-1].tick - asked_tick > _ANSWER_TICKS:
                raise HoldError("the hold accepted the experiment but did not begin it")
        end = self._experiment_ended()
        return rows, experiment.Finished(experiment.ExperimentEnd(end.end), end.reason)

    def _request_experiment(self, spec: ExperimentSpec) -> list[telemetry.TelemetryRow]:
        """Ask for an experiment, again while a lost reading makes the hold refuse it; returns the
        ticks of the time between.
        """
        # A refusal is repeated only if the safety table held the mean flow around it, which is for
        # a reading that was lost for a moment. Any other refusal would come again.
        command = Command("tune", self._who, f"tuning session: {spec.kind}", experiment=spec)
        rows: list[telemetry.TelemetryRow] = []
        for number in range(_REFUSALS_MOST):
            self._events.clear()
            try:
                self._link.send_command(command)
                break
            except HoldError:
                waited = self.ticks(len(self._rows) * self.dt_s + _READING_BACK_S)
                about = waited[-round(2.0 * _READING_BACK_S / self.dt_s) :]
                if number == _REFUSALS_MOST - 1 or not any(row.safe_level for row in about):
                    raise
                rows += waited
        return rows

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

        Parameters
        ----------
        loop : LoopConfig
            The gains.
        why : str
            Reason, for the record.
        trial_s : float
            Duration of the trial; NaN: no trial.
        shape_s : float
            Time constant of the shape loop; NaN leaves it.
        pump : PumpConfig, optional
            The pump's curve; it stays without one.
        setpoint_step_um : float
            Step of the setpoint during the trial, with the shape loop off; NaN: none.
        """
        end = Command(
            "gains", self._who, why, trial_s, loop=loop, shape_time_constant_s=shape_s, pump=pump
        )
        self._link.send_command(replace(end, setpoint_step_um=setpoint_step_um))
        self.loop = loop
        self.pump = pump or self.pump

    def keep_gains(self) -> None:
        """Keep the gains that are on trial."""
        self._link.send_command(Command("keep", self._who, "verified"))

    def restore_good_gains(self) -> None:
        """End any running experiment and set the last good gains and curve."""
        self.end_experiment()
        if self.good != (self.loop, self.pump):
            self.set_gains(self.good[0], "back to the last good gains", pump=self.good[1])

    def end_experiment(self) -> None:
        """End the experiment that runs, perhaps that of a session that was killed, and discard its
        ticks.
        """
        self._read_news()
        if self._state != telemetry.State.TUNE:
            return
        self._link.send_command(Command("hold", self._who, "tuning session interrupted"))
        # The command takes effect some ticks later: drop the ticks until one shows another state,
        # and of the last news those that are still in the experiment.
        while not self._rows or self._rows[-1].state == telemetry.State.TUNE:
            self._rows.clear()
            self._read_news()
        while self._rows[0].state == telemetry.State.TUNE:
            self._rows.popleft()

    def catch_up(self) -> None:
        """Discard the ticks so far: while a person thinks, nothing is recorded."""
        self._read_news()
        self._rows.clear()

    def record(self, rows: Sequence[telemetry.TelemetryRow]) -> Record:
        """Return ticks as an evenly sampled record; a skipped tick has no reading and keeps the
        flow.

        Without a laser there is a reading for each figure, and with a laser that is slower than the
        ticks one for each of its samples; further ticks are taken until they are whole ones.
        """
        rows = list(rows)
        self._every = self._every or self._count_ticks_of_a_reading(rows)
        while rows and round(_count_ticks(rows[0], rows[-1])) % self._every:
            rows.append(self._next_held())
        flows, samples = _fill_skipped_ticks(rows)
        return Record.from_samples(self.dt_s, flows, samples).every(self._every)

    def _count_ticks_of_a_reading(self, rows: Sequence[telemetry.TelemetryRow]) -> int:
        """Ticks between readings: of figures, or of a laser that is slower than the ticks and
        repeats its samples in between.
        """
        if self._figures is not None:
            return max(1, math.ceil(self._figures.interval_s / self.dt_s - _WITHIN))
        counters = [row.sample_counter for row in rows if math.isfinite(row.sample_counter)]
        samples = sum(after != before for before, after in itertools.pairwise(counters))
        if not samples:
            return 1
        ticks_a_sample = (len(counters) - 1) / samples
        return max(1, math.ceil(ticks_a_sample - _REPEATS_TOLERATED))

    def _next_held(self) -> telemetry.TelemetryRow:
        while not self._rows:
            self._read_news()
        row = self._rows[0]
        if row.state not in _HELD:
            raise HoldError(
                "the mirror is not held (state "
                f"{telemetry.State(int(row.state)).name.lower()}): {self._explain_state()}; "
                "start or resume the hold, then repeat this step"
            )
        self._progress(self.dt_s)
        self.seen(row)
        self._count_losses(row)
        return self._rows.popleft()

    def _count_losses(self, row: telemetry.TelemetryRow) -> None:
        """Note whether this tick has a reading."""
        self.held_s += self.dt_s
        is_lost = math.isnan(row.displacement_um)
        if is_lost and not self._was_lost:
            self.gaps_s.append(0.0)
        if is_lost:
            self.gaps_s[-1] += self.dt_s
        self._was_lost = is_lost

    def _read_news(self) -> None:
        news = self._link.read_news()
        self._reads += 1
        if news.rows:
            self._state = news.rows[-1].state
            self._tick = news.rows[-1].tick
        self._rows.extend(
            news.rows if self._figures is None else self._figures.add_rows(news.rows, news.shapes)
        )
        self._events.extend(news.events)
        self.shapes += news.shapes

    def _experiment_ended(self) -> events.ExperimentEnded:
        """Return the newest end event, which may come a moment after its tick."""
        for _ in range(20):
            found = [event for event in self._events if isinstance(event, events.ExperimentEnded)]
            if found:
                return found[-1]
            self._read_news()
        raise HoldError("the hold did not report the end of the experiment")

    def _explain_state(self) -> str:
        """Why the hold is in its state, as its last event states."""
        reasons = [event.why for event in self._events if isinstance(event, events.StateEntered)]
        return reasons[-1] if reasons else "no reason was given"


def _tick_number(row: telemetry.TelemetryRow) -> float:
    """Number of a tick, with the skipped ones counted."""
    return row.tick + row.missed_ticks


def _count_ticks(first: telemetry.TelemetryRow, last: telemetry.TelemetryRow) -> float:
    """Ticks from one to another, both included, with the skipped ones."""
    return last.tick + last.missed_ticks - first.tick - first.missed_ticks + 1


def _fill_skipped_ticks(
    rows: Sequence[telemetry.TelemetryRow],
) -> tuple[list[float], list[experiment.BenchSample]]:
    """Flow after each tick, and its sample; a skipped tick has no reading and keeps the flow."""
    flows: list[float] = []
    samples: list[experiment.BenchSample] = []
    known = (row.flow_um_per_s for row in rows if math.isfinite(row.flow_um_per_s))
    flow = next(known, 0.0)
    expected = _tick_number(rows[0]) if rows else 0.0
    for row in rows:
        # Ticks between the last row and this one.
        skipped = max(0, round(_tick_number(row) - expected))
        no_reading = experiment.BenchSample(
            math.nan, row.ambient_pressure_pa, row.air_temperature_c
        )
        flows += [flow] * skipped
        samples += [no_reading] * skipped

        # This one.
        if math.isfinite(row.flow_um_per_s):
            flow = row.flow_um_per_s
        flows.append(flow)
        samples.append(
            experiment.BenchSample(
                row.displacement_um, row.ambient_pressure_pa, row.air_temperature_c
            )
        )
        expected = _tick_number(row) + 1
    return flows, samples
