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
    """Compute the least standard deviation of the centre.

    Parameters
    ----------
    model : PlantModel
        Its dead time is what no controller can undo.
    disturbance : DisturbanceModel
        Weather and noise.
    loop : LoopConfig
        Its feed-forward uses some of the sensors; the others' weather counts as disturbance.
    write_s : float
        Time from a reading to its command, if the model's dead time does not include it.

    Returns
    -------
    float
        In µm.
    """
    # What is read: the centre by the laser, and the sensors in use; with the variances of their
    # noise.
    moving = Walks.from_disturbance(disturbance)
    centre = moving.centre
    readings = [centre]
    variances = [disturbance.rest.white**2]
    if disturbance.barometer is not None and loop.feedforward_barometer:
        readings.append(moving.barometer)
        variances.append(disturbance.barometer.noise**2)
    if disturbance.air is not None and loop.feedforward_temperature:
        readings.append(moving.air)
        variances.append(disturbance.air.noise**2)
    c = np.array(readings)
    r = np.diag(variances)

    # The steady Kalman filter: covariance of the states before and after a reading.
    transition, kicks = moving.discretise(disturbance.rest.dt_s)
    before = solve_discrete_are(transition.T, c.T, kicks, r)
    innovation = c @ before @ c.T + r
    after = before - before @ c.T @ np.linalg.solve(innovation, c @ before)

    # Predicted over the dead time and half a sample of holding.
    horizon_s = model.dead_time_s + write_s + disturbance.rest.dt_s / 2
    transition, kicks = moving.discretise(horizon_s)
    predicted = transition @ after @ transition.T + kicks
    return float(np.sqrt(centre @ predicted @ centre))
