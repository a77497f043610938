"""Options of the command `calibrate`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.metrology.calibration import set_state
from membrane_ctrl.metrology.calibration.rim_edges import RADIUS_SIGMA_MM
from membrane_ctrl.metrology.rays.bench_parameters import NAMES, usual_sigma
from membrane_ctrl.model import errors


@dataclass(frozen=True)
class CalibrateOptions:
    """Options of the command.

    Attributes
    ----------
    folders : Sequence[Path]
        Capture sets.
    geometry : Path, optional
        Geometry measured by hand, replacing the sets'.
    out : Path
        The new `geometry.toml`.
    free : Sequence[str]
        Free parameters, each as NAME or NAME=SIGMA.
    laser_sigma_um : float
        Standard uncertainty of a set's mean reading.
    as_json : bool
        Print the report as JSON.
    pictures : bool
        Draw the residuals of the screen points next to the geometry.
    reference_um : float, optional
        Laser reading at which the manual measurements hold, if the sets do not state it; None: the
        first set's.
    priors : Sequence[Path]
        Results of auxiliary calibrations; the last one wins.
    film : set_state.FilmModel
        `free`, `prestressed` or `hencky`: the law that the film follows.
    radius_sigma_mm : float
        Standard uncertainty of the radius of the ring, whose edge is seen.
    """

    folders: Sequence[Path]
    geometry: Path | None
    out: Path
    free: Sequence[str]
    laser_sigma_um: float
    as_json: bool
    pictures: bool = True
    reference_um: float | None = None
    priors: Sequence[Path] = ()
    film: set_state.FilmModel = "free"
    radius_sigma_mm: float = RADIUS_SIGMA_MM


def parse_freed(texts: Sequence[str]) -> dict[str, float]:
    """`--free NAME[=SIGMA]` as sigmas. Raises InputError."""
    out = {}
    for text in texts:
        name, _, amount = text.partition("=")
        if name not in NAMES:
            raise errors.InputError(
                f"--free {text}: {name} is not a parameter; known: {', '.join(NAMES)}"
            )
        try:
            out[name] = float(amount) if amount else usual_sigma(name)
        except ValueError:
            raise errors.InputError(f"--free {text}: {amount} is not a number") from None
        if not (math.isfinite(out[name]) and out[name] > 0):
            raise errors.InputError(
                f"--free {text}: a sigma must be above 0, as nothing is exact: state how well "
                f"{name} is known, or omit it, and the data sheet's sigma applies"
            )
    return out
