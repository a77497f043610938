"""A recorded hold, replayed with another loop and the limits of its pump."""

import numpy as np

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control.experiments.experiment import BenchSample
from tuning.identification import plant_model
from tuning.identification.record import Record, Series
from tuning.proposal.driven_centre import DrivenCentre
from tuning.rigs.bench_rig import Rig

_START_S = 10.0


class _ReplayBench:
    """The readings of a record, with the motion by its pump replaced by that of other commands."""

    def __init__(
        self,
        record: Record,
        off_um: Series,
        model: plant_model.PlantModel,
        pump: PumpConfig,
    ) -> None:
        # The motion by the pump that held the mirror is taken out of the readings.
        self.flow_um_per_s = float(record.cut(0.0, _START_S).flow_um_per_s.mean())
        flows = np.append(self.flow_um_per_s, record.flow_um_per_s)
        driven = plant_model.compute_driven_um(flows, model.dead_time_s, model.lag_s, record.dt_s)
        own_um = model.gain * driven[1:]
        columns = (off_um - own_um, record.ambient_pressure_pa, record.air_temperature_c)
        self._rest = zip(*(column.tolist() for column in columns), strict=True)
        self._driven = DrivenCentre(model, pump, self.flow_um_per_s, record.dt_s)

    def exchange(self, pump_fraction: float, vent_fraction: float) -> BenchSample:
        """Run one tick, with the vent as it was."""
        way_um = self._driven.step(pump_fraction)
        rest_um, ambient_pressure_pa, air_temperature_c = next(self._rest)
        return BenchSample(rest_um + way_um, ambient_pressure_pa, air_temperature_c)


def replay_um(
    record: Record,
    off_um: Series,
    model: plant_model.PlantModel,
    loop: LoopConfig,
    pump: PumpConfig,
) -> Series:
    """What would have been read, less the setpoint, had another loop held the mirror.

    The limits of pump and loop apply: weather that would need a negative flow moves the mirror
    under either loop.

    Parameters
    ----------
    record : Record
        The hold.
    off_um : (n,) array
        Its readings less its setpoint.
    model : PlantModel
        The plant, which gives the motion by either pump command.
    loop : LoopConfig
        The other loop.
    pump : PumpConfig
        The pump's curve and limits.

    Returns
    -------
    (n - 1,) array
        In µm.
    """
    bench = _ReplayBench(record, off_um, model, pump)
    loop = loop.model_copy(update={"rate_hz": 1.0 / record.dt_s})  # that of its readings
    rig = Rig(bench, loop, pump, bench.flow_um_per_s)
    return rig.hold(record.duration_s - record.dt_s).displacement_um
