"""Maps the pump at low commands, measured on the mirror: leak, start, stall, and flow against command.

The mirror is the flow meter: its speed is the flow less the leak. A probe is a few seconds of one command, from
rest or from running; between probes the mirror returns to where it stood. Start and stall come from bisection, the
leak from a probe with the pump off, the curve from two commands above.
"""

import math
from collections.abc import Generator
from dataclasses import asdict, dataclass

import numpy as np

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control import film_health, filters
from membrane_ctrl.control.experiments.machine import BenchSample, CentreMotion, Finished

_PREPARE_S = 1.0  # seven lags of the pump: it stands, or runs
_PROBE_MIN_S, _PROBE_MAX_S = 1.5, 5.0
_TRAVEL_UM = 6.0  # of a probe in which the mirror sinks
_SKIP_S = 0.8  # of a probe: transport and five lags
_NEAR_UM = 1.0
_REPEATS = 3
_CURVE_STEP = 0.2  # between the two commands that give the curve: flows of about one and two leaks
_RETURN_MAX_S = 60.0
_RUN_FRACTION = 0.45  # surely running
_START_BISECTIONS, _STALL_BISECTIONS = 5, 3  # each to about 0.015
_HIGHEST = 0.40
# Share of the flow a running pump would give at the command, from which on it counts as running.
_RUNS_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class PumpMap:
    """What was measured."""

    leak_um_per_s: float  # speed at which the mirror sinks with the pump off; the bleed counts
    leak_sigma_um_per_s: float  # its standard error, from the scatter of the probes
    start_fraction: float  # where a standing pump starts, within 0.01; NaN if it never did
    stall_fraction: float  # where a running one stalls, likewise
    dead_fraction: float  # of q = q_full (d - dead) / (1 - dead)
    flow_full_um_per_s: float
    too_tight: bool  # the mirror loses too little gas to be held: open the bleed

    @property
    def sticks_by(self) -> float:
        """Stiction: the command between stalling and starting."""
        return self.start_fraction - self.stall_fraction

    def as_plain(self) -> dict[str, float | None]:
        """As plain data; None for what was not found."""
        return {name: None if math.isnan(value) else value for name, value in asdict(self).items()}

    def applied_to(self, pump: PumpConfig) -> PumpConfig:
        """The pump's configuration with what was measured. Raises pydantic.ValidationError if it is no pump's."""
        measured = {
            "flow_full_um_per_s": self.flow_full_um_per_s,
            "dead_fraction": self.dead_fraction,
            "start_fraction": self.start_fraction,
            "stall_fraction": self.stall_fraction,
        }
        return PumpConfig.model_validate(pump.model_dump() | measured)


@dataclass(frozen=True, slots=True)
class PumpProbe:
    """One command after a preparation at another: 0 (standing) or running."""

    prepare_fraction: float
    fraction: float


class PumpMapper:
    """Step machine of the pump map; its answers are pump commands, 0..1.

    `holding_fraction` is the command that about holds the mirror; its flow says how fast the mirror sinks without it.
    """

    def __init__(
        self,
        centre_um: float,
        holding_fraction: float,
        holding_flow_um_per_s: float,
    ) -> None:
        self._centre_um = centre_um
        self._holding_fraction = holding_fraction
        self._probe_s = min(max(_TRAVEL_UM / holding_flow_um_per_s - _PREPARE_S, _PROBE_MIN_S), _PROBE_MAX_S)
        self._sinking_um_per_s: list[float] = []
        self._motion = CentreMotion()
        self._plan = self._probes()
        self._probe = next(self._plan)
        self._returning, self._in_phase_s = True, 0.0
        self._speed = filters.Slope()
        self._speed_um_per_s = math.nan
        self.result: PumpMap | None = None

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """One tick: the command until the next reading, or the end."""
        self._motion.update(measurement.displacement_um, dt_s)
        self._in_phase_s += dt_s
        if self._returning:
            return self._return()
        since_s = self._in_phase_s - _PREPARE_S
        if since_s <= 0:
            return self._probe.prepare_fraction
        if since_s > _SKIP_S:
            self._speed.add(since_s, measurement.displacement_um)
        if since_s < self._probe_s:
            return self._probe.fraction
        self._speed_um_per_s = self._speed.per_s
        self._returning, self._in_phase_s = True, 0.0
        try:
            self._probe = next(self._plan)
        except StopIteration:
            return Finished(True, "pump mapped")
        return self._return()

    def _return(self) -> float | Finished:
        """Bring the mirror to where the next probe will take it through the middle of its way."""
        sinks = self._probe.fraction < self._holding_fraction
        off_um = self._motion.position_um - self._centre_um - (_TRAVEL_UM / 2 if sinks else -_TRAVEL_UM / 2)
        if abs(off_um) < _NEAR_UM:
            self._returning, self._in_phase_s, self._speed = False, 0.0, filters.Slope()
            return self._probe.prepare_fraction
        if self._in_phase_s > _RETURN_MAX_S:
            way = "sink" if off_um > 0 else "rise"
            return Finished(False, f"the mirror did not {way} back in {_RETURN_MAX_S:g} s: too tight, or no pump")
        return 0.0 if off_um > 0 else max(_RUN_FRACTION, self._holding_fraction)

    def _mean_flow(self, prepare_fraction: float, fraction: float) -> Generator[PumpProbe, None, float]:
        """Mean of some measurements: one has an error of 0.1 um/s, and just above stalling there is no more flow."""
        total = 0.0
        for _ in range(_REPEATS):
            total += yield from self._flow(prepare_fraction, fraction)
        return total / _REPEATS

    def _flow(self, prepare_fraction: float, fraction: float) -> Generator[PumpProbe, None, float]:
        """Flow at a command: speed with it less speed without the pump, one right after the other.

        So the leak and the slow weather, which is as large as the flows in question, are in both.
        """
        yield PumpProbe(0.0, 0.0)
        self._sinking_um_per_s.append(-self._speed_um_per_s)
        yield PumpProbe(prepare_fraction, fraction)
        return self._speed_um_per_s + self._sinking_um_per_s[-1]

    def _probes(self) -> Generator[PumpProbe, None, None]:
        """The plan, as a coroutine: each probe's speed is there when the next one is asked for."""
        low = self._holding_fraction + 0.02
        less = yield from self._mean_flow(_RUN_FRACTION, low)
        more = yield from self._mean_flow(_RUN_FRACTION, low + _CURVE_STEP)
        slope = (more - less) / _CURVE_STEP
        dead = max(0.0, low - less / slope) if slope > 0 else 0.0
        start = yield from self._edge(0.0, dead, _HIGHEST, _START_BISECTIONS, slope, dead)
        highest = start if math.isfinite(start) else _HIGHEST
        stall = yield from self._edge(_RUN_FRACTION, dead, highest, _STALL_BISECTIONS, slope, dead)
        leak = float(np.mean(self._sinking_um_per_s))
        self.result = PumpMap(
            leak_um_per_s=leak,
            leak_sigma_um_per_s=float(np.std(self._sinking_um_per_s, ddof=1))
            / math.sqrt(len(self._sinking_um_per_s)),
            start_fraction=start,
            stall_fraction=stall,
            dead_fraction=dead,
            flow_full_um_per_s=slope * (1 - dead),
            too_tight=leak < film_health.TOO_TIGHT_UM_PER_S,
        )

    def _edge(
        self, prepare_fraction: float, off: float, on: float, steps: int, slope: float, dead: float
    ) -> Generator[PumpProbe, None, float]:
        """Lowest command at which a standing (or running) pump runs, by bisection; NaN if none up to `on` does."""
        highest = on
        for _ in range(steps):
            middle = (off + on) / 2
            flow = yield from self._mean_flow(prepare_fraction, middle)
            off, on = (off, middle) if flow > _RUNS_SHARE * slope * (middle - dead) else (middle, on)
        return on if on < highest else math.nan
