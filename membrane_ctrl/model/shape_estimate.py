"""The result of a measurement cycle, and its bytes for control, recorder and sessions.

One line of JSON with the numbers and words, then the coefficients, then the upper half of the
covariance in single
precision: a variance to 1e-7 is more precise than its noise model, and the controller's inputs must
be recorded exactly. A reader checks every length, type and range first, because a run folder may
come from anywhere.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import COVARIANCE_UPPER_SIZE, ZERNIKE_TERMS

Kind = Literal["full", "fringes", "track"]
Verdict = Literal["ok", "degraded", "rejected"]
_WORDS = {"kind": get_args(Kind), "verdict": get_args(Verdict)}
_ARRAYS = ("coeffs_um", "covariance_um2")
_OTHERS = {"reason", "cycle", "tracking_lost"}
_UPPER = np.triu_indices(ZERNIKE_TERMS)
_LINE_BYTES_MAX = 8192  # the numbers take 0.5 kB; the rest is room for a reason
_COEFFS_BYTES = 8 * ZERNIKE_TERMS
# of `pack_estimate`
ESTIMATE_BYTES_MAX = _LINE_BYTES_MAX + 1 + _COEFFS_BYTES + 4 * COVARIANCE_UPPER_SIZE
_LARGEST = 1e300  # excludes infinity, and integers that a float cannot hold
# Fringes weaker than this share of the sensor's range: at 2 % (5 of 255) the phase noise exceeds
# 0.06 rad per pixel and rounding no longer averages out; at 6 % something is wrong with exposure,
# focus or screen.
MODULATION_REJECTED_SHARE = 0.02
MODULATION_DEGRADED_SHARE = 0.06
# Saturated pixels bend the phase by harmonics; their bins are omitted, so a few (glints) do no
# harm.
SATURATED_REJECTED_FRACTION = 0.20
SATURATED_DEGRADED_FRACTION = 0.005
# Terms over a disc with a quarter missing are extrapolated there.
VALID_REJECTED_FRACTION = 0.5
VALID_DEGRADED_FRACTION = 0.9
# Wrinkles and ripple leave a few tens of microradians; a wrong fringe order leaves 8700 locally.
RESIDUAL_REJECTED_URAD = 1000.0
RESIDUAL_DEGRADED_URAD = 200.0


@dataclass(frozen=True, slots=True)
class ShapeEstimate:
    """Figure of the mirror from one cycle."""

    time_s: float  # middle of the exposures on the run's clock
    # "full" (Gray codes taken), "fringes" (fringe orders carried over from the last absolute phase)
    # or "track" (one frame of crossed fringes)
    kind: Kind
    # (terms,) in Noll's order, orthonormal over `mirror.radius_mm`, of the height; piston makes it
    # 0 at the vertex
    coeffs_um: FloatArray
    # amplitude of the part of a Hencky bowl that the terms cannot represent, as the sag of that
    # bowl
    hencky_um: float
    # (terms, terms) of `coeffs_um`, for changes: what this cycle does not share with others near
    # its displacement
    covariance_um2: FloatArray
    sag_um: float  # height at `mirror.radius_mm`, mean over azimuth, above the vertex
    # its standard deviation from `covariance_um2`, without motions of the bench that are too small
    # to be found: cycles and frames share those, and the estimator has a state for them
    sag_change_sigma_um: float
    displacement_um: float  # mean laser reading during the exposures (NaN without a laser)
    # RMS of measured minus fitted slopes; of "track" the slopes that would leave as much light as
    # the fit does
    slope_residual_urad: float
    valid_fraction: float  # share of the analysis area with a slope
    modulation_median_adu: float  # fringe quality
    saturated_fraction: float
    verdict: Verdict
    reason: str = ""
    latency_s: float = float("nan")  # last frame to this result (filled by the acquisition)
    cycle: int = 0  # number of the cycle in the run (filled by the acquisition)
    # standard deviation of the sag from what all cycles share (geometry, lens, screen, air, blur):
    # a part of the sag's own beside `sag_change_sigma_um`, none of a change's; NaN if not stated
    geometry_sag_sigma_um: float = float("nan")
    # the phases cannot be tracked from the last cycle: a full one is needed
    tracking_lost: bool = False


NUMBERS = tuple(
    field.name for field in fields(ShapeEstimate) if field.name not in {*_WORDS, *_ARRAYS, *_OTHERS}
)
_KEYS = {*NUMBERS, *_WORDS, *_OTHERS, "terms"}


def pack_estimate(estimate: ShapeEstimate) -> bytes:
    """A shape estimate as bytes, bit-exact except for the covariance, which is rounded to single
    precision.
    """
    head = {
        field.name: getattr(estimate, field.name)
        for field in fields(ShapeEstimate)
        if field.name not in _ARRAYS
    }
    return packed_parts(head, estimate.coeffs_um, take_upper_half(estimate.covariance_um2))


def take_upper_half(covariance_um2: FloatArray) -> NDArray[np.float32]:
    """(COVARIANCE_UPPER_SIZE,) float32: the upper half of a symmetric (terms, terms) matrix, row by
    row.
    """
    return ((covariance_um2 + covariance_um2.T) / 2)[_UPPER].astype("<f4")


def packed_parts(
    head: Mapping[str, Any], coeffs_um: FloatArray, upper_um2: NDArray[np.float32]
) -> bytes:
    """Pack an estimate from its parts.

    Parameters
    ----------
    head : mapping of Any
        Numbers and words by name; they must be JSON.
    coeffs_um : (terms,) array
        Zernike terms.
    upper_um2 : (COVARIANCE_UPPER_SIZE,) float32 array
        Upper half of their covariance, row by row.
    """
    line = json.dumps({**head, "terms": ZERNIKE_TERMS}, default=float)
    arrays = (
        np.asarray(coeffs_um, dtype="<f8").tobytes() + np.asarray(upper_um2, dtype="<f4").tobytes()
    )
    return line.encode() + b"\n" + arrays


def unpack_estimate(data: bytes) -> ShapeEstimate:
    """Decode the bytes of `pack_estimate`. Raises ValueError for anything else."""
    line, _, arrays = data.partition(b"\n")
    if len(line) > _LINE_BYTES_MAX:
        raise ValueError(
            f"shape estimate: {len(line)} bytes where at most {_LINE_BYTES_MAX} are expected"
        )
    try:
        head = json.loads(line)
    except RecursionError:
        raise ValueError("shape estimate: not one flat JSON object") from None
    _require_valid(head)
    # Coefficients as doubles, then the upper half of the covariance as singles.
    if len(arrays) != _COEFFS_BYTES + 4 * COVARIANCE_UPPER_SIZE:
        raise ValueError(f"shape estimate: {len(arrays)} bytes of arrays do not fit its first line")
    coeffs_um = np.frombuffer(arrays, dtype="<f8", count=ZERNIKE_TERMS)
    values = np.frombuffer(arrays, dtype="<f4", offset=_COEFFS_BYTES)
    if np.isinf(coeffs_um).any() or np.isinf(values).any():
        raise ValueError("shape estimate: infinite coefficient or covariance")
    # The covariance is symmetric.
    covariance = np.empty((ZERNIKE_TERMS, ZERNIKE_TERMS))
    rows, columns = _UPPER
    covariance[rows, columns] = covariance[columns, rows] = values
    return ShapeEstimate(**head, coeffs_um=coeffs_um.copy(), covariance_um2=covariance)


def _require_valid(head: Any) -> None:
    """Reduce `head` to the estimate's fields. Raises ValueError if one is missing, unknown or of a
    wrong type.
    """
    # Exactly the known fields: the message may come from a damaged file.
    if not isinstance(head, dict) or set(head) != _KEYS:
        raise ValueError("shape estimate: missing or unknown fields in the first line")
    terms = head.pop("terms")
    if terms != ZERNIKE_TERMS:
        raise ValueError(
            f"shape estimate of {str(terms)[:12]} Zernike terms; this program has {ZERNIKE_TERMS}"
        )
    # Numbers, then words, then the rest.
    for name in NUMBERS:
        value = head[name]
        if type(value) not in (float, int) or abs(value) > _LARGEST:
            raise ValueError(f"shape estimate: {name} is not a number")
        head[name] = float(value)
    if math.isnan(head["time_s"]):
        raise ValueError("shape estimate: no time")
    for name, words in _WORDS.items():
        if head[name] not in words:
            raise ValueError(f"shape estimate: {name} is none of {', '.join(words)}")
    cycle = head["cycle"]
    if type(cycle) is not int or not 0 <= cycle < 2**63 or not isinstance(head["reason"], str):
        raise ValueError("shape estimate: cycle or reason has a wrong type")
    if not isinstance(head["tracking_lost"], bool):
        raise ValueError("shape estimate: tracking_lost is neither true nor false")


@dataclass(frozen=True)
class Quality:
    """Figures of one cycle."""

    modulation_share: float  # median fringe amplitude over the sensor's full scale
    saturated_fraction: float  # share of the points with a pixel clipped at white
    valid_fraction: float  # share of the analysis area that gave a slope
    residual_urad: float  # RMS of measured minus fitted slopes
    converged: bool  # whether the fit converged
    black_fraction: float = 0.0  # share of the points with a pixel clipped at black


def describe_saturation(fraction: float) -> str:
    """Return what is wrong with pictures of which this share is clipped at white."""
    return f"{fraction:.1%} of the pixels are saturated: shorten the exposure"


def describe_black_clipping(fraction: float) -> str:
    """Return what is wrong with pictures of which this share is clipped at black."""
    return (
        f"{fraction:.1%} of the pixels are clipped at black: raise the camera's black level "
        "(offset)"
    )


def judge_quality(quality: Quality) -> tuple[Verdict, str]:
    """The worst verdict and its reason; NaN anywhere is a rejection."""
    q = quality
    # What must hold, or there is no figure. A comparison with NaN does not hold.
    rejected = (
        (
            q.modulation_share >= MODULATION_REJECTED_SHARE,
            f"fringe modulation {q.modulation_share:.1%} of full scale",
        ),
        (
            q.saturated_fraction <= SATURATED_REJECTED_FRACTION,
            describe_saturation(q.saturated_fraction),
        ),
        (
            q.black_fraction <= SATURATED_REJECTED_FRACTION,
            describe_black_clipping(q.black_fraction),
        ),
        (
            q.valid_fraction >= VALID_REJECTED_FRACTION,
            f"only {q.valid_fraction:.0%} of the area gave a slope",
        ),
        (q.converged, "the fit did not converge"),
        (q.residual_urad <= RESIDUAL_REJECTED_URAD, f"slope residual {q.residual_urad:.0f} µrad"),
    )
    # The same quantities with tighter limits, beyond which the figure is doubtful.
    degraded = (
        (q.modulation_share >= MODULATION_DEGRADED_SHARE, rejected[0][1]),
        (q.saturated_fraction <= SATURATED_DEGRADED_FRACTION, rejected[1][1]),
        (q.black_fraction <= SATURATED_DEGRADED_FRACTION, rejected[2][1]),
        (q.valid_fraction >= VALID_DEGRADED_FRACTION, rejected[3][1]),
        (q.residual_urad <= RESIDUAL_DEGRADED_URAD, rejected[5][1]),
    )
    for fine, reason in rejected:
        if not fine:
            return "rejected", reason
    for fine, reason in degraded:
        if not fine:
            return "degraded", reason
    return "ok", ""
