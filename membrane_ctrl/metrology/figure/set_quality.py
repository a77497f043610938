"""Quality numbers of a set's figure, from which its verdict follows."""

import math

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.frame_checks.clipping import clipped_shares
from membrane_ctrl.metrology.reconstruction import surface_fit
from membrane_ctrl.model.shape_estimate import Quality


def set_quality(
    optics: OpticsConfig, checked: Checked, fit: surface_fit.Fit, swing_adu: float
) -> Quality:
    """Quality of a set's figure.

    Parameters
    ----------
    optics : OpticsConfig
        The bench.
    checked : Checked
        The set.
    fit : Fit
        The surface fitted to its bins or pixels.
    swing_adu : float
        Median fringe amplitude.

    Returns
    -------
    Quality
    """
    # Bins of the mirror, also those that are left out because they are clipped.
    area_mm2 = math.pi * optics.mirror.analysis_radius_mm**2
    used = [k for frames in checked.view.used for k in frames]
    clipped = checked.binned.saturated[used].any(axis=0)
    on_mirror = (checked.view.mask | clipped) & checked.near

    # Shares of full scale and of the analysed disc; the residual is the RMS of one slope.
    shares = clipped_shares(checked.binned, used, on_mirror)
    return Quality(
        modulation_share=swing_adu / (2**optics.camera.bits - 1),
        saturated_fraction=shares.white,
        black_fraction=shares.black,
        valid_fraction=min(1.0, float(np.sum(checked.state.area_mm2)) / area_mm2),
        residual_urad=1e6 * math.hypot(fit.residual_x, fit.residual_y) / math.sqrt(2),
        converged=fit.converged,
    )
