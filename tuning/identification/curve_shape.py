"""Smoothness of a measured curve: its jumps, and how far it may bend between two levels."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

# flow at which a pump starts or stalls at once
_NONE_SHARE = 0.02
JUMP_SHARE = 0.05
# between the commands of a jump, and of one that begins in noise
_EDGE_MOST = 0.1
_EDGE_NOISY = 0.005
_ROUGH = np.geomspace(
    0.02, 2e4, 8
)  # of the curve: square of its second derivative, of the full flow
_KINKED = (0.0, 0.01, 0.1, 1.0)  # as above: square of the change of its slope ...
_AT_ONCE = (0.0, 0.1)  # ... square of the flow with which it starts ...
_SLOPE = 10.0  # ... and of its slope there
_CLEAR = 3.0  # standard errors: a flow beyond doubt


@dataclass(frozen=True, slots=True)
class Branch:
    """Flows in µm/s of the commands reached from below, or of those from above, arrays (n,)."""

    fractions: FloatArray
    flows: FloatArray
    sigmas: FloatArray

    @property
    def columns(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """All three."""
        return self.fractions, self.flows, self.sigmas


NO_BRANCH = Branch(np.empty(0), np.empty(0), np.empty(0))


def find_first_jump(branch: Branch, full: float) -> tuple[float, float] | None:
    """Commands just below and at the first clear flow, if that is a jump."""
    fractions, flows, sigmas = branch.columns
    clear = np.flatnonzero(flows - 2 * sigmas > _NONE_SHARE * full)
    if not clear.size or not clear[0]:
        return None
    low, high = fractions[clear[0] - 1 : clear[0] + 1].tolist()
    before, after = flows[clear[0] - 1 : clear[0] + 1] / full
    # noise may be more than none, but a slope of that height takes more of the command
    widest = _EDGE_MOST if before < _NONE_SHARE else _EDGE_NOISY
    return (low, high) if before < JUMP_SHARE < after and high - low <= widest else None


def smooth_flows(
    fractions: FloatArray, flows: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Noisy flows, made as smooth as they look, and the covariance of the result; `noise` is that
    of the flows.

    The first is at command 0. The average over curves by their likelihood: nothing up to one of the
    commands, then perhaps at once a flow, then a cubic or linear smoothing spline (Wahba 1978), as
    most curves are smooth and some have kinks. A spline from command 0 would carry its certainty of
    no flow into a dead zone.
    """
    full = max(float(flows.max()), 1e-3)
    y, noise = flows / full, noise / full**2
    none = int(
        np.argmax(np.append(y - _CLEAR * np.sqrt(np.diag(noise)) > 0, True))
    )  # the first certain flow
    found: list[tuple[float, FloatArray, FloatArray]] = []
    for last in range(max(none, 1)):
        x = np.maximum(fractions - fractions[last], 0.0)
        low, high = np.minimum.outer(x, x), np.maximum.outer(x, x)
        bend, jump = low**2 * (3 * high - low) / 6, np.outer(x > 0, x > 0)
        for rough, kinked, at_once in product(_ROUGH, _KINKED, _AT_ONCE):
            free = _SLOPE * np.outer(x, x) + rough * bend + kinked * low + at_once * jump
            weights = np.linalg.solve(free + noise, free).T
            cost = float(y @ np.linalg.solve(free + noise, y) + np.linalg.slogdet(free + noise)[1])
            found.append((cost, weights @ y, free - weights @ free))
    costs, means, covariances = (np.array(column) for column in zip(*found, strict=True))
    share = np.exp(-0.5 * (costs - costs.min()))
    share /= share.sum()
    mean = share @ means
    deviations = means - mean
    spread = np.tensordot(share, covariances, 1) + (share[:, None] * deviations).T @ deviations
    return full * mean, full**2 * spread


def limit_bend(fractions: FloatArray, flows: FloatArray) -> FloatArray:
    """By how much the flow may be off the straight line in each interval: where the chords beside
    it would meet.

    There is no flow below the first command, and perhaps no more of it beyond the last.
    """
    widths = np.diff(fractions)
    slopes = np.diff(flows) / widths
    before, after = np.append(0.0, slopes[:-1]) - slopes, np.append(slopes[1:], 0.0) - slopes
    across = np.where(before * after < 0, before * after, 0.0)
    return np.abs(across * widths / np.where(across, before - after, 1.0))
