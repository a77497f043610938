"""The pump's flow relative to its configured curve, learned while the mirror is held. Pure.

While a loop holds, weather and laser noise move the flow, and the flow moves the mirror. What such readings tell of
the pump depends on the model of the noise, and may be wrong by a factor of two. A probe does not: a small sine on the
flow whose sign alternates at random from segment to segment, independent of everything else. The centre is the
integral of the flow, so at the probe's frequency w, with the flow that the loop really gave (its answer included),

    Y = s U exp(-j w d) / (j w (1 + j w T)),    Y, U: correlations of centre and flow with the probe,

and s is the scale sought, whatever loop, weather and noise are. Doors and lifts do not know the signs. The delay d is
assumed for an hour, then seen in the phase; the lag T is assumed: 0.15 s more of it read as 5 % less of s.

s changes at a rate that wanders (without it the estimate trails a wearing pump by hours). The error bar comes from
the scatter of the segments. An offset of the curve and the film's leak are a constant flow each and cannot be told
apart: the leak that is reported is their sum.
"""

import cmath
import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.model.arrays import ComplexArray, FloatArray

PROBE_RAD_PER_S = 2 * math.pi / 5.0  # above the weather, below where the pump's lag matters
SEGMENT_S = 60.0  # a whole number of periods
_SETTLE_S = 10.0  # of a segment: the loop's answer to the change of sign
WALK_PER_SQRT_S = 0.01 / 60.0  # of s: 1 % in an hour
RATE_PER_S = 0.03 / 3600.0  # of s, as far as nobody knows: 20 % in eight hours are followed
_RATE_LASTS_S = 4 * 3600.0
SIGMA_FIRST = 0.2  # of a pump that nobody has measured
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


@dataclass(frozen=True, slots=True)
class PumpScale:
    """What is known of the pump: its flow relative to the configured curve, and one standard error."""

    scale: float = 1.0
    sigma: float = SIGMA_FIRST


class PumpDrift:
    """Probes the pump and learns its scale. `delay_s`, `lag_s`: of the flow behind the command.

    Attributes
    ----------
    known : PumpScale
        Estimate after the last segment.
    correction : float
        Scale that the loop may use: follows the estimate slowly, and not within its error bar.
    """

    def __init__(self, delay_s: float, lag_s: float) -> None:
        self.known = PumpScale()
        self.correction = 1.0
        w = PROBE_RAD_PER_S
        self._path: ComplexArray = np.array([cmath.exp(-1j * w * delay_s) / (1j * w * (1 + 1j * w * lag_s))])
        self._signs = _SIGN_SEED
        self._sign = 1.0
        self._time_s = 0.0  # in the segment
        self._whole = True  # no tick of the segment is missing
        self._mean_um, self._mean_flow = LowPass(SEGMENT_S), LowPass(SEGMENT_S)
        self._sums: ComplexArray = np.zeros(2, complex)  # of the segment: centre and flow
        self._means: ComplexArray = np.zeros(2, complex)  # of the segments: motion seen, and expected
        self._rate_per_s = 0.0  # of the scale
        self._spread: FloatArray = np.diag([SIGMA_FIRST**2, RATE_PER_S**2])  # covariance of scale and rate
        self._scatter = 0.0
        self._count = 0

    def flow_um_per_s(self, amplitude_um: float) -> float:
        """The probe now; `amplitude_um` is that of the centre's motion without the loop's answer."""
        return self._sign * amplitude_um * PROBE_RAD_PER_S * math.sin(PROBE_RAD_PER_S * self._time_s)

    def spoil(self) -> None:
        """The segment cannot be used: no reading, or the flow was not the loop's."""
        self._whole = False

    def step(self, displacement_um: float, flow_um_per_s: float, dt_s: float) -> bool:
        """Take a tick: the reading, and the flow by the configured curve from then on. True if it ends a segment."""
        if self._time_s >= _SETTLE_S:
            turn = self._sign * cmath.exp(-1j * PROBE_RAD_PER_S * self._time_s) * dt_s
            # without the means, which are no answer to the probe
            self._sums[0] += turn * (displacement_um - self._mean_um.value)
            # the flow is held until the next reading: half a tick late
            late = cmath.exp(-0.5j * PROBE_RAD_PER_S * dt_s)
            self._sums[1] += turn * late * (flow_um_per_s - self._mean_flow.value)
        self._mean_um.update(displacement_um, dt_s)
        self._mean_flow.update(flow_um_per_s, dt_s)
        self._time_s += dt_s
        if self._time_s < SEGMENT_S - 0.5 * dt_s:
            return False
        used = self._whole and bool(np.isfinite(self._sums).all())
        if used:
            centre, flow = self._sums.tolist()
            self._learn(centre, flow * complex(self._path[0]))
        self._follow()
        self._next_segment()
        return used

    def _learn(self, centre: complex, expected: complex) -> None:
        """Compare a segment's motion with that expected of the configured curve."""
        self._count += 1
        share = 1 / min(self._count, _SEGMENTS)
        self._means += share * (np.array([centre, expected]) - self._means)
        answer, usual = self._means.tolist()
        along = answer if self._count > _SEGMENTS else usual
        size = abs(usual)
        if not size * abs(along):
            return
        scale = self.known.scale + self._rate_per_s * SEGMENT_S
        off = (centre * along.conjugate()).real / abs(along) - scale * (expected * usual.conjugate()).real / size
        if self._count <= _LEARNED:
            self._scatter += share * (off**2 - self._scatter)
            return
        most = _CLIP * math.sqrt(self._scatter)
        off = min(max(off, -most), most)
        spread = _PASSES @ self._spread @ _PASSES.T + _WANDERS
        gain = spread[0] * size / (self._scatter + spread[0, 0] * size**2)
        self._spread = spread - np.outer(gain, spread[0]) * size
        self._rate_per_s = _KEEPS * self._rate_per_s + float(gain[1]) * off
        self.known = PumpScale(scale + float(gain[0]) * off, math.hypot(math.sqrt(self._spread[0, 0]), _SIGMA_LEAST))
        self._scatter += share * (off**2 - self._scatter)

    def _follow(self) -> None:
        known, step = self.known, _RATE_PER_S * SEGMENT_S
        if abs(known.scale - self.correction) > _SURE * known.sigma:
            goal = min(max(known.scale, RANGE[0]), RANGE[1])
            self.correction += min(max(goal - self.correction, -step), step)

    def _next_segment(self) -> None:
        """Alternate the sign by a shift register of 16 bits: the same in every run, and like nothing else."""
        bits = self._signs
        bit = (bits ^ (bits >> 2) ^ (bits >> 3) ^ (bits >> 5)) & 1
        self._signs = (bits >> 1) | (bit << 15)
        self._sign = 1.0 if bit else -1.0
        self._time_s, self._whole = 0.0, True
        self._sums[:] = 0.0
