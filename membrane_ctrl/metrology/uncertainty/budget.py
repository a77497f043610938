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
from membrane_ctrl.metrology.rays.surface import (
    PARAMETERS,
    parameter_to_coeffs,
    sag_gradient,
)
from membrane_ctrl.metrology.uncertainty.motion_evidence import MotionFinding
from membrane_ctrl.metrology.uncertainty.pair_motion import PairMotion
from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class Source:
    """One input, or inputs that are correlated."""

    name: str  # ends in the unit of `sigma`
    says: str
    sigma: float  # standard uncertainty of the input; NaN for several at once
    # (parameters, k): independent changes of the parameters, of 1 sigma each, from this input
    effects_mm: FloatArray
    common: bool = True  # whether all sets of a bench share it
    # whether two sets have the same error in the same column: it cancels in a change
    paired: bool = True
    # sum of squares of noise in effects that the set shows: the noise has a row of its own
    noise_mm2: float = 0.0

    @property
    def known_mm(self) -> FloatArray:
        """The effects beyond that noise."""
        share = 1 - self.noise_mm2 / max(float(np.sum(self.effects_mm**2)), 1e-300)
        return np.asarray(math.sqrt(max(share, 0.0)) * self.effects_mm)

    @property
    def covariance_mm2(self) -> FloatArray:
        """Covariance (parameters, parameters)."""
        return np.asarray(self.known_mm @ self.known_mm.T)

    def change(self, earlier: "Source | None") -> list[FloatArray]:
        """Effects on the change since an earlier set."""
        if earlier is None:
            return [self.known_mm]
        if not (self.paired and earlier.paired):
            return [self.known_mm, earlier.known_mm]
        noise_mm2 = self.noise_mm2 + earlier.noise_mm2
        return [
            replace(
                self, effects_mm=self.effects_mm - earlier.effects_mm, noise_mm2=noise_mm2
            ).known_mm
        ]


@dataclass(frozen=True)
class Budget:
    """All inputs of one figure."""

    sources: tuple[Source, ...]
    disc: float  # analysis radius over the radius of the terms
    # what motions of the bench after this set would do to the next figure; None: not known
    motion: PairMotion | None = None

    def covariance(self, common: bool) -> FloatArray:
        """(parameters, parameters) in mm^2 of the parameters, from what all sets of the bench share
        or from this set's own."""
        parts = [source.covariance_mm2 for source in self.sources if source.common == common]
        return np.asarray(np.sum([np.zeros((PARAMETERS, PARAMETERS)), *parts], axis=0))

    def change_covariance(self, earlier: "Budget") -> FloatArray:
        """(parameters, parameters) in mm^2 of the parameters' change since another set of the same
        bench, which may have moved in between.
        """
        steady = self.steady_change_covariance(earlier)
        found = self.find_motion(earlier)
        return steady if found is None else steady + found.covariance_mm2

    def find_motion(self, earlier: "Budget") -> MotionFinding | None:
        """Motions of the bench since another set; None if a budget does not know their effects."""
        if self.motion is None or earlier.motion is None:
            return None
        return self.motion.find(earlier.motion, self.steady_change_covariance(earlier))

    def steady_change_covariance(self, earlier: "Budget") -> FloatArray:
        """(parameters, parameters) in mm^2 of the parameters' change since another set of the same
        bench, at rest.

        What both share cancels but for the difference of its effects on the two.
        """
        before = {source.name: source for source in earlier.sources}
        parts = [np.zeros((PARAMETERS, 1))]
        for own in self.sources:
            parts += own.change(before.pop(own.name, None))
        effects = np.concatenate([*parts, *(left.known_mm for left in before.values())], axis=1)
        return np.asarray(effects @ effects.T)

    def rows(self) -> list[dict[str, Any]]:
        """Per input, the largest contribution first: its own uncertainty, 1 sigma of sag, height
        and figure.
        """
        rows: list[dict[str, Any]] = []
        for one in self.sources:
            sigma = one.sigma if math.isfinite(one.sigma) else None
            about = {"name": one.name, "says": one.says, "sigma": sigma, "common": one.common}
            rows.append(about | self.sizes(one.covariance_mm2))
        return sorted(rows, key=lambda row: -float(row["height_rms_um"]))

    def total(self) -> dict[str, Any]:
        """1 sigma of sag, height, figure and of the coefficients."""
        whole = self.covariance(True) + self.covariance(False)
        to_coeffs = parameter_to_coeffs()
        coeffs = 1e3 * np.sqrt(np.maximum(np.diag(to_coeffs @ whole @ to_coeffs.T), 0.0))
        return self.sizes(whole) | {"coeffs_um": coeffs.tolist()}

    def sizes(self, covariance_mm2: FloatArray) -> dict[str, float]:
        """1 sigma of the sag, and over the disc of the height and of the figure (the height without
        its plane).
        """
        squares = {
            name: np.sum(means * covariance_mm2)
            for name, means in _mean_products(self.disc).items()
        }
        return {name: 1e3 * math.sqrt(max(float(square), 0.0)) for name, square in squares.items()}


@lru_cache
def _mean_products(disc: float) -> dict[str, FloatArray]:
    """Means (parameters, parameters) over a disc of products of what two parameters do to sag,
    height and figure.
    """
    heights, plane = disc_heights.heights_over_disc(disc)
    basis = {
        "height_rms_um": heights,
        "figure_rms_um": disc_heights.remove_plane(heights, plane),
    }
    return {"sag_um": np.outer(sag_gradient(), sag_gradient())} | {
        n: b.T @ b / len(b) for n, b in basis.items()
    }
