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
from membrane_ctrl.metrology.rays import bench_poses, forward_model, moved_screen, set_phases
from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class Equations:
    """The equations of one set, linearised at its unknowns.

    Attributes
    ----------
    sums : (LOCAL + COMMON + 1, LOCAL + COMMON + 1) array
        J^T W J of the prediction's derivatives, with the residual as one more column: normal
        matrix, right side and sum of squares in one.
    residual_mm : (2, n) array
        Seen minus predicted screen points.
    robust : RobustWeights
        Weights of the points.
    residual_rms_mm : float
        RMS of one component, each point counting by its weight.
    moved_screens : tuple of arrays
        Of each screen elsewhere, (MOVED + LOCAL + COMMON + 1, squared): its own unknowns first,
        which `sums` eliminates.
    y_sums : (LOCAL + COMMON + 1, LOCAL + COMMON + 1) array
        The part of `sums` of the y fringes, with the screen at its own place.
    """

    sums: FloatArray
    residual_mm: FloatArray
    robust: RobustWeights
    residual_rms_mm: float
    moved_screens: tuple[FloatArray, ...]
    y_sums: FloatArray

    @property
    def variance(self) -> float:
        """Assumed variance of the points over the expected one."""
        return self.robust.variance

    def local_step(self, common_step: FloatArray) -> FloatArray:
        """Solve for the set's own unknowns, given a step of the common ones.

        Parameters
        ----------
        common_step : (COMMON,) array

        Returns
        -------
        (LOCAL,) array
            A^-1 (b - B dc) of the normal equations [[A, B], [B^T, D]] (dq, dc) = (b, d).
        """
        local = forward_model.LOCAL
        own = self.sums[:local, :local]
        mixed = self.sums[:local, local:-1]
        right = self.sums[:local, -1]
        return np.asarray(np.linalg.solve(own, right - mixed @ common_step))

    def screen_steps(self, local_step: FloatArray, common_step: FloatArray) -> list[FloatArray]:
        """Steps of the screens elsewhere that go with those of the other unknowns.

        Parameters
        ----------
        local_step : (LOCAL,) array
            Step of the set's own unknowns.
        common_step : (COMMON,) array
            Step of the common ones.

        Returns
        -------
        list of (MOVED,) arrays
            One for each place of the screen.
        """
        moved = moved_screen.MOVED
        step = np.append(local_step, common_step)
        steps = []
        for sums in self.moved_screens:
            own = sums[:moved, :moved]
            mixed = sums[:moved, moved:-1]
            right = sums[:moved, -1] - mixed @ step
            steps.append(np.asarray(np.linalg.solve(own, right)))
        return steps

    def eliminate_surface(self) -> FloatArray:
        """Schur complement over the set's own unknowns, (COMMON + 1, squared)."""
        return eliminate_first(self.sums, forward_model.LOCAL)


def eliminate_first(sums: FloatArray, first: int) -> FloatArray:
    """Eliminate the first unknowns of normal equations.

    Parameters
    ----------
    sums : (n, n) array
        Normal matrix with the right side as last column and row.
    first : int
        Number of the unknowns to eliminate.

    Returns
    -------
    (n - first, n - first) array
        Schur complement D - B^T A^-1 B of [[A, B], [B^T, D]]: the equations of the others, and in
        its last element the least sum of squares over those eliminated.
    """
    own = sums[:first, :first]
    mixed = sums[:first, first:]
    others = sums[first:, first:]
    complement = others - mixed.T @ np.linalg.solve(own, mixed)
    return np.asarray((complement + complement.T) / 2)


def linearise_set(
    bench: bench_poses.BenchGeometry,
    turns: list[bench_poses.Poses],
    phases: set_phases.SetPhases,
    state: SetState,
    common: FloatArray,
    references: References,
    robust: RobustWeights,
) -> Equations:
    """Linearise one set.

    Parameters
    ----------
    bench : BenchGeometry
        The bench at the present parameters.
    turns : list of Poses
        Derivatives of the poses by their parameters.
    phases : SetPhases
        Screen points of the set.
    state : SetState
        Its own unknowns.
    common : (COMMON,) array
        Parameters and ring.
    references : References
        What laser and ring are known by.
    robust : RobustWeights
        Weights of the points.

    Returns
    -------
    Equations
    """
    # The laser, the ring and other observations beside the fringes.
    rows = reference_rows(phases, state, common, references)
    sums = rows.T @ rows

    # The fringes, for each place of the screen.
    root_weights = np.sqrt(robust.weights / robust.variance) / phases.sigma_mm
    residual_mm = np.empty_like(phases.screen_mm)
    moved_screens = []
    y_sums = np.zeros_like(sums)
    for k, there, poses, some in forward_model.screen_views(
        bench, turns, phases, state.moved_screens
    ):
        # Depth and motion of the film with the screen there: the last two unknowns of its place.
        deeper_mm = 0.0
        motion_mm = state.motion_mm
        if k:
            move = state.moved_screens[k - 1]
            deeper_mm = move[-2]
            motion_mm = move[-1]
        parts = forward_model.linearise_points(
            there,
            poses,
            phases.subset(some),
            state.surface,
            state.vertex_z_mm,
            motion_mm,
            deeper_mm,
        )
        by_axis, residual_mm[:, some] = _sum_fringes(parts, root_weights[some], k > 0)
        found = by_axis[0] + by_axis[1]
        if not k:
            y_sums = by_axis[1]
        if k:
            # What is known of the screen's move; then its own unknowns are eliminated.
            known, sigmas = phases.moved_screens[k - 1].make_prior(references.laser_sigma_um)
            by_hand = np.hstack([np.eye(moved_screen.MOVED), (known - move)[:, None]])
            by_hand /= sigmas[:, None]
            own = np.append(np.arange(moved_screen.MOVED), len(found) - 1)
            found[np.ix_(own, own)] += by_hand.T @ by_hand
            moved_screens.append(found)
            found = eliminate_first(found, moved_screen.MOVED)
        sums = sums + found

    weights = robust.weights / phases.sigma_mm**2
    mean_square_mm2 = np.mean(residual_mm**2 @ weights) / np.sum(weights)
    rms_mm = float(np.sqrt(mean_square_mm2))
    return Equations(sums, residual_mm, robust, rms_mm, tuple(moved_screens), y_sums)


def _sum_fringes(
    parts: Iterable[forward_model.Chunk], root: FloatArray, moved: bool
) -> tuple[FloatArray, FloatArray]:
    """Sums (2, ...) of the x and of the y fringes of points, those of a moved screen with its own
    unknowns first, and their residuals (2, n).

    `root` (n,) are the square roots of the points' weights.
    """
    own = 0
    if moved:
        own = moved_screen.MOVED
    size = own + forward_model.LOCAL + COMMON + 1
    sums = np.zeros((2, size, size))
    residual_mm = np.empty((2, root.size))
    # The columns that fringes have; the last one is the residual.
    columns = np.append(np.arange(own + forward_model.COLUMNS), size - 1)
    for part in parts:
        residual_mm[:, part.place] = part.residual_mm
        derivatives = part.derivatives
        if moved:
            derivatives = _put_moves_first(derivatives)
        # x and then y: the rows of all unknowns and the residual, times the root of the weights.
        for own_sums, of_axis, residual in zip(sums, derivatives, part.residual_mm, strict=True):
            weighed = np.vstack([of_axis, residual]) * root[part.place]
            own_sums[np.ix_(columns, columns)] += weighed @ weighed.T
    return sums, residual_mm


def _put_moves_first(derivatives: FloatArray) -> FloatArray:
    """Derivatives (2, MOVED + COLUMNS, m) with the unknowns of a moved screen first.

    Those are its poses, and depth and motion of the film, which had another motion then.
    """
    motion = derivatives[:, forward_model.MOTION].copy()
    derivatives[:, forward_model.MOTION] = 0.0
    poses = derivatives[:, forward_model.COLUMNS :]
    depth = forward_model.depth_derivative(motion)
    of_set = derivatives[:, : forward_model.COLUMNS]
    return np.concatenate([poses, depth[:, None], motion[:, None], of_set], axis=1)
