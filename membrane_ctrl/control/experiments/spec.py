"""What may be asked of an experiment: plain data with bounds, so that it can come over a wire."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from membrane_ctrl.config import Section

ExperimentKind = Literal["relay", "steps", "doublets", "multisine", "pump_map"]


class ExperimentSpec(Section):
    """A named, bounded experiment about the holding flow.

    What the bounds are for: half an hour of a person's time; an excursion that the safety table's following error
    (60 um) never sees; flows that a film pump can have.
    """

    version: Literal[1] = 1
    kind: ExperimentKind
    duration_s: Annotated[float, Field(ge=5, le=1800)] = 120.0  # the pump map ends when it is done
    limit_um: Annotated[float, Field(ge=3, le=30)] = 10.0  # furthest from the setpoint
    holding_flow_um_per_s: Annotated[float, Field(gt=0, le=100)]  # mean of the hold before
    laser_um: Annotated[float, Field(ge=0, le=20)]  # standard deviation of a reading
    gain: Annotated[float, Field(ge=0.02, le=50)] = 1.0  # k, of what was identified so far
