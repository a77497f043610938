"""Which rigid motion of the bench explains what the frames show, and what it does to the figure.

A motion of camera, screen, lens or mirror changes the screen points by E per µm or µrad. The fit
of the surface takes S = (J^T W J)^-1 J^T W E of it for a change of the film; R = E - J S remains as
slopes that no surface has. Observations that contradict the film:

- the *ring*: the film is clamped in a ring, which neither tilts nor bends with it. The first
  harmonic of the rim's height (the tilt), c = H p, stays while only the film moves, and so does the
  second one (the saddle); a motion changes them by H S a;
- the *slopes that no surface has*: their products with R, q = R^T W r, are G a for a motion a, with
  G = R^T W R.

Each group of motions (`bench_motions.GROUPS`) is estimated as if it were the only one:

    a = (A + 1 / K^2)^-1 b,  A = h^T C_c^-1 h + G C_q^-1 G,  b = h^T C_c^-1 c + G C_q^-1 q,  h = H S

with the covariances C_c and C_q of both observations. K is the size of a knock (`MotionGroup`):
some motions leave so little that their estimate is noise alone. The gain b^T a is the decrease of
chi-square.

A hidden motion, such as a shift along an axis, tilts the ring by 0.2 to 0.5 nm per µm and looks
like a change of the bowl otherwise. A mirror that settles tilts the ring by more. Hidden motions
are therefore estimated from saddle and slopes alone. An error of the reference may be a saddle,
too (film that moved between its x and y frames): only frames that share the reference's error are
compared in their saddle.

Noise has a gain, too: its share of frames beyond a gain g is exp(-g / 2) for two components. A
figure is doubted for a tilt of the ring only if the gain of a group is so large that noise reaches
it, with all groups tried, in one of 10,000 frames. Smaller gains only widen the error bars.

Motions that are too small to be found are an error of the figure, too: each group adds
S (A + 1 / tau^2)^-1 S^T to the covariance, where tau, its allowance, is how far a body may move
without any sign. Where the saddle is compared, a hidden motion may be as large as the saddle
admits.
"""

import math
from dataclasses import dataclass, replace
from functools import cache
from statistics import NormalDist

import numpy as np

from membrane_ctrl.metrology.rays import rim_harmonics
from membrane_ctrl.metrology.rays.bench_motions import GROUPS, group_columns
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import FIRST_FIGURE_INDEX, ZERNIKE_DEGREE

# Least K over the tilt that a motion of the mirror alone would explain: a camera that turns tilts
# the ring by a fourth of its turn, a screen that shifts by a fifth.
_KNOCK_PER_TILT = 5.0
# Decreases of chi-square. Noise gives 1 for each component on average, and what is beyond it is
# motion. Leaving out more (4) leaves out turns of 18 to 30 µrad where a figure has 0.1 µm of noise:
# 6 sigma off in an `ok` one.
_CHANCE_GAIN = 1.0
_SURE_GAIN = 25.0  # 5 sigma
_PLAUSIBLE_GAIN = 9.0  # below the best: 3 sigma
# Share of the frames of a bench at rest in which a motion seems proven. Ten times less than
# 1 in 1000: noise that is not quite normal reaches large gains more often.
_FALSE_ALARMS = 1e-4
# Effects on the figure (RMS without tilt) beyond which it is degraded: by a proven motion, and by
# one that camera, screen or mirror may have made.
_PROVEN_UM = 0.03
_POSSIBLE_UM = 0.1
_TINY = 1e-12  # instead of a division by zero
_FIGURE = slice(FIRST_FIGURE_INDEX - 2, None)  # of the parameters: without tilt
_KNOCKS = np.array([group.knock for group in GROUPS])
# Components (groups, 2) of each group, and whether it has that one.
_GROUP_COMPONENTS = np.array([[each.start, each.stop - 1] for each in group_columns()])
_IS_COMPONENT = np.array([[True, group.components == 2] for group in GROUPS])


@cache
def _ring_harmonic(order: int) -> FloatArray:
    """Matrix (2, parameters): cosine and sine of one harmonic of the rim's height."""
    return rim_harmonics.rim_harmonics()[[order, order + ZERNIKE_DEGREE]]


def ring_tilt() -> FloatArray:
    """Matrix (2, parameters): cosine and sine of the rim's height around the azimuth, in mm."""
    return _ring_harmonic(1)


def ring_saddle() -> FloatArray:
    """Matrix (2, parameters): cosine and sine of the rim's height around twice the azimuth."""
    return _ring_harmonic(2)


def ring_tilt_urad(earlier: Surface, later: Surface) -> float:
    """Return the angle by which the ring has tilted between two surfaces.

    Parameters
    ----------
    earlier, later : Surface
        The surfaces, of one radius.

    Returns
    -------
    float
        µrad.
    """
    tilt_mm = ring_tilt() @ (later.parameters - earlier.parameters)
    return 1e6 * math.hypot(*tilt_mm) / later.radius_mm


@cache
def _gain_by_chance(components: int) -> float:
    """Gain of a group of one or two components that a bench at rest has in one of its groups in a
    share `_FALSE_ALARMS` of the frames.

    The gain is chi-square distributed. The groups' gains are not independent, so that the share is
    at most that.
    """
    tried = sum(not group.is_hidden for group in GROUPS)
    share = _FALSE_ALARMS / tried
    if components == 1:
        return NormalDist().inv_cdf(share / 2) ** 2
    return -2 * math.log(share)


@dataclass(frozen=True)
class MotionEffects:
    """What each component of the motions does to figure, ring and slopes.

    Attributes
    ----------
    figure_mm : (parameters, components) array
        S, mm per µm or µrad.
    left : (components, 2, n) array
        R: screen points that no surface explains, in the unit of the observation.
    """

    figure_mm: FloatArray
    left: FloatArray

    @classmethod
    def from_changes(
        cls, changes: FloatArray, jacobian: FloatArray, weights: FloatArray
    ) -> "MotionEffects":
        """Split the effects of the motions into a change of the figure and the rest.

        Parameters
        ----------
        changes : (components, 2, n) array
            E: changes of the screen points, or of the phases.
        jacobian : (2, parameters, n) array
            J: derivatives by the surface's parameters, in the same unit.
        weights : (2, n) array
            W.
        """
        # S = (J^T W J)^-1 J^T W E, R = E - J S.
        weighted = jacobian * weights[:, None]
        normal = np.einsum("apn,aqn->pq", weighted, jacobian)
        right = np.einsum("apn,kan->pk", weighted, changes)
        figure = np.linalg.solve(normal, right)
        return cls(figure, changes - np.einsum("apn,pk->kan", jacobian, figure))

    def gram(self, weights: FloatArray) -> FloatArray:
        """G = R^T W R (components, components), with weights (2, n)."""
        flat = self.left.reshape(len(self.left), -1)
        return np.asarray((flat * weights.ravel()) @ flat.T)


@dataclass(frozen=True)
class GroupFit:
    """A group of motions as the only cause.

    Attributes
    ----------
    group : int
        Number of the group in `GROUPS`.
    amount : (1,) or (2,) array
        Estimated motion, µm or µrad.
    gain : float
        Decrease of chi-square.
    """

    group: int
    amount: FloatArray
    gain: float

    def describe(self) -> str:
        """What moved, and how far, for people."""
        group = GROUPS[self.group]
        size = float(np.linalg.norm(self.amount))
        return f"{group.name} by {size:.2g} {group.unit}"


@dataclass(frozen=True)
class MotionFinding:
    """The motions that explain an observation.

    Attributes
    ----------
    tilted : tuple of GroupFit
        Motions that are not hidden, by the ring's tilt; the most likely first.
    bent : tuple of GroupFit
        All motions but the mirror's tilt, by the ring's saddle; empty if saddles are not compared.
    found_mm2 : (parameters, parameters) array
        Covariance of what motions beyond chance may have done to the figure.
    allowed_mm2 : (parameters, parameters) array
        The same of motions that are hidden or too small to be found; common to all frames.
    figure_um : float
        RMS of the worst plausible effect of motions that tilt the ring, without the tilt.
    hidden_um : float
        The same of hidden motions.
    """

    tilted: tuple[GroupFit, ...]
    bent: tuple[GroupFit, ...]
    found_mm2: FloatArray
    allowed_mm2: FloatArray
    figure_um: float
    hidden_um: float

    @property
    def covariance_mm2(self) -> FloatArray:
        """Covariance (parameters, parameters) of what motions may have done to the figure."""
        return self.found_mm2 + self.allowed_mm2

    @property
    def is_tilt_proven(self) -> bool:
        """Whether something else than film and mirror has moved, by the ring's tilt."""
        mirror = max(fit.gain for fit in self.tilted if GROUPS[fit.group].is_of_mirror)
        return self.tilted[0].gain - mirror > _SURE_GAIN

    @property
    def is_beyond_chance(self) -> bool:
        """Whether noise alone hardly ever gives so large a gain, by the ring's tilt."""
        return any(fit.gain > _gain_by_chance(GROUPS[fit.group].components) for fit in self.tilted)

    @property
    def is_hidden_proven(self) -> bool:
        """Whether the ring has bent, most likely by a hidden motion."""
        if not self.bent:
            return False
        best = self.bent[0]
        return GROUPS[best.group].is_hidden and best.gain > _SURE_GAIN

    @property
    def is_proven(self) -> bool:
        """Whether a motion of the bench is proven that bends the figure."""
        return (self.is_tilt_proven and self.figure_um > _PROVEN_UM) or (
            self.is_hidden_proven and self.hidden_um > _PROVEN_UM
        )

    def describe(self) -> str:
        """The most likely motion, with the second one unless it is excluded."""
        candidates = self.bent
        if self.is_tilt_proven or not self.bent:
            candidates = self.tilted
        best, second = candidates[:2]
        if best.gain - second.gain > _PLAUSIBLE_GAIN:
            return best.describe()
        return f"it looks like {best.describe()}, or {second.describe()}"

    def describe_tilt(self) -> str:
        """Every motion that may have tilted the ring: no cause is proven."""
        least = self.tilted[0].gain - _PLAUSIBLE_GAIN
        plausible = [fit.describe() for fit in self.tilted if fit.gain >= least]
        return f"it looks like {', or '.join(plausible)}"


def find_motion_doubt(motion: MotionFinding, own_mm2: FloatArray, tilt_urad: float) -> str:
    """Why a figure must not be used as it is; empty if the error bars suffice.

    Parameters
    ----------
    motion : MotionFinding
        The motions that explain it.
    own_mm2 : (parameters, parameters) array
        Covariance of the figure on a bench that has not moved.
    tilt_urad : float
        Tilt of the ring since the reference.
    """
    if motion.is_proven:
        return f"knocked: {motion.describe()}; check camera and screen"
    own_um = 1e3 * math.sqrt(float(np.trace(own_mm2[_FIGURE, _FIGURE])))
    if motion.is_beyond_chance and motion.figure_um > max(own_um, _POSSIBLE_UM):
        return (
            f"the ring seems tilted by {tilt_urad:.2g} µrad since the reference: camera, screen or "
            f"mirror moved, cause unknown; {motion.describe_tilt()}; the figure may be "
            f"{motion.figure_um:.2f} µm off"
        )
    return ""


@dataclass(frozen=True)
class _GroupTest:
    """How a group of k components is estimated.

    Attributes
    ----------
    columns : slice
        Its columns among all components.
    by_ring : (k, 2) array
        h^T C_c^-1.
    by_left : (k, k) array
        G C_q^-1.
    information : (k, k) array
        A.
    spread : (k, k) array
        (A + 1 / K^2)^-1, with K of the group.
    """

    columns: slice
    by_ring: FloatArray
    by_left: FloatArray
    information: FloatArray
    spread: FloatArray

    def make_right_side(self, ring_mm: FloatArray, left: FloatArray) -> FloatArray:
        """Return b (k,) of the module's equation.

        Parameters
        ----------
        ring_mm : (2,) array
            c: the ring's tilt or saddle.
        left : (components,) array
            q: products with the slopes that no surface has.
        """
        return np.asarray(self.by_ring @ ring_mm + self.by_left @ left[self.columns])


def _spread(information: FloatArray, size: float | FloatArray) -> FloatArray:
    """(A + 1 / size^2)^-1 (..., k, k): covariance of groups, whose components have a prior of
    `size` (...).
    """
    prior = np.eye(information.shape[-1]) / np.square(size)[..., None, None]
    return np.asarray(np.linalg.inv(information + prior))


def _blocks_of_groups(matrix: FloatArray) -> FloatArray:
    """Part (groups, 2, 2) of a matrix (components, components) that belongs to each group; zeros
    beside a single component. One call of the library for all groups is ten times faster than one
    for each.
    """
    blocks = matrix[_GROUP_COMPONENTS[:, :, None], _GROUP_COMPONENTS[:, None, :]]
    return np.where(_IS_COMPONENT[:, :, None] & _IS_COMPONENT[:, None, :], blocks, 0.0)


@dataclass(frozen=True)
class SlopeEvidence:
    """How well the slopes that no surface has are known.

    Attributes
    ----------
    covariance, gram : (components, components) arrays
        C_q and G.
    """

    covariance: FloatArray
    gram: FloatArray


class MotionTest:
    """Estimates motions from observations of the same covariance.

    Parameters
    ----------
    effects : MotionEffects
        Effects of each motion.
    tilt_mm2 : (2, 2) array
        Covariance C_c of the ring's tilt.
    slopes : SlopeEvidence or None
        None: slopes are not compared.
    saddle_mm2 : (2, 2) array or None
        Covariance of the ring's saddle. None: saddles are not compared, and hidden motions are
        assumed to be within their allowance.
    """

    def __init__(
        self,
        effects: MotionEffects,
        tilt_mm2: FloatArray,
        slopes: SlopeEvidence | None,
        saddle_mm2: FloatArray | None,
    ) -> None:
        self._effects = effects
        self._slopes = slopes
        self._by_tilt = self._make_group_tests(ring_tilt(), tilt_mm2)
        self._by_saddle: dict[int, _GroupTest] = {}
        if saddle_mm2 is not None:
            self._by_saddle = self._make_group_tests(ring_saddle(), saddle_mm2)

        # What motions may have done that are too small to be found, within their allowances.
        self._undetected_mm2 = np.zeros((len(effects.figure_mm),) * 2)
        for number, group in enumerate(GROUPS):
            if group.allowance == 0:
                continue
            test = self._by_tilt[number]
            effect = effects.figure_mm[:, test.columns]
            if group.is_hidden:
                allowed = group.allowance**2 * np.eye(group.components)
                if self._by_saddle:
                    allowed = allowed + self._by_saddle[number].spread
            else:
                allowed = _spread(test.information, group.allowance)
            self._undetected_mm2 += effect @ allowed @ effect.T

    def _make_group_tests(
        self, harmonic: FloatArray, ring_mm2: FloatArray
    ) -> dict[int, _GroupTest]:
        """The test of each group, by a harmonic of the ring and by the slopes.

        `harmonic` (2, parameters) is `ring_tilt` or `ring_saddle`, `ring_mm2` (2, 2) its
        covariance.
        """
        change = harmonic @ self._effects.figure_mm
        # h^T C_c^-1 and its product with h, for all components at once.
        by_ring = change.T @ np.linalg.inv(ring_mm2)
        information = _blocks_of_groups(by_ring @ change)
        # G C_q^-1 and G C_q^-1 G. Scatter of a component that no square shows is singular.
        by_left = np.zeros_like(information)
        if self._slopes is not None:
            own = _blocks_of_groups(self._slopes.gram)
            scatter = _blocks_of_groups(self._slopes.covariance)
            by_left = own @ np.linalg.pinv(scatter, rcond=1e-9, hermitian=True)
            information = information + by_left @ own
        spread = _spread(information, _KNOCKS)
        tests = {}
        for number, (group, columns) in enumerate(zip(GROUPS, group_columns(), strict=True)):
            block = slice(group.components)
            tests[number] = _GroupTest(
                columns,
                by_ring[columns],
                by_left[number, block, block],
                information[number, block, block],
                spread[number, block, block],
            )
        return tests

    def find_motions(
        self, tilt_mm: FloatArray, saddle_mm: FloatArray, left: FloatArray
    ) -> MotionFinding:
        """Estimate every group.

        Parameters
        ----------
        tilt_mm, saddle_mm : (2,) arrays
            c of the ring; the saddle has no effect if saddles are not compared.
        left : (components,) array
            q of the slopes; no effect if slopes are not compared.
        """
        tilted = [fit for fit in self._fit_tilt(tilt_mm, left) if not GROUPS[fit.group].is_hidden]
        bent = self._fit_groups(self._by_saddle, saddle_mm, left)
        bent = [fit for fit in bent if not GROUPS[fit.group].is_of_mirror]
        seen_mm, seen_um = _worst_effect(self._effects, tilted, is_hidden=False)
        hidden_mm, hidden_um = _worst_effect(self._effects, bent, is_hidden=True)
        return MotionFinding(
            tuple(tilted),
            tuple(bent),
            np.outer(seen_mm, seen_mm),
            self._undetected_mm2 + np.outer(hidden_mm, hidden_mm),
            seen_um,
            hidden_um,
        )

    def _fit_tilt(self, tilt_mm: FloatArray, left: FloatArray) -> list[GroupFit]:
        """Estimate every group by the ring's tilt, the most likely first."""
        # Tilt of the mirror if only it had moved; K of every group is at least a multiple of it.
        mirror = next(number for number, group in enumerate(GROUPS) if group.is_of_mirror)
        test = self._by_tilt[mirror]
        tilt = np.linalg.solve(test.information, test.make_right_side(tilt_mm, left))
        tilt_knock = _KNOCK_PER_TILT * float(np.linalg.norm(tilt))
        # A larger knock is a wider prior: (A + 1 / K^2)^-1.
        tests = dict(self._by_tilt)
        for number, test in self._by_tilt.items():
            if tilt_knock > GROUPS[number].knock:
                tests[number] = replace(test, spread=_spread(test.information, tilt_knock))
        return self._fit_groups(tests, tilt_mm, left)

    @staticmethod
    def _fit_groups(
        tests: dict[int, _GroupTest], ring_mm: FloatArray, left: FloatArray
    ) -> list[GroupFit]:
        """Estimate every group, the most likely first."""
        fits = []
        for number, test in tests.items():
            right = test.make_right_side(ring_mm, left)
            amount = test.spread @ right
            fits.append(GroupFit(number, amount, float(right @ amount)))
        return sorted(fits, key=lambda fit: -fit.gain)


def _worst_effect(
    effects: MotionEffects, fits: list[GroupFit], is_hidden: bool
) -> tuple[FloatArray, float]:
    """Worst effect of a plausible motion; amounts count as far as they are beyond chance.

    Parameters
    ----------
    effects : MotionEffects
        Effects of each motion.
    fits : list of GroupFit
        Estimates of the groups, the most likely first.
    is_hidden : bool
        Whether hidden motions or the others are considered.

    Returns
    -------
    worst_mm : (parameters,) array
        Change of the figure.
    figure_um : float
        Its RMS without tilt.
    """
    worst_mm = np.zeros(len(effects.figure_mm))
    figure_um = 0.0
    for fit in fits:
        group = GROUPS[fit.group]
        if group.is_of_mirror or group.is_hidden != is_hidden:
            continue
        if fit.gain < fits[0].gain - _PLAUSIBLE_GAIN:
            continue
        columns = group_columns()[fit.group]
        # Amounts shrink by the part of the gain that chance gives.
        chance = _CHANCE_GAIN * group.components
        share = math.sqrt(max(0.0, 1 - chance / max(fit.gain, _TINY)))
        effect_mm = share * (effects.figure_mm[:, columns] @ fit.amount)
        size_um = 1e3 * float(np.linalg.norm(effect_mm[_FIGURE]))
        if size_um > figure_um:
            worst_mm = effect_mm
            figure_um = size_um
    return worst_mm, figure_um
