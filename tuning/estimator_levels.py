"""Noise levels and pump of `[estimator]`, as a session measured them."""

import math

import numpy as np

from membrane_ctrl.sessions import folder
from tuning.steps.identify import load_identified
from tuning.steps.observe import load_disturbance

# about this frequency the estimate weighs a sensor's reading against its prediction of the weather
_WALK_RAD_PER_S = 1.0


def derive_estimator_levels(session: folder.SessionFolder) -> dict[str, float]:
    """What the session measured of `[estimator]`: the pump, and noise and drift of the sensors
    that are there.
    """
    model, seen = load_identified(session).identified.model, load_disturbance(session)
    levels = {"pump_delay_s": model.dead_time_s, "pump_lag_s": model.lag_s}
    if not session.config.by_optics:  # a figure states its own noise
        levels["laser_noise_um"] = seen.laser_um
    # A random walk has the density (w_s / w)^2: taken where the estimator follows the weather.
    for name, unit, walk, weather in (
        ("barometer", "pa", "pressure", seen.barometer),
        ("thermometer", "k", "air", seen.air),
    ):
        if weather is not None:
            levels[f"{name}_noise_{unit}"] = weather.noise
            density = float(weather.psd(np.array([_WALK_RAD_PER_S]))[0])
            levels[f"{walk}_walk_{unit}_per_root_s"] = _WALK_RAD_PER_S * math.sqrt(density)
    # Only what was measured.
    rounded = {key: float(f"{value:.3g}") for key, value in levels.items()}
    return {key: value for key, value in rounded.items() if value > 0 and math.isfinite(value)}
