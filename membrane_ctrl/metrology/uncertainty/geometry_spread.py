"""How well a geometry is known: a covariance over named changes of it, from which trials draw.

The poses change in eleven numbers, a, b, alpha and the others of `calibrate.parameters.POSE`, or in
the twelve of a calibrated geometry: camera and screen are each shifted (mm, in world) and turned
(rad, a rotation vector in world, about the pinhole and about O'). Lens, bow and pitch change in
those of `calibrate.parameters.OPTIONAL`.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from membrane_ctrl.config.optics import CameraPoseConfig, GeometryConfig, OpticsConfig, Vector3
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model.arrays import ArrayLike, FloatArray

POSE_NAMES = tuple(parameter.name for parameter in bench_parameters.POSE)
OPTIONAL_NAMES = tuple(
    parameter.name for parameter in bench_parameters.OPTIONAL
)  # lens, bow, pitch
SHORT_NAMES = POSE_NAMES[:3]
GENERAL_NAMES = tuple(
    f"{thing}_{move}_{axis}_{unit}"
    for thing in ("camera", "screen")
    for move, unit in (("shift", "mm"), ("turn", "rad"))
    for axis in "xyz"
)


@dataclass(frozen=True)
class GeometrySpread:
    """Covariance of a geometry.

    Raises ValueError on construction, for unknown or mixed names and for a matrix that is no
    covariance.
    """

    names: tuple[
        str, ...
    ]  # of `calibrate.parameters`, the poses' or `GENERAL_NAMES`; numbers not named are exact
    covariance: FloatArray  # (k, k): of their changes, in the units of the names

    def __post_init__(self) -> None:
        if len(set(self.names)) != len(self.names):
            raise ValueError("names: one occurs twice")
        poses = set(self.names) - set(OPTIONAL_NAMES)
        if not (poses <= set(POSE_NAMES) or poses <= set(GENERAL_NAMES)):
            raise ValueError(
                f"names: poses all from {', '.join(POSE_NAMES)} or all from "
                f"{', '.join(GENERAL_NAMES)}, "
                f"the rest from {', '.join(OPTIONAL_NAMES)}"
            )
        if self.covariance.shape != (len(self.names), len(self.names)):
            raise ValueError(f"matrix: {len(self.names)} names need as many rows and columns")
        if not np.all(np.isfinite(self.covariance)) or not np.allclose(
            self.covariance, self.covariance.T
        ):
            raise ValueError("matrix: not finite and symmetric")
        if np.any(np.diag(self.covariance) < 0):
            raise ValueError("matrix: a variance is negative")
        # rounding of a written matrix may leave a little below 0
        if self.names and np.linalg.eigvalsh(self.correlation()).min() < -1e-6:
            raise ValueError("matrix: not a covariance (an eigenvalue is negative)")

    @classmethod
    def independent(cls, sigmas: dict[str, float]) -> "GeometrySpread":
        """From one sigma a name."""
        return cls(tuple(sigmas), np.diag(np.square(np.array(list(sigmas.values()), float))))

    def with_others(self, sigmas: dict[str, float]) -> "GeometrySpread":
        """Independent numbers added to these; those already named stay."""
        other = GeometrySpread.independent(
            {n: s for n, s in sigmas.items() if n not in self.names and s > 0}
        )
        size = len(self.names)
        whole = np.zeros((size + len(other.names), size + len(other.names)))
        whole[:size, :size], whole[size:, size:] = self.covariance, other.covariance
        return GeometrySpread(self.names + other.names, whole)

    @property
    def sigmas(self) -> FloatArray:
        """(k,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    def correlation(self) -> FloatArray:
        """(k, k), 1 on the diagonal where there is any spread: mm and rad on one footing."""
        scale = np.where(self.sigmas > 0, self.sigmas, 1.0)
        return np.asarray(self.covariance / np.outer(scale, scale))

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """(k,) one change."""
        return np.asarray(self.root() @ rng.standard_normal(len(self.names)))

    def root(self) -> FloatArray:
        """(k, k): times its transpose it is the covariance."""
        values, vectors = np.linalg.eigh(self.correlation())
        return np.asarray(
            self.sigmas[:, None] * ((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
        )


def stated_spread(geometry: GeometryConfig) -> GeometrySpread | None:
    """What `a_sigma_mm`, `b_sigma_mm` and `alpha_sigma_deg` say; None if the geometry has none of
    them.
    """
    sigmas = (geometry.a_sigma_mm, geometry.b_sigma_mm, geometry.alpha_sigma_deg)
    if geometry.a_mm is None or all(sigma is None for sigma in sigmas):
        return None
    return GeometrySpread.independent(
        {n: s or 0.0 for n, s in zip(SHORT_NAMES, sigmas, strict=True)}
    )


def change_geometry(
    geometry: GeometryConfig, names: tuple[str, ...], change: ArrayLike
) -> GeometryConfig:
    """The geometry changed by (k,) amounts. Raises ValueError if the names belong to the other
    form.
    """
    amounts = dict(zip(names, np.asarray(change, float).tolist(), strict=True))
    if not amounts:
        return geometry
    camera, screen = geometry.camera, geometry.screen
    if camera is None or screen is None or screen.pose is None:
        if unknown := set(names) - set(SHORT_NAMES):
            raise ValueError(f"{min(unknown)}: the geometry is given by a, b and alpha")
        return geometry.model_copy(update={n: getattr(geometry, n) + d for n, d in amounts.items()})
    if unknown := set(names) - set(GENERAL_NAMES):
        raise ValueError(f"{min(unknown)}: the geometry is given by two poses")
    turn = _turn_vector(amounts, "camera")
    rows = [_to_vector(turn @ np.array(row)) for row in camera.rotation]
    moved_camera = CameraPoseConfig(
        position_mm=_shift_point(camera.position_mm, amounts, "camera"),
        rotation=(rows[0], rows[1], rows[2]),
    )
    turn = _turn_vector(amounts, "screen")
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
    """The bench with its poses, lens, bow and pitch changed by (k,) amounts.

    Raises ValueError if the names belong to another form of geometry.
    """
    amounts = dict(zip(names, np.asarray(change, float).tolist(), strict=True))
    general = tuple(name for name in names if name in GENERAL_NAMES)
    geometry = change_geometry(optics.geometry, general, [amounts.pop(name) for name in general])
    values = np.array([amounts.get(name, 0.0) for name in bench_parameters.NAMES])
    return bench_poses.bench_at(
        Geometry.from_config(optics.model_copy(update={"geometry": geometry})), values
    )


def _turn_vector(amounts: dict[str, float], thing: str) -> FloatArray:
    vector = [amounts.get(f"{thing}_turn_{axis}_rad", 0.0) for axis in "xyz"]
    return np.asarray(cv2.Rodrigues(np.array(vector))[0])


def _shift_point(place_mm: Vector3, amounts: dict[str, float], thing: str) -> Vector3:
    return _to_vector(
        np.array(place_mm) + [amounts.get(f"{thing}_shift_{axis}_mm", 0.0) for axis in "xyz"]
    )


def _to_vector(values: FloatArray) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z


# The paper's instruments: laser distance meter and digital protractor.
PAPER_SPREAD = GeometrySpread.independent({"a_mm": 2.0, "b_mm": 2.0, "alpha_deg": 0.3})
