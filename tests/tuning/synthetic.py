"""Records with known truth, made without the code that is tested: brute-force integration in fine
steps.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from tuning.identification.plant_model import PlantModel
from tuning.identification.record import Record, Series

FINE = 40


def way_um(flow: Series, model: PlantModel, dt_s: float) -> Series:
    """Centre at each reading by trapezoids of dt / 40, from rest at the first flow."""
    step_s = dt_s / FINE
    held = np.repeat(flow, FINE)
    late = round(model.dead_time_s / step_s)
    delayed = np.concatenate((np.full(late, flow[0]), held))[: held.size] - flow[0]
    share = -np.expm1(-step_s / model.lag_s)
    arrived = np.concatenate(([0.0], lfilter([share], [1.0, share - 1.0], delayed))) + flow[0]
    speed = model.gain * (arrived[1:] + arrived[:-1]) / 2 - model.leak_um_per_s
    return np.concatenate(([0.0], np.cumsum(speed) * step_s))[:-1:FINE]


def telegraph(
    rng: np.random.Generator, samples: int, low: float, high: float, hold: int = 60
) -> Series:
    """A flow that is low or high for `hold` samples or a multiple of it."""
    return np.repeat(rng.choice([low, high], samples // hold + 1), hold)[:samples].astype(float)


def record(
    model: PlantModel,
    seed: int = 1,
    samples: int = 3000,
    laser_um: float = 1.0,
    walk_um2_per_s: float = 0.01,
) -> Record:
    """A random telegraph flow through a plant, in a random walk and laser noise."""
    rng = np.random.default_rng(seed)
    dt_s = 0.02
    flow = telegraph(rng, samples, 0.4, 4.0)
    y = way_um(flow, model, dt_s) + np.cumsum(rng.standard_normal(samples)) * np.sqrt(
        walk_um2_per_s * dt_s
    )
    absent = np.full(samples, np.nan)
    return Record(dt_s, flow, y + laser_um * rng.standard_normal(samples), absent, absent)
