"""Normal equations of one set, with its surface eliminated (variable projection).

The unknowns of set i are its surface q_i (parameters,) and the height z_i of its vertex; those of
all sets are the geometry's parameters, the ring's form and the laser's scale. The Schur complement
over (q_i, z_i) leaves a matrix of the common unknowns alone. These matrices add, so that the cost
grows with the number of sets and not with its cube, and any subset of the sets, and any choice of
free parameters, can be solved again without another look at the points.

Each set adds two more observations to the same matrix. The ring does not move: the harmonics 0..7
of the height of the rim, z_i e_0 + E q_i, are the same in all sets (a polynomial of degree 7 has no
others). The laser gives the
vertex: z_i = -(1 + scale) (d_i - reference) / 1000, d_i in µm.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from membrane_ctrl.metrology.film import film_law
from membrane_ctrl.metrology.rays import bench_parameters, forward_model
from membrane_ctrl.metrology.rays.surface import (
    PARAMETERS,
    Artefact,
    SeenScreen,
    Surface,
    beyond_of,
)
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE

RING = (
    2 * ZERNIKE_DEGREE + 1
)  # harmonics of the rim: a constant, cosines and sines up to the degree
COMMON = len(bench_parameters.NAMES) + RING  # parameters of `NAMES`, then the ring
# The film as a check of the geometry. Its round terms beyond the fit's are a micrometre of a 37 mm
# bowl, and a nanometre of them is 10 µm of sag: "free" knows nothing of them, "prestressed" takes
# them from the law, whatever slackness the set's own excess shows, "hencky" has the excess of the
# film without
# pre-strain and
# nu = 0.3
FilmModel = Literal["free", "hencky", "prestressed"]
_FREE_MM, _LAW_MM = 1e-3, 1e-7
_TILT_STEP = 1e-4
# across the mirror's picture: finer than the geometry's patterns, coarser than a film's ripple
_PATCHES = 12
_FEW_IN_PATCH = 4
_CHANCE = 0.5  # by which patches' variance exceeds single points' without a cause
# of the length of two normal components: keeps 95 % of the efficiency of least squares
_HUBER = 1.9


@dataclass(frozen=True)
class SetState:
    """Values of a set's own unknowns."""

    surface: Surface
    vertex_z_mm: float  # height of its vertex
    motion_mm: float = 0.0  # by how much the film was deeper in the x frames than in the y frames
    elsewhere: tuple[FloatArray, ...] = ()  # (MOVED,) of each screen elsewhere


@dataclass(frozen=True)
class References:
    """Knowledge besides the fringes."""

    reference_um: float  # laser reading at which the vertex is at z = 0
    laser_sigma_um: float = 1.0  # of a set's mean reading
    # the clamp creeps by less than a micrometre in the minutes that a calibration takes
    ring_sigma_um: float = 1.0  # how far the ring's harmonics may differ from set to set
    film: FilmModel = "free"  # what the film's round terms beyond the fit's are


@dataclass(frozen=True)
class Trust:
    """Robust weights (n,) of points, 1 for a good one, and their variance over the expected one."""

    weights: FloatArray
    variance: float
    alike: float = 1.0  # part of the variance from residuals that neighbours share: a pattern

    @classmethod
    def full(cls, phases: forward_model.SetPhases) -> "Trust":
        """Every point with the weight of its noise."""
        return cls(np.ones(phases.sigma_mm.size), 1.0)

    @classmethod
    def seen(cls, phases: forward_model.SetPhases, residual_mm: FloatArray) -> "Trust":
        """From residuals (2, n): Huber's weights against their own scatter."""
        length = np.hypot(*residual_mm) / phases.sigma_mm
        # the median of a Rayleigh distribution is 1.177 sigma; less noise than the camera must have
        # is not accepted
        variance = max(float(np.median(length) / 1.1774) ** 2, 1.0)
        return cls(_HUBER / np.maximum(length / np.sqrt(variance), _HUBER), variance)


def less_trust(
    sets: Sequence[forward_model.SetPhases], left_mm: Sequence[FloatArray], trust: Sequence[Trust]
) -> tuple[Trust, ...]:
    """Trust in the points of all sets, from their residuals (2, n) at a solution.

    What a film has beyond the model is alike in neighbouring points, and in all sets: it does not
    average out as noise does. So the means over patches of the picture are compared with what
    single points let expect, set by set and as sums over the sets; where they scatter more, all
    points weigh less.
    """
    films = [
        k for k, phases in enumerate(sets) if phases.artefact is None
    ]  # an artefact is seen smaller
    side_px = max(_across_px(sets[k]) for k in films) / _PATCHES
    sides_px = [
        side_px if phases.artefact is None else _across_px(phases) / _PATCHES for phases in sets
    ]
    patches = [_patch_means(*each) for each in zip(sets, left_mm, trust, sides_px, strict=True)]
    together = _scatter(np.sum([patches[k] for k in films], axis=0) / np.sqrt(len(films)))
    alike = [together if phases.artefact is None else 0.0 for phases in sets]
    factors = [
        max(1.0, _scatter(m) - _CHANCE, all_ - _CHANCE)
        for m, all_ in zip(patches, alike, strict=True)
    ]
    return tuple(
        replace(t, variance=t.variance * f, alike=f) for t, f in zip(trust, factors, strict=True)
    )


def _across_px(phases: forward_model.SetPhases) -> float:
    """Longer side of the picture of what the camera sees."""
    return float(max(np.ptp(phases.column_px), np.ptp(phases.row_px)))


def _patch_means(
    phases: forward_model.SetPhases, left_mm: FloatArray, trust: Trust, side_px: float
) -> FloatArray:
    """Residuals' means over patches in units of their noise, (2, patches, patches); NaN with few
    points.
    """
    column, row = (
        np.floor(place / side_px).astype(int) for place in (phases.column_px, phases.row_px)
    )
    count = _PATCHES + 2
    patch = row % count * count + column % count  # the same in all sets
    weights = trust.weights / (trust.variance * phases.sigma_mm**2)
    total = np.bincount(patch, weights, count**2)
    sums = np.stack([np.bincount(patch, weights * part, count**2) for part in left_mm])
    full = np.bincount(patch, minlength=count**2) >= _FEW_IN_PATCH
    return np.where(full, sums / np.sqrt(np.where(full, total, 1.0)), np.nan)


def _scatter(means: FloatArray) -> float:
    """Their variance, as if they were alone: those that the fit has taken are as good as gone."""
    known = means[np.isfinite(means)]
    free = known.size - forward_model.LOCAL
    return float(np.sum(known**2) / free) if free > forward_model.LOCAL else 1.0


@dataclass(frozen=True)
class Equations:
    """The equations of one set, linearised at its unknowns."""

    # (LOCAL + COMMON + 1, squared): J^T W J of the prediction's derivatives, with the residual as
    # one more column: normal matrix, right side and sum of squares in one
    sums: FloatArray
    residual_mm: FloatArray  # (2, n): seen minus predicted screen points
    trust: Trust  # the points' weights
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
        step, own = np.append(local_step, common_step), slice(forward_model.MOVED)
        right = [
            sums[own, -1] - sums[own, forward_model.MOVED : -1] @ step for sums in self.elsewhere
        ]
        pairs = zip(self.elsewhere, right, strict=True)
        return [np.asarray(np.linalg.solve(sums[own, own], each)) for sums, each in pairs]

    def reduced(self) -> FloatArray:
        """Schur complement over the set's own unknowns, (COMMON + 1, squared)."""
        return without(self.sums, forward_model.LOCAL)


def without(sums: FloatArray, first: int) -> FloatArray:
    """Schur complement over the first unknowns."""
    mixed = sums[:first, first:]
    left = sums[first:, first:] - mixed.T @ np.linalg.solve(sums[:first, :first], mixed)
    return np.asarray((left + left.T) / 2)


def equations(
    bench: bench_parameters.BenchGeometry,
    turns: list[bench_parameters.Poses],
    phases: forward_model.SetPhases,
    state: SetState,
    common: FloatArray,
    references: References,
    trust: Trust,
) -> Equations:
    """Linearise one set; `common` (COMMON,) are parameters and ring."""
    root = np.sqrt(trust.weights / trust.variance) / phases.sigma_mm
    residual, elsewhere = np.empty_like(phases.screen_mm), []
    rows = _reference_rows(phases, state, common, references)
    sums = rows.T @ rows
    for k, there, poses, some in forward_model.views(bench, turns, phases, state.elsewhere):
        move = state.elsewhere[k - 1] if k else np.array([0.0, state.motion_mm])
        seen, film_mm = phases.subset(some), (move[-1], move[-2])
        parts = forward_model.chunks(there, poses, seen, state.surface, state.vertex_z_mm, *film_mm)
        found, residual[:, some] = _fringes(parts, root[some], k > 0)
        if k:
            told, sigmas = phases.elsewhere[k - 1].known(references.laser_sigma_um)
            hand = (
                np.hstack([np.eye(forward_model.MOVED), (told - move)[:, None]]) / sigmas[:, None]
            )
            own = np.append(np.arange(forward_model.MOVED), len(found) - 1)
            found[np.ix_(own, own)] += hand.T @ hand
            elsewhere.append(found)
            found = without(found, forward_model.MOVED)
        sums = sums + found
    weights = trust.weights / phases.sigma_mm**2
    rms = float(np.sqrt(np.mean(residual**2 @ weights) / np.sum(weights)))
    return Equations(sums, residual, trust, rms, tuple(elsewhere))


def _fringes(
    parts: Iterable[forward_model.Chunk], root: FloatArray, moved: bool
) -> tuple[FloatArray, FloatArray]:
    """Sums of points, those of a moved screen with its own unknowns first, and their residuals (2,
    n).
    """
    first = forward_model.MOVED if moved else 0
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
                forward_model.deeper(motion)[:, None],
                motion[:, None],
            ]
            derivatives = np.concatenate(
                [*columns, derivatives[:, : forward_model.COLUMNS]], axis=1
            )
        for rows, miss in zip(derivatives, part.residual_mm, strict=True):
            weighed = np.vstack([rows, miss]) * root[part.place]
            sums[np.ix_(keep, keep)] += weighed @ weighed.T
    return sums, left


def _reference_rows(
    phases: forward_model.SetPhases, state: SetState, common: FloatArray, references: References
) -> FloatArray:
    """What is known of the set besides its fringes, as weighted rows [derivatives, miss].

    Of a film: ring, laser, motion and law. Of an artefact: its form.
    """
    if isinstance(phases.artefact, SeenScreen):
        return np.eye(forward_model.LOCAL, forward_model.LOCAL + COMMON + 1)  # there is no surface
    if phases.artefact is not None:
        return _artefact_rows(phases.artefact, state)
    rows = np.zeros((RING + 2, forward_model.LOCAL + COMMON + 1))
    rows[-1, forward_model.MOTION], rows[-1, -1] = 1.0, 1e-3 * phases.motion_um - state.motion_mm
    rows[-1] /= max(phases.motion_sigma_um, forward_model.STILL_UM) * 1e-3
    ring = rows[:RING]
    ring[:, :PARAMETERS] = rim_harmonics()
    ring[0, PARAMETERS] = 1.0
    ring[0, forward_model.BEYOND] = _rim_beyond()
    ring[:, forward_model.LOCAL + len(bench_parameters.NAMES) : -1] = -np.eye(RING)
    ring[:, -1] = common[len(bench_parameters.NAMES) :] - rim_of(state)
    ring /= references.ring_sigma_um * 1e-3
    if np.isfinite(phases.displacement_um):
        moved_mm = (phases.displacement_um - references.reference_um) * 1e-3
        laser = rows[RING]
        laser[PARAMETERS] = 1.0
        laser[forward_model.LOCAL + bench_parameters.OPTICAL] = moved_mm
        laser[-1] = -(1 + common[bench_parameters.OPTICAL]) * moved_mm - state.vertex_z_mm
        laser /= references.laser_sigma_um * 1e-3
    return np.vstack([rows, film_rows(state.surface, references.film)])


def film_rows(surface: Surface, film: FilmModel) -> FloatArray:
    """What the film says of the terms beyond the fit's, as weighted rows [derivatives, miss]."""
    rows = np.zeros((len(film_law.BEYOND), forward_model.LOCAL + COMMON + 1))
    rows[:, forward_model.BEYOND] = np.eye(len(film_law.BEYOND))
    rows[:, -1] = -np.array(surface.beyond_mm or [0.0] * len(film_law.BEYOND))
    if film == "prestressed":
        excess_mm, step_mm = surface.parameters[-1], 1e-5
        here, there = (beyond_of(excess_mm + d, surface.sag_mm) for d in (0.0, step_mm))
        rows[:, PARAMETERS - 1] = (here - there) / step_mm
        rows[:, -1] += here
    return rows / (_FREE_MM if film == "free" else _LAW_MM)


def _artefact_rows(artefact: Artefact, state: SetState) -> FloatArray:
    """Form and place of an artefact as weighted rows; its tilt, the first two terms,
    is not known.
    """
    terms = [*range(PARAMETERS), *range(forward_model.BEYOND.start, forward_model.BEYOND.stop)]
    rows = np.zeros((len(terms), forward_model.LOCAL + COMMON + 1))
    form, (vertex, still) = rows[2:], rows[:2]
    surface, origin = state.surface, np.zeros(1)
    form[:, terms] = np.eye(len(terms))[2:]
    # the tilt at the vertex is the surface's own, and its form follows: 5 µm of coma for a
    # milliradian
    leans = (
        np.stack([part[:, 0] for part in forward_model.basis(origin, origin)[1:]])
        / surface.radius_mm
    )
    tilt = leans @ surface.parameters
    here = artefact.terms_mm(*tilt)
    form[:, -1] = (
        here - np.append(surface.parameters, surface.beyond_mm or [0.0] * len(film_law.BEYOND))
    )[2:]
    for step, lean in zip(_TILT_STEP * np.eye(2), leans, strict=True):
        form[:, :PARAMETERS] -= np.outer(
            (artefact.terms_mm(*(tilt + step)) - here)[2:] / _TILT_STEP, lean
        )
    form[:] = np.linalg.solve(np.linalg.cholesky(artefact.covariance_mm2()[2:, 2:]), form)
    vertex[[PARAMETERS, -1]] = (
        np.array([1.0, artefact.vertex_mm - state.vertex_z_mm]) / artefact.vertex_sigma_mm
    )
    still[forward_model.MOTION] = 1.0 / (1e-3 * forward_model.STILL_UM)
    return rows


def rim_of(state: SetState) -> FloatArray:
    """Harmonics (RING,) of the rim's height in world."""
    out = rim_harmonics() @ state.surface.parameters
    out[0] += state.vertex_z_mm + (
        _rim_beyond() @ state.surface.beyond_mm if state.surface.beyond_mm else 0.0
    )
    return np.asarray(out)


@cache
def _rim_beyond() -> FloatArray:
    """Height of the rim above the vertex by the round terms beyond the fit's."""
    return np.asarray(film_law.beyond().sum(axis=1))


@cache
def rim_harmonics() -> FloatArray:
    """Matrix (RING, parameters) from a surface to the harmonics of its rim's height above the
    vertex.
    """
    theta = 2 * np.pi * np.arange(4 * RING) / (4 * RING)
    heights = forward_model.basis(np.cos(theta), np.sin(theta))[0]
    orders = np.outer(np.arange(1, ZERNIKE_DEGREE + 1), theta)
    waves = np.vstack([np.full((1, theta.size), 0.5), np.cos(orders), np.sin(orders)])
    return np.asarray(waves @ heights.T * 2 / theta.size)


# Hundreds of thousands of bins as a few thousand points with the same information.
#
# About a bench and a surface that are nearly right, the residual of the seen screen points is
# smooth but for noise: its mean over a cell of the picture keeps all information. The cell's point
# is the model's at its middle plus that mean.


_WAVES = range(
    1, 5
)  # per fringe: light that differs between frames makes one and two, gamma in four steps four
_WAVES_SEEN, _OUTSTANDING = (
    0.5,
    2.0,
)  # of a point's noise, and of the usual set's: smaller ones are part of the scatter


def without_waves(
    bench: bench_parameters.BenchGeometry,
    sets: Sequence[forward_model.SetPhases],
    states: Sequence[SetState],
) -> tuple[forward_model.SetPhases, ...]:
    """The sets, those with outstanding errors that repeat with the fringes without these.

    Light that differs between frames makes them: errors of a phase that depend on the phase alone.
    They show in the residuals, beside what is smooth there. Such a set would count as one of
    another bench.
    """
    waves = [_waves_mm(bench, *pair) for pair in zip(sets, states, strict=True)]
    sizes = np.array(
        [np.std(of_set) / np.mean(each.sigma_mm) for of_set, each in zip(waves, sets, strict=True)]
    )
    strong = sizes > np.maximum(_WAVES_SEEN, _OUTSTANDING * np.median(sizes))
    return tuple(
        replace(each, screen_mm=each.screen_mm - of_set) if bad else each
        for each, of_set, bad in zip(sets, waves, strong, strict=True)
    )


def _waves_mm(
    bench: bench_parameters.BenchGeometry, phases: forward_model.SetPhases, state: SetState
) -> FloatArray:
    """What of a set's residuals (2, n) repeats with its fringes; 0 if their period is unknown."""
    out = np.zeros_like(phases.screen_mm)
    if not phases.period_mm:
        return out
    left = forward_model.residual_mm(
        bench, phases, state.surface, state.vertex_z_mm, state.elsewhere
    )
    root, turn = (
        np.sqrt(Trust.seen(phases, left).weights) / phases.sigma_mm,
        2 * np.pi / phases.period_mm,
    )
    for there in range(1 if phases.screen is None else len(phases.elsewhere) + 1):
        some = phases.seen_with(there)
        column, row = (
            place[some] / _across_px(phases) for place in (phases.column_px, phases.row_px)
        )
        smooth = [column**p * row**q for p in range(4) for q in range(4 - p)]
        for axis in range(2 if some.any() else 0):
            phase_rad = turn * phases.screen_mm[axis, some]
            waves = [
                wave(k * phase_rad) * by
                for k in _WAVES
                for wave in (np.cos, np.sin)
                for by in (1.0, column, row)
            ]
            design = np.stack([*waves, *smooth], axis=1) * root[some, None]
            found = np.linalg.lstsq(design, left[axis, some] * root[some], rcond=None)[0][
                : len(waves)
            ]
            out[axis, some] = found @ np.stack(waves)
    return out


def averaged(
    bench: bench_parameters.BenchGeometry,
    phases: forward_model.SetPhases,
    state: SetState,
    about: int,
) -> forward_model.SetPhases:
    """The set reduced to about that many points; robust, each with the noise of its mean."""
    shape = state.surface, state.vertex_z_mm, state.elsewhere
    left = forward_model.residual_mm(bench, phases, *shape)
    weights = Trust.seen(phases, left).weights / phases.sigma_mm**2
    width, height = np.ptp(phases.column_px), np.ptp(phases.row_px)
    cell_px = max(
        float(np.sqrt(width * height * np.pi / 4 / about)), 1.0
    )  # the mirror is seen as an ellipse
    column, row = (
        np.floor(place / cell_px).astype(int) for place in (phases.column_px, phases.row_px)
    )
    screen = np.zeros(row.size, int) if phases.screen is None else phases.screen
    place = column + (row.max() + 1 - row + (row.max() + 2) * screen) * (column.max() + 1)
    _, first, cell = np.unique(place, return_index=True, return_inverse=True)
    total = np.bincount(cell, weights)
    column_px, row_px, *rest = (
        np.bincount(cell, weights * value) / total
        for value in (phases.column_px, phases.row_px, *left)
    )
    sigma_mm = 1 / np.sqrt(total)
    dark = np.zeros((2, total.size))
    bare = replace(
        phases,
        column_px=column_px,
        row_px=row_px,
        screen_mm=dark,
        sigma_mm=sigma_mm,
        screen=screen[first],
    )
    model = -forward_model.residual_mm(bench, bare, *shape)
    return replace(bare, screen_mm=model + np.stack(rest))
