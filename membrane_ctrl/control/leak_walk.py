"""Learns the random walk of the leak from the innovations of the filter. Pure.

Three Kalman filters of two states, centre and leak, assume a walk of the configured size and of
larger ones. Each follows how far its states differ from those of the estimate, so that the weather
and the pump need no second model. With nu the innovation of the estimate, d_c and d_l these
differences, K_c and K_l the gains of the estimate, k_c and k_l those of the small filter:

    predict   d_c <- d_c - d_l dt
    correct   n = nu - d_c;   d_c <- d_c + k_c n - K_c nu;   d_l <- d_l + k_l n - K_l nu
    learn     log-likelihood <- log-likelihood - (n^2 / s + ln s) / 2,   s the variance of n

The walk in use is the mean of the three variances, weighted by their likelihoods.
Source: multiple model estimation (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to
Tracking and Navigation, 2001, section 11.6).
"""

import math
from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field

from membrane_ctrl.model.state_tree import StateNode

# Standard deviations of the walk, in configured ones
_WALKS = (1.0, 5.0, 25.0)
# Logarithms of their probabilities before any reading: most leaks are holes and do not walk
_PRIOR = (0.0, -3.0, -6.0)
# Nothing is learned for this time, and the largest walk holds: errors of the weather's gains look
# like a walk at first, and those of the pump while the mirror settles must not stay in the leak
_FIRST_PAUSE_S = 40.0
# Memory of the likelihoods: a leak that changes in the cold of the night is another one by day
_MEMORY_S = 1200.0
_PAUSE_S = 20.0  # until a changed leak is known again
# An innovation beyond this many standard deviations counts as this many
_LIMIT = 3.0
_FIRST_LEAK_STD_UM_PER_S = 0.3


@dataclass(slots=True)
class LeakHypothesis(StateNode):
    """One of the small filters: its states less those of the estimate, and their covariance."""

    centre_um: float = 0.0
    leak_um_per_s: float = 0.0
    centre_variance: float = 1.0
    covariance: float = 0.0
    leak_variance: float = _FIRST_LEAK_STD_UM_PER_S**2
    log_likelihood: float = 0.0

    def restart(self) -> None:
        """Return to the states of the estimate, and keep the likelihood."""
        likelihood = self.log_likelihood
        self.start_afresh()
        self.log_likelihood = likelihood

    def predict(self, dt_s: float, centre_walk: float, leak_walk: float) -> None:
        """Advance by a tick; the walks are variances per second."""
        self.centre_um -= dt_s * self.leak_um_per_s
        self.centre_variance += (
            dt_s * (centre_walk - 2 * self.covariance) + dt_s**2 * self.leak_variance
        )
        self.covariance -= dt_s * self.leak_variance
        self.leak_variance += dt_s * leak_walk

    def correct(
        self, innovation_um: float, noise_um2: float, centre_gain: float, leak_gain_per_s: float
    ) -> None:
        """Take a reading of the centre; the gains are those of the estimate."""
        spread = self.centre_variance + noise_um2
        own_um = innovation_um - self.centre_um
        own_centre_gain = self.centre_variance / spread
        own_leak_gain = self.covariance / spread
        self.centre_um += own_centre_gain * own_um - centre_gain * innovation_um
        self.leak_um_per_s += own_leak_gain * own_um - leak_gain_per_s * innovation_um
        self.leak_variance -= own_leak_gain * self.covariance
        self.covariance -= own_centre_gain * self.covariance
        self.centre_variance -= own_centre_gain * self.centre_variance
        squared = min(own_um**2 / spread, _LIMIT**2)
        self.log_likelihood -= (squared + math.log(spread)) / 2


@dataclass(slots=True)
class LeakWalk(StateNode):
    """A factor on the variance of the leak's walk, from three hypotheses."""

    hypotheses: Annotated[
        list[LeakHypothesis], Field(min_length=len(_WALKS), max_length=len(_WALKS))
    ] = field(default_factory=lambda: [LeakHypothesis() for _ in _WALKS])
    factor: float = _WALKS[-1] ** 2
    paused_s: float = _FIRST_PAUSE_S  # nothing is learned for so long

    def predict(self, dt_s: float, centre_walk: float, leak_walk: float) -> None:
        """Advance by a tick.

        Parameters
        ----------
        dt_s : float
        centre_walk, leak_walk : float
            Variances per second of the centre's walk, and of the leak's as configured.
        """
        self.paused_s = max(0.0, self.paused_s - dt_s)
        for walk, hypothesis in zip(_WALKS, self.hypotheses, strict=True):
            hypothesis.predict(dt_s, centre_walk, walk**2 * leak_walk)

    def pause(self) -> None:
        """A change of the leak was found: what the innovations show of it is no walk."""
        self.paused_s = _PAUSE_S
        for hypothesis in self.hypotheses:
            hypothesis.restart()

    def learn(
        self,
        innovation_um: float,
        noise_um2: float,
        gains: tuple[float, float],
        dt_s: float,
    ) -> None:
        """Let a reading of the centre correct the walk.

        Parameters
        ----------
        innovation_um : float
            Reading minus expectation.
        noise_um2 : float
            Variance of the reading.
        gains : (float, float)
            By which the reading corrects centre and leak of the estimate, 1 and 1/s.
        dt_s : float
            Since the last reading of this sensor.
        """
        if self.paused_s > 0.0:
            return
        for hypothesis in self.hypotheses:
            hypothesis.correct(innovation_um, noise_um2, *gains)
        # Only the differences count, and they fade
        best = max(hypothesis.log_likelihood for hypothesis in self.hypotheses)
        kept = 1.0 - min(1.0, dt_s / _MEMORY_S)
        weights = []
        for prior, hypothesis in zip(_PRIOR, self.hypotheses, strict=True):
            hypothesis.log_likelihood = kept * (hypothesis.log_likelihood - best)
            weights.append(math.exp(hypothesis.log_likelihood + prior))
        squares = (weight * walk**2 for weight, walk in zip(weights, _WALKS, strict=True))
        self.factor = sum(squares) / sum(weights)
