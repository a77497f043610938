"""Least standard deviation that any controller can reach.

No controller acts before the dead time, so the error is at least that of the best prediction of the
disturbance over it (Astrom, Introduction to Stochastic Control Theory, 1970, chapter 6). The pump's
lag is no limit: it can be inverted.
"""

import numpy as np
from scipy.linalg import solve_discrete_are

from membrane_ctrl.config.schema import LoopConfig
from tuning.identification import plant_model
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal.disturbance_states import Walks


def compute_least_std_um(
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    write_s: float = 0.0,
) -> float:
    """Bound for the sensors that the loop's feed-forward uses; unused weather counts as
    disturbance.

    `write_s` is the time from a reading to its command, if the model's dead time does not include
    it.
    """
    moving = Walks.from_disturbance(disturbance)
    centre = moving.centre
    readings, noises = [centre], [disturbance.rest.white**2]
    for reading, weather, used in (
        (moving.barometer, disturbance.barometer, loop.feedforward_barometer),
        (moving.air, disturbance.air, loop.feedforward_temperature),
    ):
        if weather is not None and used:
            readings.append(reading)
            noises.append(weather.noise**2)
    c, r = np.array(readings), np.diag(noises)
    transition, kicks = moving.discretise(disturbance.rest.dt_s)
    before = solve_discrete_are(transition.T, c.T, kicks, r)
    after = before - before @ c.T @ np.linalg.solve(c @ before @ c.T + r, c @ before)
    transition, kicks = moving.discretise(model.dead_time_s + write_s + disturbance.rest.dt_s / 2)
    return float(np.sqrt(centre @ (transition @ after @ transition.T + kicks) @ centre))
