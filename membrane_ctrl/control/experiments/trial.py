"""One experiment of a running hold: made of its specification, stepped in ticks, guarded, with its result."""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from firmware_iface.settings import Fraction, Section
from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control.experiments import machine
from membrane_ctrl.control.gas import PumpCurve

# Specification of an experiment: plain data with bounds, as it comes over the control port.


_Short = AfterValidator(lambda value: round(value, 3))  # ninety steps fit one message


class PumpStep(Section):
    """A command until the time is over or, if a height is given, the centre has sunk (command 0) or risen to it."""

    fraction: Annotated[Fraction, _Short]
    duration_s: Annotated[float, Field(ge=0.01, le=120), _Short]
    until_um: Annotated[float, Field(ge=-30, le=30), _Short] | None = None  # from where the experiment began


LIMIT_MAX_UM = 30.0
ExperimentKind = Literal["relay", "steps", "doublets", "multisine", "pump_map"]


class ExperimentSpec(Section):
    """A named, bounded experiment about the holding flow.

    What the bounds are for: half an hour of a person's time; an excursion that the safety table's following error
    (60 um) never sees; flows that a film pump can have.
    """

    version: Literal[1] = 1
    kind: ExperimentKind
    duration_s: Annotated[float, Field(ge=5, le=1800)] = 120.0  # the pump map ends when it is done
    limit_um: Annotated[float, Field(ge=3, le=LIMIT_MAX_UM)] = 10.0  # furthest from the setpoint
    holding_flow_um_per_s: Annotated[float, Field(gt=0, le=100)]  # mean of the hold before
    laser_um: Annotated[float, Field(ge=0, le=20)]  # standard deviation of a reading
    gain: Annotated[float, Field(ge=0.02, le=50)] = 1.0  # k, of what was identified so far
    steps: Annotated[tuple[PumpStep, ...], Field(max_length=90)] = ()  # of the pump map


class PumpSteps:
    """The experiment behind the pump's curve: constant pump commands, 0..1; the mirror is the flow meter.

    The session (`tuning`) decides which commands, for how long and until which height, between two experiments.
    """

    def __init__(self, centre_um: float, steps: Sequence[PumpStep], stretch: float = 1.0) -> None:
        self._centre_um = centre_um
        self._steps = list(steps)
        self._motion = machine.CentreMotion(stretch)
        self._in_step_s = 0.0

    def step(self, measurement: machine.BenchSample, dt_s: float) -> float | machine.Finished:
        """One tick: the command until the next reading, or the end."""
        self._motion.update(measurement.displacement_um, dt_s)
        self._in_step_s += dt_s
        if self._over():
            self._steps.pop(0)
            self._in_step_s = 0.0
        return self._steps[0].fraction if self._steps else machine.Finished(True, "pump mapped")

    def _over(self) -> bool:
        """Whether the present step is."""
        now, off_um = self._steps[0], self._motion.position_um - self._centre_um
        if now.until_um is not None and (off_um <= now.until_um if now.fraction == 0 else off_um >= now.until_um):
            return True
        return self._in_step_s > now.duration_s


_PATTERNS = {"steps": machine.steps, "doublets": machine.doublets, "multisine": machine.multisine}


class Trial:
    """An experiment inside its guard, about `centre_um`.

    Raises ValueError if the pump has no room around the holding flow, or the noise fills the limit; the message says
    what would help.
    """

    def __init__(self, spec: ExperimentSpec, loop: LoopConfig, pump: PumpConfig, centre_um: float) -> None:
        self.spec = spec
        around = machine.Around(
            holding_flow_um_per_s=spec.holding_flow_um_per_s,
            least_flow_um_per_s=PumpCurve(pump).least_flow_um_per_s,
            full_flow_um_per_s=loop.flow_most_um_per_s(pump),
            laser_um=spec.laser_um,
            limit_um=spec.limit_um,
            stretch=machine.quiet_stretch(spec.laser_um, spec.limit_um, loop.rate_hz),
        )
        experiment = self._machine(around, centre_um)
        self._guard = machine.ExcursionGuard(experiment, around, centre_um, loop.rate_hz)
        self._left_s = spec.duration_s

    def _machine(self, around: machine.Around, centre_um: float) -> machine.Experiment:
        spec = self.spec
        if spec.kind == "relay":
            return machine.Relay(around, centre_um, spec.duration_s)
        if spec.kind == "pump_map":
            if not spec.steps:
                raise ValueError("a pump map without steps: use `tune pump`")
            return PumpSteps(centre_um, spec.steps, around.stretch)
        return machine.Patterned(around, _PATTERNS[spec.kind](around, spec.gain), spec.duration_s, centre_um)

    @property
    def raw(self) -> bool:
        """Its answers are pump commands (0..1), not flows."""
        return self.spec.kind == "pump_map"

    def step(self, measurement: machine.BenchSample, dt_s: float) -> float | machine.Finished:
        """One tick: what to put out until the next reading, or the end."""
        self._left_s -= dt_s
        if self.raw and self._left_s < 0:
            return machine.Finished(
                False, f"not done within {self.spec.duration_s:g} s: allow more time, or check the pump"
            )
        return self._guard.step(measurement, dt_s)
