"""Smoothness of a measured curve: its jumps, and how far it may bend between two levels."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

# A jump, where a pump starts or stalls at once: less than the first share of the full flow below
# it, more than the second above.
_NONE_SHARE = 0.02
JUMP_SHARE = 0.05
# Largest distance of the commands of a jump, and of one that begins in noise.
_EDGE_MOST = 0.1
_EDGE_NOISY = 0.005

# Priors of the smoothing spline, as variances in squares of the full flow: of its second
# derivative, of the change of its slope at a kink, of the flow with which it starts, and of its
# slope there.
_ROUGH = np.geomspace(0.02, 2e4, 8)
_KINKED = (0.0, 0.01, 0.1, 1.0)
_AT_ONCE = (0.0, 0.1)
_SLOPE = 10.0
_CLEAR = 3.0  # standard errors above 0 of a certain flow
_LEAST_FLOW_UM_PER_S = 1e-3  # of the full flow, to which all is scaled


@dataclass(frozen=True, slots=True)
class Branch:
    """Flows in µm/s of the commands reached from below, or of those from above, arrays (n,)."""

    fractions: FloatArray
    flows: FloatArray
    sigmas: FloatArray

    @classmethod
    def empty(cls) -> "Branch":
        """A branch without commands."""
        return cls(np.empty(0), np.empty(0), np.empty(0))

    @property
    def columns(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """All three."""
        return self.fractions, self.flows, self.sigmas


def find_first_jump(branch: Branch, full: float) -> tuple[float, float] | None:
    """Find the first clear flow of a branch, if the curve jumps there.

    Parameters
    ----------
    branch : Branch
        One branch of the curve.
    full : float
        The full flow, µm/s.

    Returns
    -------
    (float, float) or None
        Commands just below the jump and above it.
    """
    fractions, flows, sigmas = branch.columns
    clear = np.flatnonzero(flows - 2 * sigmas > _NONE_SHARE * full)
    if not clear.size or not clear[0]:
        return None
    first = int(clear[0])
    low = float(fractions[first - 1])
    high = float(fractions[first])
    share_before = flows[first - 1] / full
    share_after = flows[first] / full

    # Noise may exceed the share of no flow, but a slope of that height takes more of the command.
    widest = _EDGE_NOISY
    if share_before < _NONE_SHARE:
        widest = _EDGE_MOST
    if share_before < JUMP_SHARE < share_after and high - low <= widest:
        return low, high
    return None


def smooth_flows(
    fractions: FloatArray, flows: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Smooth noisy flows, as far as they look smooth.

    The result is the average over curves by their likelihood: nothing up to one of the commands,
    then perhaps at once a flow, then a cubic or linear smoothing spline, as most curves are smooth
    and some have kinks. A spline from command 0 would carry its certainty of no flow into a dead
    zone.

    Parameters
    ----------
    fractions : (n,) array
        Commands, rising; the first is 0.
    flows : (n,) array
        Flow at each, µm/s.
    noise : (n, n) array
        Covariance of the flows.

    Returns
    -------
    flows : (n,) array
    covariance : (n, n) array

    Notes
    -----
    A smoothing spline is the mean of a Gaussian process (Wahba, J. R. Statist. Soc. B 40, 364
    (1978)): an integrated random walk for a cubic one, a random walk for a linear one.
    """
    full = max(float(flows.max()), _LEAST_FLOW_UM_PER_S)
    y = flows / full
    noise = noise / full**2

    # The curve may begin anywhere below the first certain flow.
    is_certain = y - _CLEAR * np.sqrt(np.diag(noise)) > 0
    first_certain = int(np.argmax(np.append(is_certain, True)))
    found: list[tuple[float, FloatArray, FloatArray]] = []
    for last_without_flow in range(max(first_certain, 1)):
        # Covariances of an integrated walk, of a walk and of a jump, from where the curve begins.
        x = np.maximum(fractions - fractions[last_without_flow], 0.0)
        low = np.minimum.outer(x, x)
        high = np.maximum.outer(x, x)
        bend = low**2 * (3 * high - low) / 6
        jump = np.outer(x > 0, x > 0)
        straight = _SLOPE * np.outer(x, x)
        for rough, kinked, at_once in product(_ROUGH, _KINKED, _AT_ONCE):
            # Mean and covariance of the curve given the flows, and -2 log likelihood of the prior.
            prior = straight + rough * bend + kinked * low + at_once * jump
            total = prior + noise
            weights = np.linalg.solve(total, prior).T
            misfit = y @ np.linalg.solve(total, y)
            cost = float(misfit + np.linalg.slogdet(total)[1])
            found.append((cost, weights @ y, prior - weights @ prior))

    # Average over all these curves: their covariances, and the scatter of their means.
    costs, means, covariances = (np.array(column) for column in zip(*found, strict=True))
    share = np.exp(-0.5 * (costs - costs.min()))
    share /= share.sum()
    mean = share @ means
    deviations = means - mean
    within = np.tensordot(share, covariances, 1)
    between = (share[:, None] * deviations).T @ deviations
    return full * mean, full**2 * (within + between)


def limit_bend(fractions: FloatArray, flows: FloatArray) -> FloatArray:
    """Limit the distance of the true flow from the straight line between two levels.

    A curve that bends one way stays between the chord of an interval and the chords beside it,
    which are continued into it: the limit is where these two meet.

    Parameters
    ----------
    fractions, flows : (n,) arrays
        Commands, and the flow at each, µm/s.

    Returns
    -------
    (n - 1,) array
        In µm/s; 0 where the chords do not meet inside the interval.
    """
    widths = np.diff(fractions)
    slopes = np.diff(flows) / widths

    # Slopes of the chords beside each interval, less its own. There is no flow below the first
    # command, and perhaps no more of it beyond the last.
    before = np.append(0.0, slopes[:-1]) - slopes
    after = np.append(slopes[1:], 0.0) - slopes

    # They meet if one is steeper and one less steep; the others' product is left out.
    product_of_slopes = np.where(before * after < 0, before * after, 0.0)
    difference = np.where(product_of_slopes, before - after, 1.0)
    return np.abs(product_of_slopes * widths / difference)
