"""Possible errors of a bench, as one vector of named parameters, all 0 for the stated bench.

The poses are defined in `bench_poses`; lens, bow and pitch follow them, the laser's scale is last.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.optics import SigmasConfig
from membrane_ctrl.model.arrays import FloatArray

# a, b and alpha: the paper's; the principal point: of the paper's camera
_BY_HAND = {
    "a_mm": 2.0,
    "b_mm": 2.0,
    "alpha_deg": 0.3,
    "principal_x_px": 20.0,
    "principal_y_px": 20.0,
}
_BY_HAND |= SigmasConfig().model_dump()


@dataclass(frozen=True)
class Parameter:
    """One number that may be wrong.

    Attributes
    ----------
    name : str
        Name, which ends in the unit.
    description : str
        Description for people.
    """

    name: str
    description: str

    @property
    def sigma(self) -> float:
        """Of its hand measurement, in that unit: ruler, laser meter, protractor, data sheet."""
        return _BY_HAND[self.name]

    @property
    def unit(self) -> str:
        """The unit in the name; empty for a plain number."""
        tail = self.name.rsplit("_", 1)[-1]
        return tail if tail in ("mm", "deg", "px") else ""


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
