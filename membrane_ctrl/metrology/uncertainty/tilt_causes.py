"""What motions of a bench between two sets did to the change of its figure, given the ring's tilt.

A bench moves within the allowances of its bodies (`MotionGroup.allowance`), or one body was knocked
as well. Each is a hypothesis H: the motions a are normal with the covariance P_H. The ring tilts by
c = h a + e, where h is the tilt per motion and e, the error of the tilt, has the covariance C. With
V = h P h^T + C,

    p(c | H) = exp(-c^T V^-1 c / 2) / (2 pi |V|^(1/2)),
    E(a | c, H) = P h^T V^-1 c,  cov(a | c, H) = P - P h^T V^-1 h P.

The hypotheses are weighted by p(c | H) times their prior probability. The change of the figure is
not corrected: its bar contains the mean square of S a, which S makes of the motions. A knock counts
as far as the tilt makes it likelier than it was before: a bar need not contain what nothing shows.

A small tilt is explained by the allowances: several bodies moved by little. Only a larger one is a
knock. The worst body alone would be up to four times as far off as the bench is; and two bodies
that tilt the ring in opposite directions are farther off than each alone.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.rays.bench_motions import COMPONENTS, GROUPS, group_columns
from membrane_ctrl.model.arrays import FloatArray

# Probability, before the tilt is known, that a body of the bench was knocked between two sets.
_KNOCKED = 0.3
# Sizes of a knock, 1 sigma of each component, µm or µrad; up to the largest of the group.
_KNOCK_SIZES = (10.0, 30.0, 100.0, 300.0, 1000.0)

_TINY = 1e-300  # instead of a division by zero


@dataclass(frozen=True)
class _Hypothesis:
    """How the bench has moved.

    Attributes
    ----------
    variances : (components,) array
        Of the motions, µm^2 or µrad^2.
    prior : float
        Probability before the tilt is known.
    is_knock : bool
        Whether a body was knocked.
    """

    variances: FloatArray
    prior: float
    is_knock: bool


@dataclass(frozen=True)
class TiltCauses:
    """Mean squares of what motions did to a change of the figure.

    Attributes
    ----------
    knocked_mm2, allowed_mm2 : (parameters, parameters) arrays
        By a knock, and by motions within the allowances, each times its weight.
    """

    knocked_mm2: FloatArray
    allowed_mm2: FloatArray


def find_tilt_causes(
    figure_mm: FloatArray, harmonic: FloatArray, tilt_mm: FloatArray, tilt_mm2: FloatArray
) -> TiltCauses:
    """Find what motions did to a change of the figure.

    Parameters
    ----------
    figure_mm : (parameters, components) array
        S: change of the parameters by each motion, mm per µm or µrad.
    harmonic : (2, parameters) array
        Tilt of the ring by the parameters (`motion_evidence.ring_tilt`).
    tilt_mm : (2,) array
        c: change of the ring's tilt.
    tilt_mm2 : (2, 2) array
        C: its covariance on a bench at rest.

    Returns
    -------
    TiltCauses
    """
    of_tilt = harmonic @ figure_mm
    # The figure turns with a mirror that tilts as a whole: that is no error of its change.
    effect_mm = np.array(figure_mm)
    for group, columns in zip(GROUPS, group_columns(), strict=True):
        if group.is_of_mirror:
            effect_mm[:, columns] = 0.0

    logs = []
    moments_mm2 = []
    hypotheses = list(_list_hypotheses())
    for each in hypotheses:
        spread = each.variances[:, None] * of_tilt.T
        covariance_mm2 = of_tilt @ spread + tilt_mm2
        gain = spread @ np.linalg.inv(covariance_mm2)
        distance = float(tilt_mm @ np.linalg.solve(covariance_mm2, tilt_mm))
        _, log_determinant = np.linalg.slogdet(covariance_mm2)
        logs.append(math.log(each.prior) - (distance + float(log_determinant)) / 2)
        # Mean square of the motions: their covariance, and the square of their mean.
        mean = gain @ tilt_mm
        motions = np.diag(each.variances) - gain @ spread.T + np.outer(mean, mean)
        moments_mm2.append(effect_mm @ motions @ effect_mm.T)

    # Probabilities given the tilt; a knock counts as far as the tilt makes it likelier.
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    is_knock = np.array([each.is_knock for each in hypotheses])
    knocked = float(weights @ is_knock)
    likelier = max(0.0, (knocked - _KNOCKED) / (1 - _KNOCKED))
    moments = np.array(moments_mm2)
    by_knock = weights * is_knock * likelier / max(knocked, _TINY)
    within = np.where(is_knock, 0.0, 1 - likelier)
    return TiltCauses(
        np.einsum("h,hpq->pq", by_knock, moments), np.einsum("h,hpq->pq", within, moments)
    )


def _list_hypotheses() -> Iterator[_Hypothesis]:
    """All motions within their allowances; and one visible group knocked besides, by each size."""
    allowed = np.zeros(COMPONENTS)
    for group, columns in zip(GROUPS, group_columns(), strict=True):
        allowed[columns] = group.allowance**2
    yield _Hypothesis(allowed, 1 - _KNOCKED, False)

    visible = [
        (columns, [size for size in _KNOCK_SIZES if size <= group.knock])
        for group, columns in zip(GROUPS, group_columns(), strict=True)
        if not group.is_hidden
    ]
    for columns, sizes in visible:
        for size in sizes:
            variances = allowed.copy()
            variances[columns] += size**2
            yield _Hypothesis(variances, _KNOCKED / len(visible) / len(sizes), True)
