"""Possible errors of a bench, as one vector of named parameters, all 0 for the stated bench.

The poses are defined in `bench_poses`; lens, bow and pitch follow them, the laser's scale is last.
"""

from collections.abc import Mapping

import numpy as np

from membrane_ctrl.metrology.rays.parameter import Parameter
from membrane_ctrl.model.arrays import FloatArray

POSE = (
    Parameter("a_mm", "distance of the camera from the vertex"),
    Parameter("b_mm", "distance of the screen from the vertex"),
    Parameter("alpha_deg", "elevation of camera and screen"),
    Parameter("screen_x_mm", "shift of the screen along s_x"),
    Parameter("screen_y_mm", "shift of the screen along s_y"),
    Parameter("screen_turn_x_deg", "turn of the screen about s_x"),
    Parameter("screen_turn_y_deg", "turn of the screen about s_y"),
    Parameter("screen_turn_z_deg", "turn of the screen in its plane"),
    Parameter("camera_yaw_deg", "turn of the camera to the right"),
    Parameter("camera_pitch_deg", "turn of the camera up"),
    Parameter("camera_roll_deg", "turn of the camera about its axis"),
)


OPTIONAL = (
    Parameter("focal_relative", "focal length, natural logarithm"),
    Parameter("principal_x_px", "principal point, column"),
    Parameter("principal_y_px", "principal point, row"),
    Parameter("k1", "radial lens distortion, r^2"),
    Parameter("k2", "radial lens distortion, r^4"),
    Parameter("p1", "decentring of the lens"),
    Parameter("p2", "decentring of the lens"),
    Parameter("bow_mm", "bow of the screen, 200 mm from its middle, towards the mirror"),
    Parameter("pitch_relative", "pixel pitch of the screen, relative"),
)


LASER = Parameter("laser_relative", "scale of the laser, relative")


ALL = (*POSE, *OPTIONAL, LASER)


NAMES = tuple(parameter.name for parameter in ALL)


def prior_sigmas(free: Mapping[str, float] | None = None) -> FloatArray:
    """Prior standard deviations (len(NAMES),) in the order of `NAMES`; 0 holds a parameter.

    Without `free` only the poses and the laser's scale are free. The command `calibrate` passes a
    sigma for every parameter (`calibration.stated_problem.known_sigmas`): there all of them are
    free.

    Parameters
    ----------
    free : mapping of str to float, optional
        Other sigmas by name, in the unit of the name: 0 to hold, more than 0 to free.

    Raises
    ------
    ValueError
        For a name that is not a parameter, or a sigma below 0.
    """
    own = {p.name: p.sigma for p in (*POSE, LASER)}
    for name, sigma in (free or {}).items():
        if name not in NAMES:
            raise ValueError(f"{name} is not a parameter; known: {', '.join(NAMES)}")
        if not (np.isfinite(sigma) and sigma >= 0):
            raise ValueError(f"{name}: a sigma must be 0 or more, it is {sigma:g}")
        own[name] = sigma
    return np.array([own.get(name, 0.0) for name in NAMES])


def usual_sigma(name: str) -> float:
    """The sigma that a parameter has when it is freed without one."""
    return ALL[NAMES.index(name)].sigma
