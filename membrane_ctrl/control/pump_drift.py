"""The pump's flow relative to its configured curve, learned while the mirror is held. Pure.

While a loop holds, weather and laser noise move the flow, and the flow moves the mirror. An
estimate from such readings depends on the model of the noise, and may be wrong by a factor of two.
A probe does not depend on it: a small sine on the flow whose sign alternates at random from segment
to segment, independent of everything else. The centre is the integral of the flow, so at the
probe's frequency w, with the flow that the loop really gave (its answer included),

    Y = s U exp(-j w d) / (j w (1 + j w T))                                                    (1)

Y, U: correlations of centre and flow with the probe. s is the scale sought, whatever loop, weather
and noise are. Doors and lifts are independent of the signs. The delay d is assumed for an hour,
then seen in the phase; the lag T is assumed: 0.15 s more of it read as 5 % less of s.

s changes at a rate that wanders (without it the estimate trails a wearing pump by hours). The error
bar comes from the scatter of the segments. An offset of the curve and the film's leak are a
constant flow each and cannot be separated: the leak that is reported is their sum.
"""

import cmath
import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.model.arrays import ComplexArray, FloatArray
from membrane_ctrl.model.state_tree import ArrayShape, Count, StateNode

PROBE_RAD_PER_S = 2 * math.pi / 5.0  # above the weather, below where the pump's lag matters
SEGMENT_S = 60.0  # a whole number of periods
_SETTLE_S = 10.0  # of a segment: the loop's answer to the change of sign
WALK_PER_SQRT_S = 0.01 / 60.0  # of s: 1 % in an hour
RATE_PER_S = 0.03 / 3600.0  # of s: unknown, 20 % in eight hours are followed
_RATE_LASTS_S = 4 * 3600.0
SIGMA_FIRST = 0.2  # of a pump that was not measured
_SEGMENTS = 60.0  # over which the scatter is taken
_LEARNED = 5  # segments before the scatter means anything
_SIGMA_LEAST = 0.03  # the pump's lag is not known better
_CLIP = 3.0  # standard deviations that a segment may be off: a gust
RANGE = (0.5, 2.0)  # of the correction; beyond it the pump needs a person
_RATE_PER_S = 0.05 / 3600.0  # of the correction
_SURE = 2.0  # standard errors: less is noise, and not followed
_KEEPS = math.exp(-SEGMENT_S / _RATE_LASTS_S)
_PASSES = np.array([[1.0, SEGMENT_S], [0.0, _KEEPS]])  # of scale and rate, in a segment
_WANDERS = np.diag([WALK_PER_SQRT_S**2 * SEGMENT_S, RATE_PER_S**2 * (1 - _KEEPS**2)])
_SIGN_SEED = 0b1010_0110_1011_1001
_Pair = Annotated[ComplexArray, ArrayShape((2,), "<c16")]


@dataclass(frozen=True, slots=True)
class PumpScale(StateNode):
    """What is known of the pump: its flow relative to the configured curve,
    and one standard error.
    """

    scale: float = 1.0
    sigma: float = SIGMA_FIRST


@dataclass(slots=True)
class PumpDriftState(StateNode):
    """The open segment, and what the earlier ones have taught."""

    known: PumpScale = PumpScale()  # estimate after the last segment
    # scale that the loop may use: follows the estimate slowly, not within its error bar
    correction: float = 1.0
    signs: Count = _SIGN_SEED
    sign: float = 1.0
    time_s: float = 0.0  # in the segment
    whole: bool = True  # no tick of the segment is missing
    mean_um: LowPass = field(default_factory=LowPass)
    mean_flow: LowPass = field(default_factory=LowPass)
    # of the segment: centre and flow
    sums: _Pair = field(default_factory=lambda: np.zeros(2, complex))
    # of the segments: motion seen, and expected
    means: _Pair = field(default_factory=lambda: np.zeros(2, complex))
    rate_per_s: float = 0.0  # of the scale
    # covariance of scale and rate
    spread: Annotated[FloatArray, ArrayShape((2, 2))] = field(
        default_factory=lambda: np.diag([SIGMA_FIRST**2, RATE_PER_S**2])
    )
    scatter: float = 0.0
    count: Count = 0


class PumpDrift:
    """Probes the pump and learns its scale. `delay_s`, `lag_s`: of the flow behind the command."""

    def __init__(self, delay_s: float, lag_s: float, memory: PumpDriftState | None = None) -> None:
        self.memory = memory or PumpDriftState()
        w = PROBE_RAD_PER_S
        self._path: ComplexArray = np.array(
            [cmath.exp(-1j * w * delay_s) / (1j * w * (1 + 1j * w * lag_s))]
        )

    @property
    def known(self) -> PumpScale:
        """Estimate after the last segment."""
        return self.memory.known

    @property
    def correction(self) -> float:
        """Scale that the loop may use."""
        return self.memory.correction

    def flow_um_per_s(self, amplitude_um: float) -> float:
        """The probe now; `amplitude_um` is that of the centre's
        motion without the loop's answer.
        """
        memory = self.memory
        return (
            memory.sign * amplitude_um * PROBE_RAD_PER_S * math.sin(PROBE_RAD_PER_S * memory.time_s)
        )

    def discard_segment(self) -> None:
        """The segment cannot be used: no reading, or the flow was not the loop's."""
        self.memory.whole = False

    def step(self, displacement_um: float, flow_um_per_s: float, dt_s: float) -> bool:
        """Take a tick.

        Parameters
        ----------
        displacement_um : float
            The reading.
        flow_um_per_s : float
            By the configured curve, from now on.
        dt_s : float
            Time since the last tick.

        Returns
        -------
        bool
            Whether it ends a segment.
        """
        memory = self.memory
        if memory.time_s >= _SETTLE_S:
            turn = memory.sign * cmath.exp(-1j * PROBE_RAD_PER_S * memory.time_s) * dt_s
            # without the means, which are no answer to the probe
            memory.sums[0] += turn * (displacement_um - memory.mean_um.value)
            # the flow is held until the next reading: half a tick late
            late = cmath.exp(-0.5j * PROBE_RAD_PER_S * dt_s)
            memory.sums[1] += turn * late * (flow_um_per_s - memory.mean_flow.value)
        memory.mean_um.update(displacement_um, dt_s, SEGMENT_S)
        memory.mean_flow.update(flow_um_per_s, dt_s, SEGMENT_S)
        memory.time_s += dt_s
        if memory.time_s < SEGMENT_S - 0.5 * dt_s:
            return False
        used = memory.whole and bool(np.isfinite(memory.sums).all())
        if used:
            centre, flow = memory.sums.tolist()
            self._learn_segment(centre, flow * complex(self._path[0]))
        self._follow_drift()
        self._next_segment()
        return used

    def _learn_segment(self, centre: complex, expected: complex) -> None:
        """Compare a segment's motion with that expected of the configured curve.

        A Kalman filter of scale and rate; its reading is the motion along the usual phase.

        Parameters
        ----------
        centre : complex
            Correlation of the centre with the probe, Y in eq. 1.
        expected : complex
            The same for s = 1: U and the path.
        """
        memory = self.memory
        # 1. Means over the last hour: of the motion (its phase holds the true delay), and expected
        memory.count += 1
        share = 1 / min(memory.count, _SEGMENTS)
        memory.means += share * (np.array([centre, expected]) - memory.means)
        answer, usual = memory.means.tolist()
        along = answer if memory.count > _SEGMENTS else usual
        size = abs(usual)
        if not size * abs(along):
            return
        # 2. Innovation: this segment's motion along that phase, less the predicted one
        scale = memory.known.scale + memory.rate_per_s * SEGMENT_S
        measured_along = (centre * along.conjugate()).real / abs(along)
        expected_along = (expected * usual.conjugate()).real
        off = measured_along - scale * expected_along / size
        if memory.count <= _LEARNED:
            memory.scatter += share * (off**2 - memory.scatter)
            return
        # 3. A gust counts as much as the largest likely deviation
        most = _CLIP * math.sqrt(memory.scatter)
        off = min(max(off, -most), most)
        # 4. Prediction of the covariance, gain, update
        spread = _PASSES @ memory.spread @ _PASSES.T + _WANDERS
        gain = spread[0] * size / (memory.scatter + spread[0, 0] * size**2)
        memory.spread = spread - np.outer(gain, spread[0]) * size
        memory.rate_per_s = _KEEPS * memory.rate_per_s + float(gain[1]) * off
        sigma = math.hypot(math.sqrt(memory.spread[0, 0]), _SIGMA_LEAST)
        memory.known = PumpScale(scale + float(gain[0]) * off, sigma)
        memory.scatter += share * (off**2 - memory.scatter)

    def _follow_drift(self) -> None:
        memory = self.memory
        known = memory.known
        step_most = _RATE_PER_S * SEGMENT_S
        if abs(known.scale - memory.correction) > _SURE * known.sigma:
            goal = min(max(known.scale, RANGE[0]), RANGE[1])
            step = goal - memory.correction
            memory.correction += min(max(step, -step_most), step_most)

    def _next_segment(self) -> None:
        """Alternate the sign by a shift register of 16 bits: the same in every run, and like
        nothing else.
        """
        memory = self.memory
        bits = memory.signs
        bit = (bits ^ (bits >> 2) ^ (bits >> 3) ^ (bits >> 5)) & 1
        memory.signs = (bits >> 1) | (bit << 15)
        memory.sign = 1.0 if bit else -1.0
        memory.time_s = 0.0
        memory.whole = True
        memory.sums[:] = 0.0
