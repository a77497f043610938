"""The least-squares problem of the sets: the stated bench with its sigmas."""

import math
from collections.abc import Mapping

from membrane_ctrl.calibration.calibrate_options import CalibrateOptions
from membrane_ctrl.calibration.sets import Bundle
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.geometry import spread_file
from membrane_ctrl.metrology.calibration import set_state
from membrane_ctrl.metrology.calibration.rim_equations import Rim
from membrane_ctrl.metrology.calibration.solver import Problem
from membrane_ctrl.metrology.rays.bench_parameters import LASER, prior_sigmas, usual_sigma
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model import errors


def known_sigmas(optics: OpticsConfig, free: Mapping[str, float]) -> dict[str, float]:
    """Prior sigmas of poses, lens, screen and laser: as freed, else as stated, else those of rulers
    and data sheets.

    Nothing is exact: a stated 0 counts as unstated. A focal length that is held and off by 0.1 %
    changes the sag by 34 µm, which the residuals hardly show.

    Parameters
    ----------
    optics : OpticsConfig
        The bench, with stated sigmas.
    free : mapping of str to float
        Sigmas of the command line, by name.
    """
    geometry = optics.geometry
    stated = {
        **spread_file.stated_sigmas(optics),
        "a_mm": geometry.a_sigma_mm,
        "b_mm": geometry.b_sigma_mm,
        "alpha_deg": geometry.alpha_sigma_deg,
    }
    if geometry.sigmas is not None:
        stated[LASER.name] = geometry.sigmas.laser_relative

    # Rulers and data sheets, for what is not stated.
    unstated = optics.model_copy(update={"geometry": geometry.model_copy(update={"sigmas": None})})
    sigmas = spread_file.stated_sigmas(unstated)
    for name in ("a_mm", "b_mm", "alpha_deg", LASER.name):
        sigmas[name] = usual_sigma(name)
    for name, sigma in (stated | dict(free)).items():
        if sigma:
            sigmas[name] = sigma
    return sigmas


def problem_of(bundle: Bundle, free: dict[str, float], options: CalibrateOptions) -> Problem:
    """Make the least-squares problem of the sets.

    Parameters
    ----------
    bundle : Bundle
        The sets and their stated bench.
    free : dict of float
        Prior sigmas of the parameters that `--free` names.
    options : CalibrateOptions
        Of the command.

    Returns
    -------
    Problem

    Raises
    ------
    InputError
        The stated geometry cannot be calibrated.
    """
    # The stated bench, and how well each of its parameters is known.
    known = known_sigmas(bundle.optics, free)
    try:
        geometry = Geometry.from_config(bundle.optics)
    except ValueError as error:
        raise errors.InputError(str(error)) from None
    # What is known besides the fringes: laser, film and rim.
    references = set_state.References(
        bundle.reference_um, options.laser_sigma_um, film=options.film
    )
    radius_mm = bundle.optics.mirror.radius_mm
    films = [phases for phases in bundle.sets if phases.artefact is None]
    if sum(math.isfinite(phases.displacement_um) for phases in films) < 2:
        known[LASER.name] = 0.0  # one reading shows no scale
    rim = Rim.from_edges(bundle.edges_px, radius_mm, options.radius_sigma_mm)
    return Problem(geometry, bundle.sets, prior_sigmas(known), references, radius_mm, rim)
