"""Tables of `capture.toml` beyond the geometry: an artefact, and a screen that was moved."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from firmware_iface.settings import Section
from membrane_ctrl.config import sight
from membrane_ctrl.config.optics import CameraPoseConfig, ScreenPoseConfig
from membrane_ctrl.config.schema import GeometryConfig
from membrane_ctrl.metrology.rays.artefacts import Artefact
from membrane_ctrl.metrology.rays.turned_mirror import (
    SEAT_SIGMA_MM,
    TURN_SIGMA_DEG,
    TurnedMirror,
)
from membrane_ctrl.model import errors
from membrane_ctrl.model.arrays import FloatArray

_Length = Annotated[float, Field(gt=0, le=1e6)]


class ArtefactTable(Section):
    """The `[artefact]` table: what is seen instead of the film."""

    form: Literal["flat", "sphere", "screen"]
    curvature_radius_mm: _Length | None = None  # of a concave sphere
    curvature_radius_sigma_mm: _Length | None = None
    form_sigma_um: Annotated[float, Field(ge=1e-3, le=1e3)] = 0.1  # of each Zernike term
    # above the film's vertex at the reference displacement
    vertex_mm: Annotated[float, Field(ge=-1e3, le=1e3)] = 0.0
    vertex_sigma_mm: _Length = 1.0

    def make_artefact(self, radius_mm: float, path: Path) -> Artefact | Literal["screen"]:
        """Make the artefact that the set shows instead of the film.

        Parameters
        ----------
        radius_mm : float
            Radius of the disc over which it is seen: `mirror.radius_mm`.
        path : Path
            The set's `capture.toml`, for the message.

        Returns
        -------
        Artefact or "screen"
            Its curvature in 1/mm, 0 for a flat; `"screen"` if the camera sees the screen itself.

        Raises
        ------
        InputError
            A key is missing, or does not belong to the form.
        """
        # The screen itself.
        if self.form == "screen":
            if len(self.model_fields_set) > 1:
                raise errors.InputError(
                    f"{path}: artefact: the screen itself needs nothing but its form"
                )
            return self.form

        # A sphere states its radius of curvature, a flat does not.
        curvature = self.curvature_radius_mm
        spread = self.curvature_radius_sigma_mm
        for name, value in (
            ("curvature_radius_mm", curvature),
            ("curvature_radius_sigma_mm", spread),
        ):
            if (value is None) != (self.form == "flat"):
                description = "a sphere needs it"
                if value is not None:
                    description = "a flat has none"
                raise errors.InputError(f"{path}: artefact.{name}: {description}")

        # The flat, or the sphere.
        known = {"form_sigma_mm": 1e-3 * self.form_sigma_um, "vertex_mm": self.vertex_mm}
        known |= {"vertex_sigma_mm": self.vertex_sigma_mm, "radius_mm": radius_mm}
        if curvature is None or spread is None:
            return Artefact(0.0, 0.0, **known)
        if curvature <= radius_mm:
            raise errors.InputError(
                f"{path}: artefact.curvature_radius_mm = {curvature:g} must exceed mirror.radius_mm"
            )
        return Artefact(1 / curvature, spread / curvature**2, **known)


class ScreenMovedTable(Section):
    """The `[screen_moved]` table: the screen was elsewhere than `[geometry]` states."""

    shift_mm: tuple[float, float, float]  # along s_x, along s_y, towards the mirror, as measured
    shift_sigma_mm: _Length = 1.0  # of its length
    # of its direction; and how parallel the screen stayed
    turn_sigma_deg: Annotated[float, Field(gt=0, le=30)] = 0.5


class MirrorTurnedTable(Section):
    """The `[mirror_turned]` table: the mirror was turned about its axis."""

    angle_deg: Annotated[float, Field(ge=-360, le=360)]  # counter-clockwise for the camera
    angle_sigma_deg: Annotated[float, Field(gt=0, le=10)] = TURN_SIGMA_DEG
    seat_sigma_mm: Annotated[float, Field(gt=0, le=5)] = SEAT_SIGMA_MM  # of the place of its axis

    def make_turn(self) -> TurnedMirror:
        """As the calibration takes it."""
        return TurnedMirror(self.angle_deg, self.angle_sigma_deg, self.seat_sigma_mm)


def move_screen(
    geometry: GeometryConfig, shift_mm: tuple[float, float, float], turn: FloatArray | None = None
) -> GeometryConfig:
    """The bench with its screen at another place.

    Parameters
    ----------
    geometry : GeometryConfig
        The bench, of either form.
    shift_mm : (float, float, float)
        Shift along the screen's own axes s_x, s_y and its normal.
    turn : (3, 3) array, optional
        Rotation that then turns the screen about its origin, from world to world.

    Returns
    -------
    GeometryConfig
        In the form of two poses.
    """
    pinhole, rotation, origin, s_x, s_y = sight.compute_poses(geometry)
    origin = origin + np.array(shift_mm) @ np.stack([s_x, s_y, np.cross(s_x, s_y)])
    if turn is not None:
        s_x = turn @ s_x
        s_y = turn @ s_y
    vectors = {"origin_mm": origin, "s_x": s_x, "s_y": s_y}
    screen = (geometry.screen or ScreenPoseConfig()).model_copy(
        update={name: tuple(value.tolist()) for name, value in vectors.items()}
    )
    camera = CameraPoseConfig(position_mm=pinhole.tolist(), rotation=rotation.tolist())
    short = dict.fromkeys(("a_mm", "b_mm", "alpha_deg"))
    return geometry.model_copy(update={**short, "camera": camera, "screen": screen})
