"""How well a geometry is known: a covariance over named changes of it, from which trials draw.

The poses change in eleven numbers, a, b, alpha and the others of `bench_parameters.POSE`, or in the
twelve of a calibrated geometry: camera and screen are each shifted (mm, in world) and turned (rad,
a rotation vector in world, about the pinhole and about O'). Lens, bow and pitch change in those of
`bench_parameters.OPTIONAL`.
"""

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np

from membrane_ctrl.config.optics import CameraPoseConfig, GeometryConfig, OpticsConfig, Vector3
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model.arrays import ArrayLike, FloatArray

POSE_NAMES = tuple(parameter.name for parameter in bench_parameters.POSE)
OPTIONAL_NAMES = tuple(parameter.name for parameter in bench_parameters.OPTIONAL)
SHORT_NAMES = POSE_NAMES[:3]  # a, b and alpha
GENERAL_NAMES = tuple(
    f"{thing}_{move}_{axis}_{unit}"
    for thing in ("camera", "screen")
    for move, unit in (("shift", "mm"), ("turn", "rad"))
    for axis in "xyz"
)
# Least eigenvalue of a correlation: rounding of a written matrix may leave a little below 0.
_LEAST_EIGENVALUE = -1e-6


class KnownBy(StrEnum):
    """What a geometry's uncertainty rests on."""

    CALIBRATION = "calibration"  # a covariance in its file
    STATED = "stated sigmas"  # its own sigmas of a, b and alpha
    DATA_SHEETS = "data sheets"  # the sigmas of the paper's instruments


@dataclass(frozen=True)
class GeometrySpread:
    """Covariance of a geometry.

    Attributes
    ----------
    names : tuple of str
        Of `bench_parameters`, or poses of `GENERAL_NAMES`; numbers that are not named are exact.
    covariance : (k, k) array
        Covariance of their changes, in the units of the names.

    Raises
    ------
    ValueError
        On construction, for unknown or mixed names and for a matrix that is no covariance.
    """

    names: tuple[str, ...]
    covariance: FloatArray

    def __post_init__(self) -> None:
        # Each name once, and the poses in one of the two forms of a geometry.
        if len(set(self.names)) != len(self.names):
            raise ValueError("names: one occurs twice")
        poses = set(self.names) - set(OPTIONAL_NAMES)
        if not (poses <= set(POSE_NAMES) or poses <= set(GENERAL_NAMES)):
            raise ValueError(
                f"names: poses all from {', '.join(POSE_NAMES)} or all from "
                f"{', '.join(GENERAL_NAMES)}, "
                f"the rest from {', '.join(OPTIONAL_NAMES)}"
            )

        # A covariance: square, finite, symmetric, no negative variance and no negative eigenvalue.
        # The eigenvalues are those of the correlation, which has no units.
        if self.covariance.shape != (len(self.names), len(self.names)):
            raise ValueError(f"matrix: {len(self.names)} names need as many rows and columns")
        is_symmetric = np.all(np.isfinite(self.covariance)) and np.allclose(
            self.covariance, self.covariance.T
        )
        if not is_symmetric:
            raise ValueError("matrix: not finite and symmetric")
        if np.any(np.diag(self.covariance) < 0):
            raise ValueError("matrix: a variance is negative")
        if self.names and np.linalg.eigvalsh(self.correlation()).min() < _LEAST_EIGENVALUE:
            raise ValueError("matrix: not a covariance (an eigenvalue is negative)")

    @classmethod
    def from_sigmas(cls, sigmas: dict[str, float]) -> "GeometrySpread":
        """The spread of independent numbers, with one sigma for each name."""
        values = np.array(list(sigmas.values()), float)
        return cls(tuple(sigmas), np.diag(np.square(values)))

    def add_independent(self, sigmas: dict[str, float]) -> "GeometrySpread":
        """Add independent numbers to this spread.

        Parameters
        ----------
        sigmas : dict
            One sigma for each name; names that the spread has, and sigmas of 0, are left out.

        Returns
        -------
        GeometrySpread
        """
        new_names = [name for name in sigmas if name not in self.names]
        added = {name: sigmas[name] for name in new_names if sigmas[name] > 0}
        other = GeometrySpread.from_sigmas(added)
        size = len(self.names)
        covariance = np.zeros((size + len(added), size + len(added)))
        covariance[:size, :size] = self.covariance
        covariance[size:, size:] = other.covariance
        return GeometrySpread(self.names + other.names, covariance)

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations (k,)."""
        return np.sqrt(np.diag(self.covariance))

    def correlation(self) -> FloatArray:
        """Correlation (k, k): 1 on the diagonal where there is any spread, whatever the units."""
        scale = np.where(self.sigmas > 0, self.sigmas, 1.0)
        return np.asarray(self.covariance / np.outer(scale, scale))

    def draw_change(self, rng: np.random.Generator) -> FloatArray:
        """Draw one change (k,)."""
        return np.asarray(self.covariance_root() @ rng.standard_normal(len(self.names)))

    def covariance_root(self) -> FloatArray:
        """Root (k, k) of the covariance: times its transpose it is the covariance."""
        # Of the correlation, whose numbers do not depend on the units; rounding may leave an
        # eigenvalue a little below 0.
        values, vectors = np.linalg.eigh(self.correlation())
        root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        return np.asarray(self.sigmas[:, None] * root)


def stated_spread(geometry: GeometryConfig) -> GeometrySpread | None:
    """The spread of `a_sigma_mm`, `b_sigma_mm` and `alpha_sigma_deg`; None if the geometry states
    none of them.
    """
    sigmas = (geometry.a_sigma_mm, geometry.b_sigma_mm, geometry.alpha_sigma_deg)
    if geometry.a_mm is None or all(sigma is None for sigma in sigmas):
        return None
    stated = {name: sigma or 0.0 for name, sigma in zip(SHORT_NAMES, sigmas, strict=True)}
    return GeometrySpread.from_sigmas(stated)


def change_geometry(
    geometry: GeometryConfig, names: tuple[str, ...], change: ArrayLike
) -> GeometryConfig:
    """Change a geometry.

    Parameters
    ----------
    geometry : GeometryConfig
        The geometry, of either form.
    names : tuple of str
        k numbers of that form.
    change : (k,) array
        Amounts by which they change.

    Returns
    -------
    GeometryConfig

    Raises
    ------
    ValueError
        If the names belong to the other form.
    """
    amounts = dict(zip(names, np.asarray(change, float).tolist(), strict=True))
    if not amounts:
        return geometry

    # A geometry by a, b and alpha changes these numbers themselves.
    camera = geometry.camera
    screen = geometry.screen
    if camera is None or screen is None or screen.pose is None:
        if unknown := set(names) - set(SHORT_NAMES):
            raise ValueError(f"{min(unknown)}: the geometry is given by a, b and alpha")
        changed = {name: getattr(geometry, name) + amount for name, amount in amounts.items()}
        return geometry.model_copy(update=changed)
    if unknown := set(names) - set(GENERAL_NAMES):
        raise ValueError(f"{min(unknown)}: the geometry is given by two poses")

    # The camera: its position is shifted, its axes are turned about it.
    turn = _rotation(amounts, "camera")
    rows = [_to_vector(turn @ np.array(row)) for row in camera.rotation]
    moved_camera = CameraPoseConfig(
        position_mm=_shift_point(camera.position_mm, amounts, "camera"),
        rotation=(rows[0], rows[1], rows[2]),
    )

    # The screen, about its origin O'.
    turn = _rotation(amounts, "screen")
    origin_mm, s_x, s_y = screen.pose
    moved_screen = screen.model_copy(
        update={
            "origin_mm": _shift_point(origin_mm, amounts, "screen"),
            "s_x": _to_vector(turn @ np.array(s_x)),
            "s_y": _to_vector(turn @ np.array(s_y)),
        }
    )
    return geometry.model_copy(update={"camera": moved_camera, "screen": moved_screen})


def moved_bench(
    optics: OpticsConfig, names: tuple[str, ...], change: ArrayLike
) -> bench_poses.BenchGeometry:
    """Change a bench by named amounts.

    Parameters
    ----------
    optics : OpticsConfig
        The bench.
    names : tuple of str
        k numbers of its poses, lens, bow and pitch.
    change : (k,) array
        Amounts by which they change.

    Returns
    -------
    BenchGeometry

    Raises
    ------
    ValueError
        The names belong to another form of geometry.
    """
    # Numbers of the general form change the poses; the others are the calibration's parameters.
    amounts = dict(zip(names, np.asarray(change, float).tolist(), strict=True))
    general = tuple(name for name in names if name in GENERAL_NAMES)
    geometry = change_geometry(optics.geometry, general, [amounts.pop(name) for name in general])
    values = np.array([amounts.get(name, 0.0) for name in bench_parameters.NAMES])
    changed = optics.model_copy(update={"geometry": geometry})
    return bench_poses.bench_at(Geometry.from_config(changed), values)


def _rotation(amounts: dict[str, float], thing: str) -> FloatArray:
    """Rotation matrix (3, 3) of the changes of a pose."""
    vector = [amounts.get(f"{thing}_turn_{axis}_rad", 0.0) for axis in "xyz"]
    return np.asarray(cv2.Rodrigues(np.array(vector))[0])


def _shift_point(place_mm: Vector3, amounts: dict[str, float], thing: str) -> Vector3:
    """A point shifted by the changes of a pose."""
    shift_mm = [amounts.get(f"{thing}_shift_{axis}_mm", 0.0) for axis in "xyz"]
    return _to_vector(np.array(place_mm) + shift_mm)


def _to_vector(values: FloatArray) -> Vector3:
    """Three values as a tuple of the configuration."""
    x, y, z = values.tolist()
    return x, y, z


# The paper's instruments: laser distance meter and digital protractor.
PAPER_SPREAD = GeometrySpread.from_sigmas({"a_mm": 2.0, "b_mm": 2.0, "alpha_deg": 0.3})
