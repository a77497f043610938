"""One experiment of a running hold: made of its specification, stepped in ticks, guarded, with its
result.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from firmware_iface.settings import Fraction, Section
from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control.experiments import machine
from membrane_ctrl.control.gas import PumpCurve
from membrane_ctrl.model.state_tree import Count, StateNode

# Specification of an experiment: plain data with bounds, as it comes over the control port.


_Short = AfterValidator(lambda value: round(value, 3))  # ninety steps fit one message


class PumpStep(Section):
    """A command until the time is over or, if a height is given, the centre has sunk (command 0) or
    risen to it.
    """

    fraction: Annotated[Fraction, _Short]
    duration_s: Annotated[float, Field(ge=0.01, le=120), _Short]
    # from where the experiment began
    until_um: Annotated[float, Field(ge=-30, le=30), _Short] | None = None


LIMIT_MAX_UM = 30.0
ExperimentKind = Literal["relay", "steps", "doublets", "multisine", "pump_map"]


class ExperimentSpec(Section):
    """A named, bounded experiment about the holding flow.

    What the bounds are for: half an hour of a person's time; an excursion that the safety table's
    following error (60 µm) never sees; flows that a film pump can have.
    """

    version: Literal[1] = 1
    kind: ExperimentKind
    duration_s: Annotated[float, Field(ge=5, le=1800)] = 120.0  # the pump map ends when it is done
    limit_um: Annotated[float, Field(ge=3, le=LIMIT_MAX_UM)] = 10.0  # furthest from the setpoint
    holding_flow_um_per_s: Annotated[float, Field(gt=0, le=100)]  # mean of the hold before
    laser_um: Annotated[float, Field(ge=0, le=20)]  # standard deviation of a reading
    gain: Annotated[float, Field(ge=0.02, le=50)] = 1.0  # k, of what was identified so far
    late_s: Annotated[float, Field(ge=0, le=10)] = 0.4  # delay and lag, likewise
    steps: Annotated[tuple[PumpStep, ...], Field(max_length=90)] = ()  # of the pump map


@dataclass(slots=True)
class PumpStepsState(StateNode):
    """Where a pump map is."""

    motion: machine.MotionState = field(default_factory=machine.MotionState)
    in_step_s: float = 0.0
    steps_done: Count = 0


class PumpSteps:
    """The experiment behind the pump's curve: constant pump commands, 0..1; the mirror is the flow
    meter.

    The session (`tuning`) decides which commands, for how long and until which height, between two
    experiments.
    """

    def __init__(
        self,
        centre_um: float,
        steps: Sequence[PumpStep],
        stretch: float = 1.0,
        memory: PumpStepsState | None = None,
    ) -> None:
        self.memory = memory or PumpStepsState()
        self._centre_um = centre_um
        self._steps = steps
        self._motion = machine.CentreMotion(stretch, memory=self.memory.motion)

    def step(self, measurement: machine.BenchSample, dt_s: float) -> float | machine.Finished:
        """One tick: the command until the next reading, or the end."""
        self._motion.update(measurement.displacement_um, dt_s)
        memory = self.memory
        memory.in_step_s += dt_s
        if self._over():
            memory.steps_done += 1
            memory.in_step_s = 0.0
        if memory.steps_done == len(self._steps):
            return machine.Finished(machine.ExperimentEnd.COMPLETED, "pump mapped")
        return self._steps[memory.steps_done].fraction

    def _over(self) -> bool:
        """Whether the present step is."""
        now, off_um = (
            self._steps[self.memory.steps_done],
            self._motion.position_um - self._centre_um,
        )
        if now.until_um is not None and (
            off_um <= now.until_um if now.fraction == 0 else off_um >= now.until_um
        ):
            return True
        return self.memory.in_step_s > now.duration_s


# Flows in time for `Patterned`, sized so that the mirror stays within a few µm. Each takes the
# identified gain: the same excursion on a strong and a weak pump.

Pattern = Callable[[float], float]

_SHARE = 0.25  # of the excursion limit: the weather, the pull and the laser's noise need the rest


def steps(around: machine.Around, gain: float, hold_s: float = 2.0) -> Pattern:
    """Up, back, down, back, each for `hold_s`: easy to judge by eye."""
    up, down = machine.room(around)
    size = min(up, down, _SHARE * around.limit_um / (gain * hold_s))
    levels = (size, 0.0, -size, 0.0)
    return lambda time_s: levels[int(time_s / hold_s) % 4]


def doublets(around: machine.Around, gain: float, pulse_s: float = 0.3) -> Pattern:
    """Short pulses up, each followed by an equal one down: many steep edges, which separate dead
    time from lag.

    The downward flow is limited by the leak, so it takes longer; the mean flow is the holding flow.
    """
    up, down = machine.room(around)
    size = min(up, _SHARE * around.limit_um / (gain * pulse_s))
    down = min(down, size)
    period_s = pulse_s * (1 + size / down)
    return lambda time_s: size if time_s % period_s < pulse_s else -down


def multisine(
    around: machine.Around,
    gain: float,
    slowest_rad_per_s: float = 0.3,
    fastest_rad_per_s: float = 6.0,
    tones: int = 12,
) -> Pattern:
    """Sines evenly spaced in the logarithm of frequency, of equal excursion up to the pump's room.

    Phases by Schroeder (1970), -pi n (n - 1) / N, which keep the peak low.
    """
    w = np.geomspace(slowest_rad_per_s, fastest_rad_per_s, tones)
    phases = -math.pi * np.arange(tones) * np.arange(1, tones + 1) / tones
    amplitudes = np.sqrt(w)  # flow between equal flow and equal excursion
    time_s = np.arange(0.0, 4 * math.pi / slowest_rad_per_s, 0.05)[:, None]
    flow = (amplitudes * np.sin(w * time_s + phases)).sum(axis=1)
    way = (amplitudes / w * np.cos(w * time_s + phases)).sum(axis=1)
    scale = min(
        min(machine.room(around)) / np.abs(flow).max(),
        _SHARE * around.limit_um / (gain * np.abs(way).max()),
    )
    return lambda now_s: float(scale * (amplitudes * np.sin(w * now_s + phases)).sum())


_PATTERNS = {"steps": steps, "doublets": doublets, "multisine": multisine}


@dataclass(slots=True)
class TrialState(StateNode):
    """An experiment in progress: what it was made of, and where it is."""

    spec: ExperimentSpec
    around: machine.Around
    centre_um: float
    left_s: float
    guard: machine.GuardState = field(default_factory=machine.GuardState)
    # one of these
    relay: machine.RelayState | None = None
    pattern: machine.PatternState | None = None
    pump_steps: PumpStepsState | None = None


def begin_trial(
    spec: ExperimentSpec, loop: LoopConfig, pump: PumpConfig, centre_um: float
) -> TrialState:
    """The state of an experiment that begins about `centre_um`."""
    around = machine.Around(
        holding_flow_um_per_s=spec.holding_flow_um_per_s,
        least_flow_um_per_s=PumpCurve(pump).least_flow_um_per_s,
        full_flow_um_per_s=loop.flow_most_um_per_s(pump),
        laser_um=spec.laser_um,
        limit_um=spec.limit_um,
        late_s=spec.late_s,
    )
    around = machine.quieted(around, loop.rate_hz)
    begun = TrialState(spec, around, centre_um, spec.duration_s)
    match spec.kind:
        case "relay":
            begun.relay = machine.begin_relay(around)
        case "pump_map":
            begun.pump_steps = PumpStepsState()
        case _:
            begun.pattern = machine.PatternState()
    return begun


class Trial:
    """An experiment inside its guard.

    Raises ValueError if the pump has no room around the holding flow, or the noise fills the limit;
    the message says what would help.

    Parameters
    ----------
    memory : TrialState
        See `begin_trial`.
    rate_hz : float
        Tick rate.
    """

    def __init__(self, memory: TrialState, rate_hz: float) -> None:
        self.memory = memory
        self._guard = machine.ExcursionGuard(
            self._make_machine(), memory.around, memory.centre_um, rate_hz, self.raw, memory.guard
        )

    def _make_machine(self) -> machine.Experiment:
        memory, spec, around = self.memory, self.memory.spec, self.memory.around
        if spec.kind == "relay":
            return machine.Relay(around, memory.centre_um, spec.duration_s, memory.relay)
        if spec.kind == "pump_map":
            if not spec.steps:
                raise ValueError("a pump map without steps: use `tune pump`")
            return PumpSteps(memory.centre_um, spec.steps, around.stretch, memory.pump_steps)
        wave = _PATTERNS[spec.kind](around, spec.gain)
        return machine.Patterned(around, wave, spec.duration_s, memory.centre_um, memory.pattern)

    @property
    def spec(self) -> ExperimentSpec:
        """What was asked for."""
        return self.memory.spec

    @property
    def raw(self) -> bool:
        """Its answers are pump commands (0..1), not flows."""
        return self.spec.kind == "pump_map"

    def step(self, measurement: machine.BenchSample, dt_s: float) -> float | machine.Finished:
        """One tick: what to put out until the next reading, or the end."""
        self.memory.left_s -= dt_s
        if self.raw and self.memory.left_s < 0:
            return machine.Finished(
                machine.ExperimentEnd.OVERDUE,
                f"not done within {self.spec.duration_s:g} s: allow more time, or check the pump",
            )
        return self._guard.step(measurement, dt_s)
