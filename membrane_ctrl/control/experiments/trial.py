"""One experiment of a running hold: made from its specification, stepped in ticks, guarded."""

from dataclasses import dataclass, field

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control.experiments import (
    excursion_guard,
    experiment,
    operating_point,
    patterned,
)
from membrane_ctrl.control.experiments.patterns import make_doublets, make_multisine, make_steps
from membrane_ctrl.control.experiments.pump_steps import PumpSteps, PumpStepsState
from membrane_ctrl.control.experiments.relay import Relay, RelayState, begin_relay
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.control.pump_curve import PumpCurve
from membrane_ctrl.model.state_tree import StateNode

PATTERNS = {"steps": make_steps, "doublets": make_doublets, "multisine": make_multisine}


@dataclass(slots=True)
class TrialState(StateNode):
    """An experiment in progress: what it was made of, and where it is."""

    spec: ExperimentSpec
    around: operating_point.OperatingPoint
    centre_um: float
    left_s: float
    guard: excursion_guard.GuardState = field(default_factory=excursion_guard.GuardState)
    # one of these
    relay: RelayState | None = None
    pattern: patterned.PatternState | None = None
    pump_steps: PumpStepsState | None = None


def begin_trial(
    spec: ExperimentSpec, loop: LoopConfig, pump: PumpConfig, centre_um: float
) -> TrialState:
    """Return the state of an experiment that begins.

    Parameters
    ----------
    spec : ExperimentSpec
        Kind, duration, excursion and operating point, as a session sends them.
    loop, pump : LoopConfig, PumpConfig
        Range and rate of the flow.
    centre_um : float
        Displacement about which the mirror moves.
    """
    around = operating_point.OperatingPoint(
        holding_flow_um_per_s=spec.holding_flow_um_per_s,
        least_flow_um_per_s=PumpCurve(pump).least_flow_um_per_s,
        full_flow_um_per_s=loop.flow_most_um_per_s(pump),
        laser_um=spec.laser_um,
        limit_um=spec.limit_um,
        late_s=spec.late_s,
    )
    around = operating_point.choose_filters(around, loop.rate_hz)
    begun = TrialState(spec, around, centre_um, spec.duration_s)
    match spec.kind:
        case "relay":
            begun.relay = begin_relay(around)
        case "pump_map":
            begun.pump_steps = PumpStepsState()
        case _:
            begun.pattern = patterned.PatternState()
    return begun


class Trial:
    """An experiment inside its guard.

    Raises ValueError if the pump has no room around the holding flow, or the noise fills the limit;
    the message names what would help.

    Parameters
    ----------
    memory : TrialState
        See `begin_trial`.
    rate_hz : float
        Tick rate.
    """

    def __init__(self, memory: TrialState, rate_hz: float) -> None:
        self.memory = memory
        self._guard = excursion_guard.ExcursionGuard(
            self._make_machine(), memory.around, memory.centre_um, rate_hz, self.raw, memory.guard
        )

    def _make_machine(self) -> experiment.Experiment:
        memory, spec, around = self.memory, self.memory.spec, self.memory.around
        if spec.kind == "relay":
            return Relay(around, memory.centre_um, spec.duration_s, memory.relay)
        if spec.kind == "pump_map":
            if not spec.steps:
                raise ValueError("a pump map without steps: use `tune pump`")
            return PumpSteps(memory.centre_um, spec.steps, around.stretch, memory.pump_steps)
        wave = PATTERNS[spec.kind](around, spec.gain)
        return patterned.Patterned(around, wave, spec.duration_s, memory.centre_um, memory.pattern)

    @property
    def spec(self) -> ExperimentSpec:
        """What was asked for."""
        return self.memory.spec

    @property
    def raw(self) -> bool:
        """Its answers are pump commands (0..1), not flows."""
        return self.spec.kind == "pump_map"

    def step(self, measurement: experiment.BenchSample, dt_s: float) -> float | experiment.Finished:
        """Run one tick as `Experiment.step` does; a raw experiment gives pump commands."""
        self.memory.left_s -= dt_s
        if self.raw and self.memory.left_s < 0:
            return experiment.Finished(
                experiment.ExperimentEnd.OVERDUE,
                f"not done within {self.spec.duration_s:g} s: allow more time, or check the pump",
            )
        return self._guard.step(measurement, dt_s)
