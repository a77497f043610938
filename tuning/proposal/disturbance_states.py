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

# Places of the states of the walks.
_BAROMETER = 0
_AIR = 1
_GAS = 2
_FAST = 3
_SLOW = 4
_REACHED = 5
_WALK_STATES = 6


@dataclass(frozen=True, slots=True)
class Walks:
    """The disturbance as states x of dx = A x dt + dw, with cov(dw) = Q dt.

    The states are barometer, air, gas, fast rest, slow rest, and what the slow rest reaches; then
    two for each colour.

    Attributes
    ----------
    drift : (n, n) array
        A, 1/s.
    diffusion : (n, n) array
        Q, unit^2/s.
    barometer, air, centre : (n,) arrays
        Weights of the states in the barometer's reading (Pa), the air's temperature (K) and the
        centre (µm).
    """

    drift: Matrix
    diffusion: Matrix
    barometer: FloatArray
    air: FloatArray
    centre: FloatArray

    @classmethod
    def from_disturbance(cls, disturbance: DisturbanceModel) -> "Walks":
        """Make the states of an identified disturbance."""
        barometer = disturbance.barometer
        air = disturbance.air
        rest = disturbance.rest

        # What the sensors show, if there are any.
        barometer_gain = 0.0
        barometer_walk = _UNSEEN
        if barometer is not None:
            barometer_gain = barometer.gain
            barometer_walk = barometer.walk
        air_gain = 0.0
        air_walk = _UNSEEN
        air_s = rest.slow_s
        if air is not None:
            air_gain = air.gain
            air_walk = air.walk
            air_s = air.lag_s

        # The colours of each source: barometer, air and rest.
        colours: list[tuple[int, float, float]] = []
        for source, quantity in enumerate((barometer, air, rest)):
            if quantity is not None:
                colours += [(source, tau_s, intensity) for tau_s, intensity in quantity.coloured]

        # The walks; gas, and what the slow rest reaches, have no noise of their own.
        n = _WALK_STATES + 2 * len(colours)
        drift = -np.eye(n) / _RETURN_S
        diffusion = np.zeros((n, n))
        fast_walk = max(rest.fast, _UNSEEN)
        slow_walk = max(rest.slow, _UNSEEN)
        walks = [barometer_walk, air_walk, 0.0, fast_walk, slow_walk, 0.0]
        np.fill_diagonal(diffusion[:_WALK_STATES, :_WALK_STATES], walks)

        # Each source as a sum of states: rows barometer, air, and the centre's rest.
        sums = np.zeros((3, n))
        sums[0, _BAROMETER] = 1.0
        sums[1, _AIR] = 1.0
        sums[2, _FAST] = 1.0
        sums[2, _REACHED] = 1.0

        # A colour s / (1 + (w tau)^2)^2 is white noise behind two lags tau.
        for first, (source, tau_s, intensity) in zip(
            range(_WALK_STATES, n, 2), colours, strict=True
        ):
            second = first + 1
            drift[first, first] = -1 / tau_s
            drift[second, second] = -1 / tau_s
            drift[second, first] = 1 / tau_s
            diffusion[first, first] = intensity / tau_s**2
            sums[source, second] = 1.0

        # Lags: the gas follows the air, and the centre the slow rest.
        drift[_GAS] += sums[1] / air_s
        drift[_GAS, _GAS] = -1 / air_s
        drift[_REACHED, _SLOW] = 1 / rest.slow_s
        drift[_REACHED, _REACHED] = -1 / rest.slow_s
        centre = sums[2] + barometer_gain * sums[0]
        centre[_GAS] = air_gain
        return cls(drift, diffusion, sums[0], sums[1], centre)

    def discretise(self, step_s: float) -> tuple[Matrix, Matrix]:
        """Discretise the states over a step.

        Parameters
        ----------
        step_s : float
            Length of the step.

        Returns
        -------
        transition : (n, n) array
        covariance : (n, n) array
            Of the noise that the step adds.

        Notes
        -----
        C. F. Van Loan, IEEE Trans. Autom. Control 23, 395 (1978): both from one matrix exponential.
        """
        n = len(self.drift)

        # Over many lags the exponential would overflow: it is taken over a step shorter than every
        # lag, and doubled.
        fastest_per_s = np.abs(self.drift).max()
        doublings = max(0, math.ceil(math.log2(step_s * fastest_per_s)))
        block = np.block([[-self.drift, self.diffusion], [np.zeros((n, n)), self.drift.T]])
        exponential = expm(block * (step_s / 2**doublings))
        transition = exponential[n:, n:].T
        covariance = transition @ exponential[:n, n:]
        for _ in range(doublings):
            covariance = covariance + transition @ covariance @ transition.T
            transition = transition @ transition
        return transition, covariance
