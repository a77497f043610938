"""The disturbance as a linear stochastic system: states, drift and diffusion."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from membrane_ctrl.model.arrays import FloatArray
from tuning.identification.disturbance import DisturbanceModel

Matrix = FloatArray
# A walk that returns after an hour is equivalent for the loop, and bounds what the laser cannot
# distinguish.
_RETURN_S = 3600.0
# Intensity of an unseen walk, µm^2/s: 1 nm in a second; zero would leave the filter without a
# solution.
_UNSEEN = 1e-6


@dataclass(frozen=True, slots=True)
class Walks:
    """The disturbance as states: their drift (n, n) and diffusion (n, n), and three sums of them
    (n,).
    """

    drift: Matrix
    diffusion: Matrix
    barometer: FloatArray
    air: FloatArray
    centre: FloatArray

    @classmethod
    def from_disturbance(cls, disturbance: DisturbanceModel) -> "Walks":
        """States: barometer, air, gas, fast rest, slow rest, what it reaches; two more for each
        colour.
        """
        barometer, air, rest = disturbance.barometer, disturbance.air, disturbance.rest
        colours = [
            (source, *colour)
            for source, of in enumerate((barometer, air, rest))
            if of
            for colour in of.coloured
        ]
        n = 6 + 2 * len(colours)
        drift, diffusion = -np.eye(n) / _RETURN_S, np.zeros((n, n))
        air_s = air.lag_s if air is not None else rest.slow_s
        walks = (barometer.walk if barometer else _UNSEEN, air.walk if air else _UNSEEN)
        np.fill_diagonal(
            diffusion[:6, :6], [*walks, 0.0, max(rest.fast, _UNSEEN), max(rest.slow, _UNSEEN), 0.0]
        )
        sums = np.zeros((3, n))
        sums[0, 0] = sums[1, 1] = sums[2, 3] = sums[2, 5] = 1.0
        for first, (source, tau_s, intensity) in zip(range(6, n, 2), colours, strict=True):
            drift[first, first] = drift[first + 1, first + 1] = -1 / tau_s
            drift[first + 1, first] = 1 / tau_s
            diffusion[first, first] = intensity / tau_s**2
            sums[source, first + 1] = 1.0
        drift[2] += sums[1] / air_s
        drift[2, 2] = -1 / air_s
        drift[5, 4:6] = 1 / rest.slow_s, -1 / rest.slow_s
        centre = sums[2] + (barometer.gain if barometer else 0.0) * sums[0]
        centre[2] = air.gain if air else 0.0
        return cls(drift, diffusion, sums[0], sums[1], centre)

    def discretise(self, step_s: float) -> tuple[Matrix, Matrix]:
        """Transition and noise covariance over a step (Van Loan 1978), doubled from one shorter
        than every lag.
        """
        n = len(self.drift)
        doublings = max(0, math.ceil(math.log2(step_s * np.abs(self.drift).max())))
        block = np.block([[-self.drift, self.diffusion], [np.zeros((n, n)), self.drift.T]])
        block = expm(block * (step_s / 2**doublings))  # over many lags it would overflow
        transition = block[n:, n:].T
        covariance = transition @ block[:n, n:]
        for _ in range(doublings):
            covariance = covariance + transition @ covariance @ transition.T
            transition = transition @ transition
        return transition, covariance
