"""Normal equations of one set, with its surface eliminated (variable projection).

The unknowns of set i are its surface q_i (parameters,) and the height z_i of its vertex; those of
all sets are the geometry's parameters, the ring's form and the laser's scale. The Schur complement
over (q_i, z_i) leaves a matrix of the common unknowns alone. These matrices add, so that the cost
grows with the number of sets and not with its cube, and any subset of the sets, and any choice of
free parameters, can be solved again without another look at the points.

Each set adds two more observations to the same matrix. The ring does not move: the harmonics 0..7
of the height of the rim, z_i e_0 + E q_i, are the same in all sets (a polynomial of degree 7 has
no others). The laser gives the vertex: z_i = -(1 + scale) (d_i - reference) / 1000, d_i in µm.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.calibration.reference_rows import reference_rows
from membrane_ctrl.metrology.calibration.robust_weights import RobustWeights
from membrane_ctrl.metrology.calibration.set_state import COMMON, References, SetState
from membrane_ctrl.metrology.rays import bench_poses, forward_model, set_phases
from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class Equations:
    """The equations of one set, linearised at its unknowns."""

    # (LOCAL + COMMON + 1, squared): J^T W J of the prediction's derivatives, with the residual as
    # one more column: normal matrix, right side and sum of squares in one
    sums: FloatArray
    residual_mm: FloatArray  # (2, n): seen minus predicted screen points
    trust: RobustWeights  # the points' weights
    residual_rms_mm: float  # RMS of one component, each point counting by its weight
    # of each screen elsewhere, (MOVED + LOCAL + COMMON + 1, squared): its own unknowns first, which
    # `sums` eliminates
    elsewhere: tuple[FloatArray, ...] = ()

    @property
    def variance(self) -> float:
        """Assumed variance of the points over the expected one."""
        return self.trust.variance

    def local_step(self, common_step: FloatArray) -> FloatArray:
        """Step (LOCAL,) of the set's own unknowns that goes with one of the common ones."""
        own, mixed = (
            self.sums[: forward_model.LOCAL, : forward_model.LOCAL],
            self.sums[: forward_model.LOCAL, forward_model.LOCAL :],
        )
        return np.asarray(np.linalg.solve(own, mixed[:, -1] - mixed[:, :-1] @ common_step))

    def moved(self, local_step: FloatArray, common_step: FloatArray) -> list[FloatArray]:
        """Steps (MOVED,) of the screens elsewhere that go with those."""
        step, own = np.append(local_step, common_step), slice(set_phases.MOVED)
        right = [sums[own, -1] - sums[own, set_phases.MOVED : -1] @ step for sums in self.elsewhere]
        pairs = zip(self.elsewhere, right, strict=True)
        return [np.asarray(np.linalg.solve(sums[own, own], each)) for sums, each in pairs]

    def reduced(self) -> FloatArray:
        """Schur complement over the set's own unknowns, (COMMON + 1, squared)."""
        return eliminate_first(self.sums, forward_model.LOCAL)


def eliminate_first(sums: FloatArray, first: int) -> FloatArray:
    """Schur complement over the first unknowns."""
    mixed = sums[:first, first:]
    left = sums[first:, first:] - mixed.T @ np.linalg.solve(sums[:first, :first], mixed)
    return np.asarray((left + left.T) / 2)


def linearise_set(
    bench: bench_poses.BenchGeometry,
    turns: list[bench_poses.Poses],
    phases: set_phases.SetPhases,
    state: SetState,
    common: FloatArray,
    references: References,
    trust: RobustWeights,
) -> Equations:
    """Linearise one set; `common` (COMMON,) are parameters and ring."""
    root = np.sqrt(trust.weights / trust.variance) / phases.sigma_mm
    residual, elsewhere = np.empty_like(phases.screen_mm), []
    rows = reference_rows(phases, state, common, references)
    sums = rows.T @ rows
    for k, there, poses, some in forward_model.screen_views(bench, turns, phases, state.elsewhere):
        move = state.elsewhere[k - 1] if k else np.array([0.0, state.motion_mm])
        seen, film_mm = phases.subset(some), (move[-1], move[-2])
        parts = forward_model.linearise_points(
            there, poses, seen, state.surface, state.vertex_z_mm, *film_mm
        )
        found, residual[:, some] = _sum_fringes(parts, root[some], k > 0)
        if k:
            told, sigmas = phases.elsewhere[k - 1].known(references.laser_sigma_um)
            hand = np.hstack([np.eye(set_phases.MOVED), (told - move)[:, None]]) / sigmas[:, None]
            own = np.append(np.arange(set_phases.MOVED), len(found) - 1)
            found[np.ix_(own, own)] += hand.T @ hand
            elsewhere.append(found)
            found = eliminate_first(found, set_phases.MOVED)
        sums = sums + found
    weights = trust.weights / phases.sigma_mm**2
    rms = float(np.sqrt(np.mean(residual**2 @ weights) / np.sum(weights)))
    return Equations(sums, residual, trust, rms, tuple(elsewhere))


def _sum_fringes(
    parts: Iterable[forward_model.Chunk], root: FloatArray, moved: bool
) -> tuple[FloatArray, FloatArray]:
    """Sums of points, those of a moved screen with its own unknowns first, and their residuals (2,
    n).
    """
    first = set_phases.MOVED if moved else 0
    sums, left = np.zeros((first + forward_model.LOCAL + COMMON + 1,) * 2), np.empty((2, root.size))
    keep = np.append(np.arange(first + forward_model.COLUMNS), len(sums) - 1)
    for part in parts:
        left[:, part.place] = part.residual_mm
        derivatives = part.derivatives
        if moved:
            motion = derivatives[:, forward_model.MOTION].copy()
            derivatives[:, forward_model.MOTION] = 0.0  # its own
            columns = [
                derivatives[:, forward_model.COLUMNS :],
                forward_model.depth_derivative(motion)[:, None],
                motion[:, None],
            ]
            derivatives = np.concatenate(
                [*columns, derivatives[:, : forward_model.COLUMNS]], axis=1
            )
        for rows, miss in zip(derivatives, part.residual_mm, strict=True):
            weighed = np.vstack([rows, miss]) * root[part.place]
            sums[np.ix_(keep, keep)] += weighed @ weighed.T
    return sums, left
