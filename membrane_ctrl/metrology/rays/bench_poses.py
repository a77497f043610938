"""Poses, lens and screen of a bench whose parameters (`bench_parameters`) are not 0.

All are 0 for the stated bench. With hinge = F x O' / |F x O'| (world -y for the paper's bench),
R(n, w) the turn by w about n, and the stated pinhole F0, camera rows C0, screen origin O0 and
screen rows X0 (s_x, s_y, normal):

    F = (1 + a / |F0|) R(hinge, alpha) F0
    C = R(x, pitch) R(y, yaw) R(z, roll) C0 R(hinge, alpha)^T
    O' = R(hinge, -alpha) ((1 + b / |O0|) O0 + x s_x + y s_y)
    X = R(s_x, turn_x) R(s_y, turn_y) R(normal, turn_z) X0 R(hinge, -alpha)^T

so that a, b and alpha are the paper's. A turn of everything about z is unobservable: the camera's
azimuth is therefore not a parameter and defines the direction of x. The other rigid motions are
parameters: two shifts, which the fixed ring determines, and two tilts, which only hand
measurements determine.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from membrane_ctrl.metrology.rays.bench_parameters import OPTIONAL, POSE
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.screen_face import BOW_RADIUS_MM
from membrane_ctrl.model.arrays import AnyArray, FloatArray

_COMPLEX_STEP = 1e-30  # small enough that its square is nothing beside 1
# Number of the parameters that the fringes depend on; the laser's scale follows them.
OPTICAL = len(POSE) + len(OPTIONAL)
# Numbers of a screen put elsewhere: its shift along s_x, s_y and normal, mm, and its turns about
# them, degrees.
SCREEN_MOVE = 6
_LEAST_SINE = 1e-6  # between the directions of camera and screen, so that alpha is defined


@dataclass(frozen=True)
class BenchGeometry:
    """A geometry, and the scale of its screen.

    Attributes
    ----------
    geometry : Geometry
        Camera and screen.
    pitch : float
        True length of the screen's nominal millimetre.
    """

    geometry: Geometry
    pitch: float = 1.0


@dataclass(frozen=True)
class Poses:
    """Poses of camera and screen, or derivatives of them.

    Attributes
    ----------
    pinhole_mm : (3,) array
        F.
    camera : (3, 3) array
        Rows C: axes of the camera in world.
    origin_mm : (3,) array
        O'.
    screen : (3, 3) array
        Rows X: s_x, s_y and normal in world.
    """

    pinhole_mm: AnyArray
    camera: AnyArray
    origin_mm: AnyArray
    screen: AnyArray


def bench_at(stated: Geometry, values: FloatArray) -> BenchGeometry:
    """The bench with other parameters.

    Parameters
    ----------
    stated : Geometry
        The stated bench.
    values : (len(NAMES),) array
        Parameters in the order of `bench_parameters.NAMES`, in their units; 0 for the stated bench.

    Returns
    -------
    BenchGeometry

    Raises
    ------
    ValueError
        Camera and screen are in line with the vertex.
    """
    poses = poses_at(stated, values)
    focal, column, row, k1, k2, p1, p2, bow_mm, pitch = values[len(POSE) : OPTICAL]

    # The stated lens has any number of coefficients; the first four change.
    lens = np.zeros(max(4, len(stated.distortion)))
    lens[: len(stated.distortion)] = stated.distortion
    lens[:4] += (k1, k2, p1, p2)
    distortion: tuple[float, ...] = ()
    if lens.any():
        distortion = tuple(float(k) for k in lens)
    # Poses, lens and bow replace the stated ones; the focal length changes by its logarithm.
    bow_per_mm = stated.face.bow_per_mm + bow_mm / BOW_RADIUS_MM**2
    geometry = replace(
        stated,
        pinhole_mm=poses.pinhole_mm,
        rotation=poses.camera,
        focal_px=stated.focal_px * float(np.exp(focal)),
        principal_px=(stated.principal_px[0] + column, stated.principal_px[1] + row),
        distortion=distortion,
        screen_origin_mm=poses.origin_mm,
        screen_s_x=poses.screen[0],
        screen_s_y=poses.screen[1],
        face=stated.face._replace(bow_per_mm=bow_per_mm),
    )
    return BenchGeometry(geometry, 1 + pitch)


def poses_at(stated: Geometry, values: AnyArray) -> Poses:
    """Return the poses of a parameter vector.

    Parameters
    ----------
    stated : Geometry
        The bench at which all parameters are 0.
    values : (n,) array
        Real, or complex for `pose_derivatives`; only the first eleven count.
    """
    rad_per_unit = [np.pi / 180 if parameter.unit == "deg" else 1.0 for parameter in POSE]
    in_radians = values[: len(POSE)] * rad_per_unit
    a, b, alpha, x, y, turn_x, turn_y, turn_z, yaw, pitch, roll = in_radians
    f0 = stated.pinhole_mm
    o0 = stated.screen_origin_mm
    rows = stated.screen_axes
    # alpha turns camera and screen about the hinge, in opposite senses.
    hinge = _hinge_axis(f0, o0)
    up = _turn_matrix(hinge, alpha)
    back = _turn_matrix(hinge, -alpha)
    # a and b lengthen the distances; x and y shift the screen in its plane.
    farther_origin = (1 + b / np.linalg.norm(o0)) * o0
    shifted_origin = farther_origin + x * rows[0] + y * rows[1]
    return Poses(
        pinhole_mm=(1 + a / np.linalg.norm(f0)) * (up @ f0),
        camera=_combine_turns(pitch, yaw, roll) @ stated.rotation @ up.T,
        origin_mm=back @ shifted_origin,
        screen=_combine_turns(turn_x, turn_y, turn_z) @ rows @ back.T,
    )


def pose_derivatives(stated: Geometry, values: FloatArray) -> list[Poses]:
    """Return the derivatives of the poses by each of the eleven parameters, exact to rounding.

    All of `poses_at` is analytic, so Im f(p + i h) / h is its derivative, without the loss of a
    difference.

    Parameters
    ----------
    stated : Geometry
        The bench at which all parameters are 0.
    values : (n,) array
        Where the derivatives are taken.
    """
    out = []
    for k in range(len(POSE)):
        there = values.astype(complex)
        there[k] += 1j * _COMPLEX_STEP
        poses = poses_at(stated, there)
        parts = (poses.pinhole_mm, poses.camera, poses.origin_mm, poses.screen)
        out.append(Poses(*(np.asarray(part.imag / _COMPLEX_STEP) for part in parts)))
    return out


def displace_screen(
    bench: BenchGeometry, turns: list[Poses], move: FloatArray
) -> tuple[BenchGeometry, list[Poses]]:
    """Move the screen of a bench.

    Parameters
    ----------
    bench : BenchGeometry
        The bench.
    turns : list of Poses
        Derivatives of its poses by their parameters.
    move : (6,) array
        The move, as `SCREEN_MOVE`.

    Returns
    -------
    bench : BenchGeometry
        With the screen moved.
    derivatives : list of Poses
        Of its poses by the parameters of `turns`, and by the six numbers of the move.
    """
    geometry = bench.geometry
    rows = geometry.screen_axes
    origin_mm, screen = _move_screen(geometry.screen_origin_mm, rows, move)

    # By the bench's own parameters: the move goes with the screen.
    by_turn = screen @ rows.T
    derivatives = []
    for turn in turns:
        moved_origin = turn.origin_mm + turn.screen.T @ move[:3]
        derivatives.append(replace(turn, origin_mm=moved_origin, screen=by_turn @ turn.screen))

    # By the move, with a complex step.
    for step in 1j * _COMPLEX_STEP * np.eye(SCREEN_MOVE):
        by_origin, by_screen = _move_screen(geometry.screen_origin_mm, rows, move + step)
        by_origin = np.asarray(by_origin.imag / _COMPLEX_STEP)
        by_screen = np.asarray(by_screen.imag / _COMPLEX_STEP)
        derivatives.append(Poses(np.zeros(3), np.zeros((3, 3)), by_origin, by_screen))
    moved = replace(
        geometry, screen_origin_mm=origin_mm, screen_s_x=screen[0], screen_s_y=screen[1]
    )
    return replace(bench, geometry=moved), derivatives


def _move_screen(
    origin_mm: FloatArray, rows: FloatArray, move: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Origin (3,) and rows (3, 3) of a screen after a move (6,)."""
    turns_rad = np.pi / 180 * move[3:]
    return origin_mm + rows.T @ move[:3], _combine_turns(*turns_rad) @ rows


def _hinge_axis(pinhole_mm: FloatArray, origin_mm: FloatArray) -> FloatArray:
    """Unit vector (3,) about which alpha turns.

    Raises ValueError if camera and screen are in one direction from the vertex.
    """
    across = np.cross(pinhole_mm, origin_mm)
    length = float(np.linalg.norm(across))
    lengths = float(np.linalg.norm(pinhole_mm) * np.linalg.norm(origin_mm))
    if length < _LEAST_SINE * lengths:
        raise ValueError("camera and screen are in line with the vertex: alpha is undefined")
    return across / length


def _combine_turns(x: Any, y: Any, z: Any) -> AnyArray:
    """Turns about x, y and z, the last one first."""
    i, j, k = np.eye(3)
    return np.asarray(_turn_matrix(i, x) @ _turn_matrix(j, y) @ _turn_matrix(k, z))


def _turn_matrix(axis: FloatArray, angle: Any) -> AnyArray:
    """Rodrigues' matrix of a turn about a unit vector: 1 + sin w K + (1 - cos w) K^2."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    first_order = np.sin(angle) * cross
    second_order = (1 - np.cos(angle)) * (cross @ cross)
    return np.asarray(np.eye(3) + first_order + second_order)
