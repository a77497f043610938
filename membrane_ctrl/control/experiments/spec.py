"""Specification of an experiment: plain data with bounds, as it comes over the control port."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from firmware_iface.settings import Fraction, Section

_Short = AfterValidator(lambda value: round(value, 3))  # ninety steps fit one message
LIMIT_MAX_UM = 30.0
ExperimentKind = Literal["relay", "steps", "doublets", "multisine", "pump_map"]


class PumpStep(Section):
    """A command until the time is over or, if a height is given, the centre has sunk (command 0) or
    risen to it.
    """

    fraction: Annotated[Fraction, _Short]
    duration_s: Annotated[float, Field(ge=0.01, le=120), _Short]
    # from where the experiment began
    until_um: Annotated[float, Field(ge=-30, le=30), _Short] | None = None


class ExperimentSpec(Section):
    """A named, bounded experiment about the holding flow.

    What the bounds are for: half an hour of a person's time; an excursion that the safety table's
    following error (60 µm) never reaches; flows that a film pump can have.
    """

    version: Literal[1] = 1
    kind: ExperimentKind
    duration_s: Annotated[float, Field(ge=5, le=1800)] = 120.0  # the pump map ends when it is done
    limit_um: Annotated[float, Field(ge=3, le=LIMIT_MAX_UM)] = 10.0  # furthest from the setpoint
    holding_flow_um_per_s: Annotated[float, Field(gt=0, le=100)]  # mean of the hold before
    laser_um: Annotated[float, Field(ge=0, le=20)]  # standard deviation of a reading
    gain: Annotated[float, Field(ge=0.02, le=50)] = 1.0  # k, of what was identified so far
    late_s: Annotated[float, Field(ge=0, le=10)] = 0.4  # delay and lag, of the plant
    steps: Annotated[tuple[PumpStep, ...], Field(max_length=90)] = ()  # of the pump map
