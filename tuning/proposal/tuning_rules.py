"""Gains from a model by published rules.

All treat lags as dead time (delay = theta + T + filter + half a sample): the rules are made for an
integrator with delay, and the pump's lag of a tenth of the loop's time constant does not justify a
D term.
"""

from tuning.identification import closed_loop, plant_model


def compute_effective_delay_s(model: plant_model.PlantModel, dt_s: float, filter_s: float) -> float:
    """Delay of the integrator-with-delay that stands for the loop.

    Parameters
    ----------
    model : PlantModel
        Dead time and lag.
    dt_s, filter_s : float
        Sample time, of which half counts, and the filter of the reading.
    """
    return model.delay_s + dt_s / 2 + filter_s


def make_simc_gains(
    model: plant_model.PlantModel, dt_s: float, filter_s: float, closed_loop_s: float | None = None
) -> closed_loop.Gains:
    """SIMC PI: K = 1 / (k (tc + d)), Ti = 4 (tc + d), tc = d unless given (Skogestad 2003).

    Parameters
    ----------
    model : PlantModel
        Its gain and effective delay.
    dt_s, filter_s : float
        Sample time, and the filter of the reading.
    closed_loop_s : float, optional
        Time constant tc of the closed loop.
    """
    delay_s = compute_effective_delay_s(model, dt_s, filter_s)
    if closed_loop_s is None:
        closed_loop_s = delay_s
    slowed_s = closed_loop_s + delay_s
    return closed_loop.Gains(1 / (model.gain * slowed_s), 4 * slowed_s, 0.0, filter_s)


def make_amigo_gains(
    model: plant_model.PlantModel, dt_s: float, filter_s: float
) -> closed_loop.Gains:
    """AMIGO PI for an integrating process: K = 0.35 / (k d), Ti = 13.4 d.

    Source: Astrom and Hagglund 2006, eq. 7.3.

    Parameters
    ----------
    model, dt_s, filter_s
        As for `make_simc_gains`.
    """
    delay_s = compute_effective_delay_s(model, dt_s, filter_s)
    return closed_loop.Gains(0.35 / (model.gain * delay_s), 13.4 * delay_s, 0.0, filter_s)


def make_lambda_gains(
    model: plant_model.PlantModel, dt_s: float, filter_s: float, factor: float = 3.0
) -> closed_loop.Gains:
    """Lambda PI: Ti = 2 lambda + d, K = Ti / (k (lambda + d)^2).

    Parameters
    ----------
    model : PlantModel
        Its gain and effective delay.
    dt_s, filter_s : float
        Sample time, and the filter of the reading.
    factor : float
        lambda over the delay d.
    """
    delay_s = compute_effective_delay_s(model, dt_s, filter_s)
    lambda_s = factor * delay_s
    ti_s = 2 * lambda_s + delay_s
    kp_per_s = ti_s / (model.gain * (lambda_s + delay_s) ** 2)
    return closed_loop.Gains(kp_per_s, ti_s, 0.0, filter_s)


def make_ziegler_nichols_gains(
    ultimate_gain_per_s: float, ultimate_period_s: float
) -> closed_loop.Gains:
    """Ziegler-Nichols PID from a relay: K = 0.6 Ku, Ti = Tu / 2, Td = Tu / 8, no filter on D.

    Parameters
    ----------
    ultimate_gain_per_s, ultimate_period_s : float
        Ku and Tu of the relay's limit cycle.
    """
    return closed_loop.Gains(
        0.6 * ultimate_gain_per_s, ultimate_period_s / 2, ultimate_period_s / 8, 0.0
    )
