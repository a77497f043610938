"""The budget of a figure's uncertainty: what each input contributes (JCGM 100, clause 5).

An input with the standard uncertainty u changes the figure's parameters by c u, with c its
sensitivity: one solution of the thinned points with the input off by u. Inputs of type B (data
sheets, rulers) are known before the measurement; those of type A are seen in the set itself.
Inputs that all sets of a bench share cancel in a change between two sets.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from membrane_ctrl.metrology.rays import disc_heights
from membrane_ctrl.metrology.rays.surface import PARAMETERS, parameter_to_coeffs, sag_gradient
from membrane_ctrl.metrology.uncertainty.motion_evidence import MotionFinding
from membrane_ctrl.metrology.uncertainty.pair_motion import PairMotion
from membrane_ctrl.model.arrays import FloatArray

_TINY = 1e-300  # instead of a division by zero


@dataclass(frozen=True)
class Source:
    """One input, or inputs that are correlated: a row of the budget.

    Attributes
    ----------
    name : str
        Name, which ends in the unit of `sigma`.
    description : str
        Description for people.
    sigma : float
        Standard uncertainty of the input; NaN for several at once.
    effects_mm : (parameters, k) array
        Independent changes of the parameters, of 1 sigma each, from this input.
    common : bool
        Whether all sets of a bench share it.
    paired : bool
        Whether two sets have the same error in the same column: it cancels in a change.
    noise_mm2 : float
        Sum of squares of noise in effects that the set shows: the noise has a row of its own.
    is_limit : bool
        Whether `sigma` is a limit of something unknown that all sets of a bench share: in a change
        the lower of two limits holds for both.
    """

    name: str
    description: str
    sigma: float
    effects_mm: FloatArray
    common: bool = True
    paired: bool = True
    noise_mm2: float = 0.0
    is_limit: bool = False

    @property
    def known_mm(self) -> FloatArray:
        """The effects (parameters, k) beyond that noise."""
        power_mm2 = max(float(np.sum(self.effects_mm**2)), _TINY)
        share = 1 - self.noise_mm2 / power_mm2
        return np.asarray(math.sqrt(max(share, 0.0)) * self.effects_mm)

    @property
    def covariance_mm2(self) -> FloatArray:
        """Covariance (parameters, parameters)."""
        return np.asarray(self.known_mm @ self.known_mm.T)

    def list_change_effects(self, earlier: "Source | None") -> list[FloatArray]:
        """Effects on the change since an earlier set, arrays of (parameters, k) each.

        A paired input has the same error in both sets: only the difference of its effects counts.
        Columns that only one of the sets has, as of frames that the other lacks, have no effect on
        the other.
        """
        if earlier is None:
            return [self.known_mm]
        if not (self.paired and earlier.paired):
            return [self.known_mm, earlier.known_mm]
        # A limit counts as the smaller of both: the same thing hides in either set.
        own_mm = self.effects_mm
        earlier_mm = earlier.effects_mm
        if self.is_limit and earlier.is_limit:
            lower = min(self.sigma, earlier.sigma)
            own_mm = own_mm * (lower / max(self.sigma, _TINY))
            earlier_mm = earlier_mm * (lower / max(earlier.sigma, _TINY))
        # The same error in both: the difference of what it does.
        columns = max(own_mm.shape[1], earlier_mm.shape[1])
        difference = replace(
            self,
            effects_mm=_fill_columns(own_mm, columns) - _fill_columns(earlier_mm, columns),
            noise_mm2=self.noise_mm2 + earlier.noise_mm2,
        )
        return [difference.known_mm]


def _fill_columns(effects_mm: FloatArray, columns: int) -> FloatArray:
    """Effects (parameters, k) with columns of zeros up to that number of columns."""
    missing = columns - effects_mm.shape[1]
    return np.pad(effects_mm, ((0, 0), (0, missing)))


@dataclass(frozen=True)
class Budget:
    """All inputs of one figure.

    Attributes
    ----------
    sources : tuple of Source
        The rows.
    disc : float
        Analysis radius over the radius of the terms.
    motion : PairMotion, optional
        Effects of motions of the bench after this set on the next figure; None: not known.
    """

    sources: tuple[Source, ...]
    disc: float
    motion: PairMotion | None = None

    def covariance(self, common: bool) -> FloatArray:
        """Covariance (parameters, parameters), mm^2, from what all sets of the bench share, or from
        what belongs to this set alone.
        """
        parts = [source.covariance_mm2 for source in self.sources if source.common == common]
        return np.asarray(np.sum([np.zeros((PARAMETERS, PARAMETERS)), *parts], axis=0))

    def change_covariance(self, earlier: "Budget") -> FloatArray:
        """Covariance (parameters, parameters), mm^2, of the change since another set of the same
        bench, which may have moved in between.
        """
        steady_mm2 = self.steady_change_covariance(earlier)
        motion = self.find_motion(earlier)
        if motion is None:
            return steady_mm2
        return steady_mm2 + motion.covariance_mm2

    def find_motion(self, earlier: "Budget") -> MotionFinding | None:
        """Motions of the bench since another set; None if a budget does not have their effects."""
        if self.motion is None or earlier.motion is None:
            return None
        return self.motion.find(earlier.motion, self.steady_change_covariance(earlier))

    def steady_change_covariance(self, earlier: "Budget") -> FloatArray:
        """Covariance (parameters, parameters), mm^2, of the change since another set of the same
        bench, at rest.

        What both share cancels but for the difference of its effects on the two.
        """
        before = {source.name: source for source in earlier.sources}
        parts = [np.zeros((PARAMETERS, 1))]
        for own in self.sources:
            parts += own.list_change_effects(before.pop(own.name, None))
        only_earlier = [source.known_mm for source in before.values()]
        effects = np.concatenate([*parts, *only_earlier], axis=1)
        return np.asarray(effects @ effects.T)

    def rows(self) -> list[dict[str, Any]]:
        """One row for each input, the largest contribution first: its own uncertainty, 1 sigma of
        sag, height and figure.
        """
        rows: list[dict[str, Any]] = []
        for source in self.sources:
            about: dict[str, Any] = {
                "name": source.name,
                "description": source.description,
                "sigma": source.sigma if math.isfinite(source.sigma) else None,
                "common": source.common,
            }
            rows.append(about | self.compute_sigmas_um(source.covariance_mm2))
        return sorted(rows, key=lambda row: -float(row["height_rms_um"]))

    def total(self) -> dict[str, Any]:
        """1 sigma of sag, height, figure and of the coefficients."""
        whole = self.covariance(True) + self.covariance(False)
        to_coeffs = parameter_to_coeffs()
        variances_mm2 = np.diag(to_coeffs @ whole @ to_coeffs.T)
        coeffs_um = 1e3 * np.sqrt(np.maximum(variances_mm2, 0.0))
        return self.compute_sigmas_um(whole) | {"coeffs_um": coeffs_um.tolist()}

    def compute_sigmas_um(self, covariance_mm2: FloatArray) -> dict[str, float]:
        """Compute 1 sigma of quantities of a figure from a covariance of its parameters.

        Parameters
        ----------
        covariance_mm2 : (parameters, parameters) array

        Returns
        -------
        dict
            Of the sag, and over the disc of the height and of the figure (the height without its
            plane), in µm.
        """
        sigmas_um = {}
        for name, means in _mean_products(self.disc).items():
            # Mean over the disc of b^T C b is the trace of C times the mean of b b^T.
            square_mm2 = float(np.sum(means * covariance_mm2))
            sigmas_um[name] = 1e3 * math.sqrt(max(square_mm2, 0.0))
        return sigmas_um


@lru_cache
def _mean_products(disc: float) -> dict[str, FloatArray]:
    """Means (parameters, parameters) over a disc of products of the effects of two parameters, on
    sag, height and figure (the height without its plane).
    """
    heights, plane = disc_heights.heights_over_disc(disc)
    figures = disc_heights.remove_plane(heights, plane)
    return {
        "sag_um": np.outer(sag_gradient(), sag_gradient()),
        "height_rms_um": heights.T @ heights / len(heights),
        "figure_rms_um": figures.T @ figures / len(figures),
    }
