"""Learns how fast the leak walks, from the innovations of the centre's Kalman filter. Pure.

The filter of `centre.py` needs the variance of the leak's random walk. If it is set too large, the
laser's noise moves the estimated leak; if it is too small, the filter follows a changing leak too
late. So three hypotheses are compared: the walk is as configured, 5 times as large, or 25 times.

Each hypothesis is a Kalman filter of two states, centre and leak. The one whose predictions fit the
readings best becomes the most probable, and the walk in use is the mean of the three variances,
weighted by their probabilities.

A hypothesis needs neither pump nor weather, because it does not hold centre and leak themselves,
but their differences d_c and d_l from those of the main filter: what moves the centre moves both
by the same amount. With nu the innovation of the main filter, K_c and K_l its gains on centre and
leak, k_c and k_l the gains of the hypothesis, r the variance of the reading, and P the covariance
of the hypothesis:

    predict   d_c <- d_c - d_l dt          P <- F P F^T + Q,   F = [1 -dt; 0 1]                 (1)
    correct   n = nu - d_c                 the innovation of the hypothesis
              s = P_cc + r                 its variance
              d_c <- d_c + k_c n - K_c nu
              d_l <- d_l + k_l n - K_l nu  both filters move; the difference remains             (2)
    judge     L <- L - (n^2 / s + ln s) / 2                  the log-likelihood                  (3)

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
# Of a hypothesis that begins: it knows the centre to 1 µm and the leak to 0.3 µm/s
_FIRST_CENTRE_UM2 = 1.0
_FIRST_LEAK_STD_UM_PER_S = 0.3


@dataclass(slots=True)
class LeakHypothesis(StateNode):
    """One hypothesis: its states less those of the main filter, their covariance, its likelihood.

    Attributes
    ----------
    centre_um, leak_um_per_s : float
        The differences d_c and d_l.
    centre_variance, covariance, leak_variance : float
        P_cc in µm^2, P_cl in µm^2/s, P_ll in µm^2/s^2.
    log_likelihood : float
        Less that of the best hypothesis.
    """

    centre_um: float = 0.0
    leak_um_per_s: float = 0.0
    centre_variance: float = _FIRST_CENTRE_UM2
    covariance: float = 0.0
    leak_variance: float = _FIRST_LEAK_STD_UM_PER_S**2
    log_likelihood: float = 0.0

    def restart(self) -> None:
        """Return to the states of the main filter, and keep the likelihood."""
        likelihood = self.log_likelihood
        self.start_afresh()
        self.log_likelihood = likelihood

    def predict(self, dt_s: float, centre_walk: float, leak_walk: float) -> None:
        """Advance by a tick, (1); the walks are variances per second."""
        self.centre_um -= dt_s * self.leak_um_per_s
        # F P F^T + Q by its three elements
        by_leak_um2 = dt_s**2 * self.leak_variance - 2 * dt_s * self.covariance
        self.centre_variance += by_leak_um2 + dt_s * centre_walk
        self.covariance -= dt_s * self.leak_variance
        self.leak_variance += dt_s * leak_walk

    def correct(
        self, innovation_um: float, noise_um2: float, centre_gain: float, leak_gain_per_s: float
    ) -> None:
        """Use a reading of the centre, (2) and (3).

        Parameters
        ----------
        innovation_um, noise_um2 : float
            Innovation nu of the main filter, and variance r of the reading.
        centre_gain, leak_gain_per_s : float
            Gains K_c and K_l of the main filter.
        """
        # The innovation of this hypothesis, its variance and its gains
        own_innovation_um = innovation_um - self.centre_um
        own_variance_um2 = self.centre_variance + noise_um2
        own_centre_gain = self.centre_variance / own_variance_um2
        own_leak_gain = self.covariance / own_variance_um2
        # Both filters are corrected: the differences move by the difference of the corrections
        self.centre_um += own_centre_gain * own_innovation_um - centre_gain * innovation_um
        self.leak_um_per_s += own_leak_gain * own_innovation_um - leak_gain_per_s * innovation_um
        # P <- P - k (P_cc P_cl); the centre last, since the others need its gain only
        self.leak_variance -= own_leak_gain * self.covariance
        self.covariance -= own_centre_gain * self.covariance
        self.centre_variance -= own_centre_gain * self.centre_variance
        # A single bad reading must not decide
        squared = min(own_innovation_um**2 / own_variance_um2, _LIMIT**2)
        self.log_likelihood -= (squared + math.log(own_variance_um2)) / 2


@dataclass(slots=True)
class LeakWalk(StateNode):
    """The leak's walk in use, as a factor on its configured variance, from the hypotheses.

    Call `predict` in each tick and `learn` with each reading by which the main filter corrects the
    leak; `pause` when the filter has found that the leak changed at once.
    """

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
            Time since the last tick.
        centre_walk, leak_walk : float
            Variances per second of the centre's walk, and of the leak's as configured.
        """
        self.paused_s = max(0.0, self.paused_s - dt_s)
        for walk, hypothesis in zip(_WALKS, self.hypotheses, strict=True):
            hypothesis.predict(dt_s, centre_walk, walk**2 * leak_walk)

    def pause(self) -> None:
        """Learn nothing until the main filter knows a suddenly changed leak: its innovations until
        then show a step, not a walk.
        """
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
        """Correct the hypotheses by a reading of the centre, and update their weights.

        Parameters
        ----------
        innovation_um : float
            Reading minus expectation of the main filter.
        noise_um2 : float
            Variance of the reading.
        gains : (float, float)
            By which the reading corrects centre and leak of the main filter, 1 and 1/s.
        dt_s : float
            Since the last reading of this sensor.
        """
        if self.paused_s > 0.0:
            return
        for hypothesis in self.hypotheses:
            hypothesis.correct(innovation_um, noise_um2, *gains)
        self._fade_likelihoods(dt_s)
        self._weight_walks()

    def _fade_likelihoods(self, dt_s: float) -> None:
        """Keep the differences from the best hypothesis, which alone count, and forget slowly."""
        best = max(hypothesis.log_likelihood for hypothesis in self.hypotheses)
        kept = 1.0 - min(1.0, dt_s / _MEMORY_S)
        for hypothesis in self.hypotheses:
            hypothesis.log_likelihood = kept * (hypothesis.log_likelihood - best)

    def _weight_walks(self) -> None:
        """Set the factor to the mean of the hypotheses' variances, by their probabilities."""
        weight_sum = 0.0
        weighted_sum = 0.0
        for walk, prior, hypothesis in zip(_WALKS, _PRIOR, self.hypotheses, strict=True):
            weight = math.exp(hypothesis.log_likelihood + prior)
            weight_sum += weight
            weighted_sum += weight * walk**2
        self.factor = weighted_sum / weight_sum
