"""Fits the reflections of a front film to the phases where they are seen, and removes them.

There a phasor is e^(i phi) (1 + sum r_k e^(i (phi_k - phi))), with the phases phi_k of two further
images of the screen. Their places follow from the geometry; unknown are the two shares r_k and a
few errors of form of the front film, which the fit finds together with a smooth change of phi.

Derivation: section 13 of docs/explanation/metrology.md.
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.rays.cushion import FRONT_ERRORS, image_shares
from membrane_ctrl.metrology.rays.film_reflections import ReflectionMap, map_reflections
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import BoolArray, FloatArray

_SMOOTH_DEGREE = 4  # of the change of phi over the fitted part
_MOST_POINTS = 6000
_SEARCHED_POINTS = 1200  # of the first search
_LEAST_POINTS = 200  # far more than the unknowns
_STEPS = 12  # Gauss-Newton steps after each trace of the reflections
_TRACES = 3
_ITERATIONS = 4  # of phi from the measured phase: each gains a factor of five
# Standard uncertainties of the errors of form: bulge in mm (or as stated), tilts in mrad, saddles
# in mm on the rim, height of the whole film in mm.
_TILT_MRAD = 1.5
_SADDLE_MM = 0.7
_LIFT_MM = 1.5
# First search: bulge in sigmas, tilts in mrad. From one place to the next an image's phase changes
# by less than a radian.
_RAISES = np.linspace(-2.0, 2.0, 5)
_TILTS_MRAD = np.linspace(-3.5, 3.5, 8)
_MIRROR_REFLECTANCE = 0.88  # of aluminium, for the expected shares
_SMALL_SHARE = 0.3  # of the expected share: less is no reflection of a film
_LARGE_SHARE = 3.0
_EXPLAINED = 0.8  # least share of the ripple's power that a fit must explain
_OUTLIER_SIGMAS = 6.0
_LEAST_SCATTER_RAD = 1e-3  # of the residual: less is noise-free
_EDGE_PIXELS = 1.5  # beside the edge of an image: a pixel and the lens' blur
_PATCH_MM = 12.0  # side of patches between which residuals are independent: some ripples
_SOFT_MM = 1.0  # width of an image's edge in the fit


class ReflectionState(Enum):
    """How the reflections of a front film were treated."""

    FITTED = "fitted and removed"
    ABSENT = "not seen"
    UNEXPLAINED = "not explained"


@dataclass(frozen=True)
class LeftReflections:
    """What is not known of fitted reflections, at n of the pixels that may show them.

    Attributes
    ----------
    position_mm : (2, n) array
        The pixels on the mirror.
    derivatives_mm : (FRONT_ERRORS + 2, 2, n) array
        Changes of the screen points by the errors of form and the shares.
    covariance : (FRONT_ERRORS + 2, FRONT_ERRORS + 2) array
        Of the errors of form and the shares.
    ripple_mm : (2, n) array
        Screen points that neither reflections nor a smooth change explain; 0 for outliers.
    pixels_a_point : float
        Pixels of the set for each of these.
    """

    position_mm: FloatArray
    derivatives_mm: FloatArray
    covariance: FloatArray
    ripple_mm: FloatArray
    pixels_a_point: float

    @property
    def share_sigmas(self) -> FloatArray:
        """Standard uncertainties (2,) of the shares."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[FRONT_ERRORS:]))


@dataclass(frozen=True)
class ReflectionFit:
    """Reflections of the front film in one set.

    Attributes
    ----------
    state : ReflectionState
        Unless they are fitted, the pixels that may show them are left out.
    shares : (float, float)
        Light of both images over that of the mirror.
    errors : (FRONT_ERRORS,) array
        Errors of form of the front film.
    before_rad, after_rad : float
        RMS of the phase beside a smooth change, without and with the fit.
    map : ReflectionMap
        The images.
    smooth_rad : (2, k) array
        Smooth change of the phases of x and y over the fitted part, beside the expected ones.
    left : LeftReflections, optional
        What is not known of them; None unless they are fitted.
    """

    state: ReflectionState
    shares: FloatArray
    errors: FloatArray
    before_rad: float
    after_rad: float
    map: ReflectionMap
    smooth_rad: FloatArray
    left: LeftReflections | None = None

    @property
    def doubt(self) -> str:
        """Why the set is degraded; empty if the reflections were removed."""
        if self.state is ReflectionState.FITTED:
            return ""
        if self.state is ReflectionState.ABSENT:
            return (
                "the reflections of the screen by the stated front film are not seen: is there a "
                "front film?"
            )
        return (
            "the reflections of the screen by the front film are not where its stated form has "
            "them: the middle of the mirror is left out; check mirror.front_film"
        )


class _Model:
    """Phases of the images at the fitted points, and their effect on the measured phase."""

    def __init__(
        self, images: ReflectionMap, position_mm: FloatArray, seen_mm: FloatArray, mm_per_rad: float
    ) -> None:
        self._half_side_mm = images.half_side_mm
        self._mm_per_rad = mm_per_rad
        self._seen_mm = seen_mm
        self._start = images.errors
        self._images_mm = images.find_images_mm(position_mm, images.errors)
        self._changes_mm = images.find_derivatives_mm(position_mm)

    def phasors(self, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """e^(i (phi_k - phi)) (2 images, 2 axes, n), 0 beside the pattern, and the weight."""
        change = errors - self._start
        images_mm = self._images_mm + np.tensordot(change, self._changes_mm, axes=1)
        from_edge_mm = self._half_side_mm - np.abs(images_mm).max(axis=1)
        inside = np.clip(from_edge_mm / _SOFT_MM + 0.5, 0.0, 1.0)[:, None]
        turns = (images_mm - self._seen_mm) / self._mm_per_rad
        return np.exp(1j * turns), np.broadcast_to(inside, turns.shape)

    def effect_rad(self, errors: FloatArray, shares: FloatArray) -> FloatArray:
        """Change of the measured phase by the images: arg(1 + sum r_k e^(i (phi_k - phi))).

        Parameters
        ----------
        errors : (FRONT_ERRORS,) array
            Errors of form of the front film.
        shares : (2,) array
            r_1 and r_2.

        Returns
        -------
        (2, n) array
            Of the phases of x and of y.
        """
        phasors, inside = self.phasors(errors)
        return np.asarray(np.angle(1 + np.tensordot(shares, inside * phasors, axes=1)))

    def derivatives(self, errors: FloatArray, shares: FloatArray) -> FloatArray:
        """Derivatives of `effect_rad`.

        With S = 1 + sum r_k e_k, d arg S is Im(dS / S): of a share Im(e_k / S), of a phase
        Re(r_k e_k / S). The phases change with the errors of form by the images' places.

        Parameters
        ----------
        errors : (FRONT_ERRORS,) array
            Errors of form of the front film.
        shares : (2,) array
            r_1 and r_2.

        Returns
        -------
        (FRONT_ERRORS + 2, 2, n) array
            By the errors, then by the shares.
        """
        phasors, inside = self.phasors(errors)
        lit = inside * phasors
        whole = 1 + np.tensordot(shares, lit, axes=1)
        by_share = np.imag(lit / whole)
        by_phase = shares[:, None, None] * np.real(lit / whole)
        turns = self._changes_mm / self._mm_per_rad
        by_error = np.sum(by_phase * turns, axis=1)
        return np.concatenate([by_error, by_share])


def fit_reflections(
    geometry: Geometry,
    surface: Surface,
    vertex_z_mm: float,
    pattern: PatternConfig,
    bulge_sigma_mm: float,
    position_mm: FloatArray,
    seen_mm: FloatArray,
    expected_mm: FloatArray,
    pixel_mm: float,
) -> ReflectionFit | None:
    """Fit the reflections to the pixels that may show them.

    Parameters
    ----------
    geometry : Geometry
        The bench.
    surface : Surface
        The mirror's film, from places without reflections.
    vertex_z_mm : float
        Height of its vertex.
    pattern : PatternConfig
        The pattern on the screen.
    bulge_sigma_mm : float
        Standard uncertainty of the stated bulge.
    position_mm : (2, n) array
        Pixels on the mirror.
    seen_mm, expected_mm : (2, n) arrays
        Screen points that they show, and those that the surface predicts.
    pixel_mm : float
        Size of a pixel on the mirror.

    Returns
    -------
    ReflectionFit or None
        None for a single film, and if nothing shows the pattern again.
    """
    images = map_reflections(geometry, surface, vertex_z_mm, pattern)
    if images is None or geometry.cushion is None:
        return None
    shows = np.flatnonzero(images.shows_pattern(position_mm))
    expected_shares = np.array(image_shares(geometry.cushion, _MIRROR_REFLECTANCE))
    nothing = ReflectionFit(
        ReflectionState.UNEXPLAINED,
        np.zeros(2),
        np.zeros(FRONT_ERRORS),
        math.nan,
        math.nan,
        images,
        np.zeros((2, 0)),
    )
    if shows.size < _LEAST_POINTS:
        return nothing
    # Some thousand of these pixels, and the phase that they have beside the expected one.
    some = shows[:: max(1, shows.size // _MOST_POINTS)]
    place_mm = position_mm[:, some]
    mm_per_rad = screen_scale.mm_per_rad(pattern)
    phase_rad = (seen_mm - expected_mm)[:, some] / mm_per_rad

    # The phase without a smooth change, robustly: lost pixels do not count.
    smooth = _smooth_basis(images, place_mm)
    weights = np.all(np.abs(phase_rad - np.median(phase_rad, axis=1)[:, None]) < 1.0, axis=0)
    sigmas = np.array([bulge_sigma_mm, _TILT_MRAD, _TILT_MRAD, _SADDLE_MM, _SADDLE_MM, _LIFT_MM])

    # A search for the basin: the cost has many minima, as each turn of an image's phase looks the
    # same.
    few = slice(None, None, max(1, some.size // _SEARCHED_POINTS))
    errors, shares = _search_errors(
        _Model(images, place_mm[:, few], expected_mm[:, some[few]], mm_per_rad),
        phase_rad[:, few],
        smooth[:, few],
        weights[few],
        sigmas,
        expected_shares,
    )
    residual = phase_rad
    fits = weights
    before_rad = _rms(_without_smooth(phase_rad, smooth, weights), weights)
    # Gauss-Newton about images that are traced again; without outliers and pixels at edges.
    for _ in range(_TRACES):
        traced = map_reflections(geometry, surface, vertex_z_mm, pattern, errors)
        if traced is None:
            return nothing
        images = traced
        crossed = _edge_pixels(images, errors, place_mm, pixel_mm)
        weights &= ~crossed
        model = _Model(images, place_mm, expected_mm[:, some], mm_per_rad)
        errors, shares = _solve(model, phase_rad, smooth, weights, sigmas, errors, shares)
        residual = _without_smooth(phase_rad - model.effect_rad(errors, shares), smooth, weights)
        scatter = np.median(np.abs(residual[:, weights])) / 0.6745
        fits = np.all(np.abs(residual) < _OUTLIER_SIGMAS * max(scatter, _LEAST_SCATTER_RAD), axis=0)
        weights = fits & ~crossed
        if np.count_nonzero(weights) < _LEAST_POINTS:
            return nothing
    after_rad = _rms(residual, weights)

    # Whether these are reflections of this film.
    state = ReflectionState.FITTED
    ratio = shares / expected_shares
    if np.all(np.abs(ratio) < _SMALL_SHARE):
        state = ReflectionState.ABSENT
    elif (
        after_rad**2 > (1 - _EXPLAINED) * before_rad**2
        or np.any(ratio > _LARGE_SHARE)
        or np.mean(fits) < _EXPLAINED
    ):
        state = ReflectionState.UNEXPLAINED
    model = _Model(images, place_mm, expected_mm[:, some], mm_per_rad)
    clean_rad = phase_rad - model.effect_rad(errors, shares)
    smooth_rad = clean_rad[:, weights] @ np.linalg.pinv(smooth[:, weights])
    left = None
    if state is ReflectionState.FITTED:
        ripple_rad = np.where(weights, residual, 0.0)
        columns = _without_smooth(model.derivatives(errors, shares), smooth, weights)
        left = LeftReflections(
            place_mm,
            mm_per_rad * model.derivatives(errors, shares),
            _estimate_covariance(columns * weights, ripple_rad, sigmas, place_mm),
            mm_per_rad * ripple_rad,
            shows.size / some.size,
        )
    return ReflectionFit(state, shares, errors, before_rad, after_rad, images, smooth_rad, left)


def remove_reflections(
    fit: ReflectionFit,
    pattern: PatternConfig,
    position_mm: FloatArray,
    seen_mm: FloatArray,
    expected_mm: FloatArray,
    pixel_mm: float,
) -> BoolArray:
    """Remove fitted reflections from the screen points of pixels, in place.

    Parameters
    ----------
    fit : ReflectionFit
    pattern : PatternConfig
    position_mm : (2, n) array
        Pixels on the mirror.
    seen_mm, expected_mm : (2, n) arrays
        Screen points that they show, which are corrected, and those that the surface predicts.
        Pixels that the edge of an image crosses get the smooth change of the pixels around: without
        them the map would fall apart there.
    pixel_mm : float
        Size of a pixel on the mirror.

    Returns
    -------
    (n,) bool array
        Pixels to leave out: all that may show an image, if the fit failed.
    """
    if fit.state is ReflectionState.UNEXPLAINED:
        return fit.map.shows_pattern(position_mm)
    lost = np.zeros(position_mm.shape[1], bool)
    if fit.state is ReflectionState.ABSENT:
        return lost
    place = np.flatnonzero(fit.map.shows_pattern(position_mm))
    images_mm = fit.map.find_images_mm(position_mm[:, place], fit.errors)
    from_edge_mm = fit.map.half_side_mm - np.abs(images_mm).max(axis=1)
    inside = from_edge_mm > 0

    # phi from the measured phase: phi = measured - arg(1 + sum r_k e^(i (phi_k - phi))).
    mm_per_rad = screen_scale.mm_per_rad(pattern)
    measured_mm = seen_mm[:, place]
    clean_mm = measured_mm
    for _ in range(_ITERATIONS):
        turns = (images_mm - clean_mm) / mm_per_rad
        lit = inside[:, None] * np.exp(1j * turns)
        effect_rad = np.angle(1 + np.tensordot(fit.shares, lit, axes=1))
        clean_mm = measured_mm - mm_per_rad * effect_rad
    # Pixels that the edge of an image crosses.
    crossed = _edge_pixels(fit.map, fit.errors, position_mm[:, place], pixel_mm)
    smooth = _smooth_basis(fit.map, position_mm[:, place[crossed]])
    around_mm = mm_per_rad * (fit.smooth_rad @ smooth)
    clean_mm[:, crossed] = expected_mm[:, place[crossed]] + around_mm
    seen_mm[:, place] = clean_mm
    return lost


def _edge_pixels(
    images: ReflectionMap, errors: FloatArray, position_mm: FloatArray, pixel_mm: float
) -> BoolArray:
    """Which pixels (n,) the edge of an image crosses."""
    images_mm = images.find_images_mm(position_mm, errors)
    from_edge_mm = images.half_side_mm - np.abs(images_mm).max(axis=1)
    per_mm = np.array([_magnification(position_mm, image) for image in images_mm])
    near_edge = np.abs(from_edge_mm) < _EDGE_PIXELS * pixel_mm * per_mm[:, None]
    return np.asarray(near_edge.any(axis=0))


def _magnification(position_mm: FloatArray, image_mm: FloatArray) -> float:
    """Millimetres on the screen per millimetre on the mirror, of an image (2, n)."""
    centred = position_mm - position_mm.mean(axis=1, keepdims=True)
    slopes = image_mm @ centred.T @ np.linalg.pinv(centred @ centred.T)
    return float(np.abs(slopes).max())


def _smooth_basis(images: ReflectionMap, place_mm: FloatArray) -> FloatArray:
    """Polynomials (k, n) over the fitted part."""
    x, y = (place_mm - np.array(images.centre_mm)[:, None]) / images.radius_mm
    powers = series.polyvander2d(x, y, [_SMOOTH_DEGREE, _SMOOTH_DEGREE])
    powers = powers.reshape(x.size, _SMOOTH_DEGREE + 1, -1)
    rows = [
        powers[:, i, j] for i in range(_SMOOTH_DEGREE + 1) for j in range(_SMOOTH_DEGREE + 1 - i)
    ]
    return np.stack(rows)


def _without_smooth(values: FloatArray, smooth: FloatArray, weights: BoolArray) -> FloatArray:
    """Values (..., n) less the smooth change through the weighted ones."""
    known = smooth[:, weights]
    solved = values[..., weights] @ np.linalg.pinv(known)
    return np.asarray(values - solved @ smooth)


def _rms(residual: FloatArray, weights: BoolArray) -> float:
    return float(np.sqrt(np.mean(np.square(residual[:, weights]))))


def _estimate_covariance(
    columns: FloatArray, ripple_rad: FloatArray, sigmas: FloatArray, place_mm: FloatArray
) -> FloatArray:
    """Covariance (FRONT_ERRORS + 2, same) of the errors of form and the shares.

    The residual is independent from patch to patch only: N^-1 (sum over patches of g g') N^-1 with
    the normal matrix N and the gradient g = D r of a patch, and of the prior.

    Parameters
    ----------
    columns : (FRONT_ERRORS + 2, 2, n) array
        Derivatives of the phases, without the smooth change; 0 for points without weight.
    ripple_rad : (2, n) array
        Residual, 0 for points without weight.
    sigmas : (FRONT_ERRORS,) array
        Of the prior.
    place_mm : (2, n) array
        The points on the mirror.
    """
    # Sums of the gradient over patches.
    column, row = np.floor((place_mm - place_mm.min(axis=1, keepdims=True)) / _PATCH_MM).astype(int)
    patch = row * (column.max() + 1) + column
    gradients = np.sum(columns * ripple_rad, axis=1)
    sums = np.stack([np.bincount(patch, gradient) for gradient in gradients])
    # The normal matrix with the prior, in units of the residual's variance.
    design = columns.reshape(len(columns), -1)
    known = int(np.count_nonzero(np.any(design != 0, axis=0)))
    variance = float(np.sum(ripple_rad**2)) / max(known, 1) + _LEAST_SCATTER_RAD**2
    prior = np.append(sigmas**-2, np.zeros(2))
    inverse = np.linalg.inv(design @ design.T / variance + np.diag(prior))
    middle = sums @ sums.T / variance**2 + np.diag(prior)
    return np.asarray(inverse @ middle @ inverse)


def _search_errors(
    model: _Model,
    phase_rad: FloatArray,
    smooth: FloatArray,
    weights: BoolArray,
    sigmas: FloatArray,
    expected_shares: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """The bulge and the tilts that explain the phase best with the expected shares."""
    # All combinations of bulge and tilts. Only the mean of an effect is removed, which is cheap;
    # the smooth rest matters little for the choice.
    target = _without_smooth(phase_rad, smooth, weights)[:, weights]
    best = math.inf
    found = np.zeros(FRONT_ERRORS)
    for raised in _RAISES * sigmas[0]:
        for tilt_x in _TILTS_MRAD:
            for tilt_y in _TILTS_MRAD:
                errors = np.array([raised, tilt_x, tilt_y, 0.0, 0.0, 0.0])
                effect = model.effect_rad(errors, expected_shares)[:, weights]
                left = target - effect + effect.mean(axis=1, keepdims=True)
                cost = float(np.sum(left**2))
                if cost < best:
                    best = cost
                    found = errors
    return found, expected_shares


def _solve(
    model: _Model,
    phase_rad: FloatArray,
    smooth: FloatArray,
    weights: BoolArray,
    sigmas: FloatArray,
    errors: FloatArray,
    shares: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton steps for errors of form and shares, with the errors' sigmas as a prior."""
    for _ in range(_STEPS):
        # The residual and its derivatives, both without the smooth change.
        effect = model.effect_rad(errors, shares)
        residual = _without_smooth(phase_rad - effect, smooth, weights)[:, weights]
        jacobian = model.derivatives(errors, shares)
        columns = _without_smooth(jacobian, smooth, weights)[..., weights]
        design = columns.reshape(FRONT_ERRORS + 2, -1)
        # Normal equations with the prior of the errors; the shares have none.
        variance = float(np.mean(residual**2)) + 1e-12
        normal = design @ design.T / variance
        right = design @ residual.ravel() / variance
        prior = np.append(sigmas**-2, np.zeros(2))
        normal += np.diag(prior)
        right -= prior * np.append(errors, shares)
        step = np.linalg.solve(normal, right)
        # Steps no longer than a sigma, shares that light can have.
        errors = errors + np.clip(step[:FRONT_ERRORS], -sigmas, sigmas)
        shares = np.clip(shares + step[FRONT_ERRORS:], -0.05, 0.6)
    return errors, shares
