"""Noise levels of sensors and walks, learned from a Kalman filter's innovations. Pure.

Each level is a factor on a configured variance. It moves slowly, weighted by the information in the
readings so far, and stays within bounds of the configured value.
"""

import math
from dataclasses import dataclass

from membrane_ctrl.model.state_tree import StateNode

_MEMORY_S = 200.0
_LIMIT = 3.0  # an innovation beyond this many standard deviations counts as this many
# A factor's logarithm stays within these bounds
_READING_BOUND = math.log(5.0**2)
_WALK_BOUND = math.log(30.0**2)
# Information with which learning starts
_STATED_INFORMATION = 250.0  # a noise that comes with the reading
_CONFIGURED_INFORMATION = 25.0  # a configured noise of a reading
_WALK_INFORMATION = 4.0  # a configured walk


@dataclass(slots=True)
class LearnedFactor(StateNode):
    """A factor on a variance; its logarithm follows the likelihood's slope over the information so
    far.
    """

    information: float
    log: float = 0.0

    @property
    def factor(self) -> float:
        """Present factor."""
        return math.exp(self.log)

    def learn(self, slope: float, information: float, forget: float, bound: float) -> None:
        """Take what one reading shows: a step of Fisher's scoring in the logarithm of the factor.

        Parameters
        ----------
        slope : float
            Derivative of the log-likelihood by the logarithm.
        information : float
            Fisher information of the reading.
        forget : float
            Share of the information so far that is forgotten.
        bound : float
            The logarithm stays within +- this.
        """
        # at least that: a few readings must not overturn a level that has hardly shown for long
        self.information = max(
            _WALK_INFORMATION, self.information + information - forget * self.information
        )
        self.log = min(max(self.log + slope / self.information, -bound), bound)


def configured_walk() -> LearnedFactor:
    """The factor on a configured walk, to be learned."""
    return LearnedFactor(_WALK_INFORMATION)


@dataclass(slots=True)
class ReadingNoise(StateNode):
    """The factor on the variance of a sensor's readings; corrects the walks that the sensor sees,
    too.

    The innovations are to be of unit variance, which sets the scale of noise and walks, and white,
    which sets their
    ratio: they correlate positively where the filter follows too slowly, negatively where it
    follows noise.
    """

    level: LearnedFactor
    past: float = 0.0  # how the past innovations would have moved the state, of unit variance

    @classmethod
    def of_reading(cls, stated: bool) -> "ReadingNoise":
        """The factor to be learned; `stated`: the noise comes with each reading."""
        return cls(LearnedFactor(_STATED_INFORMATION if stated else _CONFIGURED_INFORMATION))

    @property
    def factor(self) -> float:
        """Present factor."""
        return self.level.factor

    def learn(
        self,
        innovation: float,
        share: float,
        dt_s: float,
        walks: tuple[tuple[LearnedFactor, float], ...],
    ) -> None:
        """Take an innovation: one step along the slope of the log-likelihood.

        An innovation has two tests. Its square is to be 1: `size` is the slope of the
        log-likelihood by the variance. Its product with the past innovations is to be 0: `runs` is
        positive if the filter follows too slowly, i.e. if the walks are assumed too small.

        Parameters
        ----------
        innovation : float
            In standard deviations.
        share : float
            Share of the innovation's variance that is the state's; the rest is the reading's noise.
        dt_s : float
            Since the last reading.
        walks : tuple of (LearnedFactor, float)
            What moves the state, and its part in that; empty for a sensor that does not lead.
        """
        # Old readings lose their weight; an outlier counts as `_LIMIT` at most
        forget = min(1.0, dt_s / _MEMORY_S)
        innovation, known = min(max(innovation, -_LIMIT), _LIMIT), share / 8
        size, runs = (innovation**2 - 1) / 2, math.sqrt(known) * innovation * self.past
        # change of the innovations' variance with the noise, both as logarithms
        by_noise = 1 - share / 2
        # Only the sensor that leads shows whether its innovations are white
        leads = bool(walks)
        information = by_noise**2 / 2 + leads * known
        self.level.learn(by_noise * size - leads * runs, information, forget, _READING_BOUND)
        # The walks grow with `runs`, the noise of readings shrinks with it
        for walk, part in walks:
            slope = part * (share / 2 * size + runs)
            walk.learn(slope, part**2 * (share**2 / 8 + known), forget, _WALK_BOUND)
        # Past innovations as the filter carries them on: each moves the state by its gain
        self.past = (1 - share) * self.past + math.sqrt(share * (2 - share)) * innovation
