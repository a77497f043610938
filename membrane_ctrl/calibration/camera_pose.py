"""The command `calibrate-pose`: the camera's pose, from the ring in the white frame of a set."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.geometry.file import read_geometry
from membrane_ctrl.geometry.prior_file import read_prior, write_prior
from membrane_ctrl.measure import capture_set, measurement
from membrane_ctrl.metrology.calibration import geometry_tables, ring_pose
from membrane_ctrl.metrology.figure import bin_figure
from membrane_ctrl.metrology.frame_checks.checked_set import RejectedSetError
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.bench_parameters import usual_sigma
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.rim_outline import find_outline
from membrane_ctrl.model import errors
from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class PoseOptions:
    """Options of `calibrate-pose`.

    Attributes
    ----------
    folder : Path
        The set.
    geometry : Path or None
        File of the stated geometry; None: that of the set.
    priors : sequence of Path
        Results of other auxiliary calibrations.
    radius_sigma_mm : float
        Standard uncertainty of the ring's radius.
    out : Path
        File of the prior.
    as_json : bool
        Whether to print the report as JSON.
    """

    folder: Path
    geometry: Path | None
    priors: Sequence[Path]
    radius_sigma_mm: float
    out: Path
    as_json: bool


def calibrate_pose(options: PoseOptions) -> int:
    """Find the rim in a set, fit the camera's pose, write the prior and report.

    Returns
    -------
    int
        The exit code of the command.

    Raises
    ------
    CommandError
        If a file is not usable, the set has no figure, or the rim is not in the picture.
    """
    geometry = None
    if options.geometry is not None:
        geometry = read_geometry(options.geometry)

    # The set, with what other calibrations found of the lens.
    capture = capture_set.read_set(options.folder, geometry)
    optics = capture.head.optics
    for path in options.priors:
        optics = read_prior(path).apply_to_optics(optics)
    capture = replace(capture, head=replace(capture.head, optics=optics))

    # The rough rim by the stated pose, then the pose by its edges.
    stated = Geometry.from_config(optics)
    light = _white_minus_black(capture)
    rim_z, rim_mean_mm = _rim_height(capture)
    radius_mm = optics.mirror.radius_mm
    outline = find_outline(light, stated, radius_mm, rim_mean_mm)
    if outline is None:
        raise errors.RejectedError(f"{options.folder}: the rim is not in the picture")
    try:
        pose = ring_pose.ring_pose(
            light, stated, outline.rim_px, radius_mm, rim_z, options.radius_sigma_mm
        )
    except ValueError as error:
        raise errors.RejectedError(f"{options.folder}: {error}") from None

    # The prior's file, and the report.
    sigmas = dict(zip(ring_pose.POSE_NAMES, pose.sigmas.tolist(), strict=True))
    tables = {
        "geometry": geometry_tables.general_form(pose.bench(stated), optics).model_dump(
            exclude_none=True
        ),
        "sigmas": sigmas,
    }
    write_prior(options.out, tables, "calibrate-pose", [options.folder.name], pose.rms_px)
    report: dict[str, Any] = {
        "schema": "membrane-calibrate-pose/1",
        "out": str(options.out),
        "rms_px": pose.rms_px,
        "edges": pose.points,
        "values": dict(zip(ring_pose.POSE_NAMES, pose.values.tolist(), strict=True)),
        "sigmas": sigmas,
    }
    print(json.dumps(report) if options.as_json else "\n".join(_format_pose(pose, options.out)))
    return int(errors.Exit.DONE)


def _white_minus_black(capture: capture_set.CaptureSet) -> FloatArray:
    """White minus black frame (rows, columns).

    Raises InputError for a set without them, RejectedError if one is not usable.
    """
    names = [pattern.name for pattern in capture.head.patterns]
    if "white" not in names:
        raise errors.InputError(
            f"{capture.head.folder / 'capture.toml'}: kind: a full set is needed, for its "
            "white frame"
        )
    for name in ("white", "black"):
        k = names.index(name)
        if k in capture.unusable:
            raise errors.RejectedError(
                f"{capture.head.folder}: {capture.head.files[k]}: {capture.unusable[k]}"
            )
    white = capture.frames[names.index("white")].astype(float)
    black = capture.frames[names.index("black")].astype(float)
    return np.asarray(white - black)


def _rim_height(capture: capture_set.CaptureSet) -> tuple[ray_tracing.HeightFunction, float]:
    """Height of the film at the rim in world in mm, as a function of x and y, and its mean.

    Raises RejectedError for a set without a figure.
    """
    optics = capture.head.optics
    try:
        checked = check_set(measurement.stack_of(capture), optics)
    except RejectedSetError as error:
        raise errors.RejectedError(f"{capture.head.folder}: rejected: {error}") from None
    surface = bin_figure.bin_figure(optics, checked).fit.surface
    vertex_mm = checked.tracer.vertex_z_mm

    def height(x: FloatArray, y: FloatArray) -> FloatArray:
        # Of the point of the rim with the same azimuth: the terms diverge beyond the rim.
        to_rim = surface.radius_mm / np.maximum(np.hypot(x, y), 1.0)
        return np.asarray(vertex_mm + surface.height(x * to_rim, y * to_rim))

    return height, vertex_mm + surface.sag_mm


def _format_pose(pose: ring_pose.RingPose, out: Path) -> list[str]:
    """The table of the pose, and how well it fits, for a terminal."""
    lines = ["what              stated wrong by   +-        known before"]
    improvements = []
    for name, value, sigma in zip(ring_pose.POSE_NAMES, pose.values, pose.sigmas, strict=True):
        lines.append(f"{name:<18}{value:>+13.4f}  {sigma:<9.4f} {usual_sigma(name):.3g}")
        improvements.append(usual_sigma(name) / sigma)
    lines.append(
        f"edges left {pose.rms_px:.3f} px RMS at {pose.points} points, at best "
        f"{max(improvements):.0f} times better"
    )
    return [*lines, f"written: {out}; use it with calibrate --prior {out}"]
