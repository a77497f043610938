"""One experiment of a running hold: made of its specification, stepped in ticks, guarded, with its result."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from membrane_ctrl.config import LoopConfig, PumpConfig
from membrane_ctrl.control.experiments.machine import Around, ExcursionGuard, Experiment, Finished, Patterned
from membrane_ctrl.control.experiments.measurement import Measurement
from membrane_ctrl.control.experiments.patterns import doublets, multisine, steps
from membrane_ctrl.control.experiments.pump_map import PumpMapper
from membrane_ctrl.control.experiments.relay import Relay
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.control.pump_curve import PumpCurve

_PATTERNS = {"steps": steps, "doublets": doublets, "multisine": multisine}


class Trial:
    """An experiment inside its guard.

    Parameters
    ----------
    spec : ExperimentSpec
    loop, pump : LoopConfig, PumpConfig
        The pump's range, as configured.
    centre_um : float
        Where the mirror stands.

    Raises
    ------
    ValueError
        If the pump has no room about the holding flow, or the noise none in the limit; the message says what would
        help.
    """

    def __init__(self, spec: ExperimentSpec, loop: LoopConfig, pump: PumpConfig, centre_um: float) -> None:
        self.spec = spec
        self._mapper: PumpMapper | None = None
        around = Around(
            holding_flow_um_per_s=spec.holding_flow_um_per_s,
            least_flow_um_per_s=PumpCurve(pump).least_flow_um_per_s,
            full_flow_um_per_s=min(pump.flow_full_um_per_s, loop.flow_max_um_per_s),
            laser_um=spec.laser_um,
            limit_um=spec.limit_um,
        )
        machine = self._machine(around, pump, centre_um)
        self._guard = ExcursionGuard(machine, around, centre_um, loop.rate_hz)
        self._left_s = spec.duration_s

    def _machine(self, around: Around, pump: PumpConfig, centre_um: float) -> Experiment:
        spec = self.spec
        if spec.kind == "relay":
            return Relay(around, centre_um, spec.duration_s)
        if spec.kind == "pump_map":
            share = spec.holding_flow_um_per_s / pump.flow_full_um_per_s
            fraction = pump.dead_fraction + (1 - pump.dead_fraction) * share
            self._mapper = PumpMapper(centre_um, fraction, spec.holding_flow_um_per_s)
            return self._mapper
        return Patterned(around, _PATTERNS[spec.kind](around, spec.gain), spec.duration_s, centre_um)

    @property
    def raw(self) -> bool:
        """Its answers are pump commands (0..1), not flows."""
        return self.spec.kind == "pump_map"

    def step(self, measurement: Measurement, dt_s: float) -> float | Finished:
        """One tick: what to put out until the next reading, or the end."""
        self._left_s -= dt_s
        if self.raw and self._left_s < 0:
            return Finished(False, f"not done within {self.spec.duration_s:g} s: allow more time, or check the pump")
        return self._guard.step(measurement, dt_s)

    def result(self) -> dict[str, Any]:
        """What the experiment itself has measured, as plain data; None for what it did not find."""
        found = self._mapper.result if self._mapper is not None else None
        if found is None:
            return {}
        values = asdict(found)
        return {"pump_map": {name: None if math.isnan(value) else value for name, value in values.items()}}
