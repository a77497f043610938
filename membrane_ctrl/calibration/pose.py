"""The `calibrate-pose` command: the camera's pose from the ring's ellipse in the white frame of a set."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.geometry import file, spread_file
from membrane_ctrl.measure import capture_set, measurement
from membrane_ctrl.metrology import full, reconstruct
from membrane_ctrl.metrology.calibrate import artefact, parameters, ring_pose
from membrane_ctrl.metrology.checked import RejectedSetError, check
from membrane_ctrl.metrology.optics.geometry import Geometry, find_outline
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.errors import Exit, InputError, RejectedError


@dataclass(frozen=True)
class PoseOptions:
    """What the command was asked for."""

    folder: Path
    geometry: Path | None
    priors: Sequence[Path]
    radius_sigma_mm: float
    out: Path
    as_json: bool


def calibrate_pose(options: PoseOptions) -> int:
    """Measure the set, find the rim, fit the pose, write the prior, say what it improved. Raises CommandError."""
    capture = capture_set.read_set(
        options.folder, None if options.geometry is None else file.read_geometry(options.geometry)
    )
    optics = capture.head.optics
    for path in options.priors:
        optics = spread_file.read_prior(path).over(optics)
    capture = replace(capture, head=replace(capture.head, optics=optics))
    stated = Geometry.from_config(optics)
    light, (rim_z, rim_mean_mm) = _light(capture), _rim(capture)
    radius_mm = optics.mirror.radius_mm
    outline = find_outline(light, stated, radius_mm, rim_mean_mm)
    if outline is None:
        raise RejectedError(f"{options.folder}: the rim is not in the picture")
    try:
        pose = ring_pose.ring_pose(light, stated, outline.rim_px, radius_mm, rim_z, options.radius_sigma_mm)
    except ValueError as error:
        raise RejectedError(f"{options.folder}: {error}") from None
    sigmas = dict(zip(ring_pose.POSE_NAMES, pose.sigmas.tolist(), strict=True))
    tables = {
        "geometry": artefact.general_form(pose.bench(stated), optics).model_dump(exclude_none=True),
        "sigmas": sigmas,
    }
    spread_file.write_prior(options.out, tables, "calibrate-pose", [options.folder.name], pose.rms_px)
    report: dict[str, Any] = {
        "schema": "membrane-calibrate-pose/1",
        "out": str(options.out),
        "rms_px": pose.rms_px,
        "edges": pose.points,
        "values": dict(zip(ring_pose.POSE_NAMES, pose.values.tolist(), strict=True)),
        "sigmas": sigmas,
    }
    print(json.dumps(report) if options.as_json else "\n".join(_lines(pose, options.out)))
    return int(Exit.DONE)


def _light(capture: capture_set.CaptureSet) -> FloatArray:
    """White minus black. Raises InputError for a set without them."""
    names = [pattern.name for pattern in capture.head.patterns]
    if "white" not in names:
        raise InputError(f"{capture.head.folder / 'capture.toml'}: kind: a full set is needed, for its white frame")
    for name in ("white", "black"):
        if (k := names.index(name)) in capture.unusable:
            raise RejectedError(f"{capture.head.folder}: {capture.head.files[k]}: {capture.unusable[k]}")
    white, black = (capture.frames[names.index(name)].astype(float) for name in ("white", "black"))
    return np.asarray(white - black)


def _rim(capture: capture_set.CaptureSet) -> tuple[reconstruct.HeightFunction, float]:
    """Where the film at the rim stands in world, and its mean. Raises RejectedError for a set without a figure."""
    optics = capture.head.optics
    try:
        checked = check(measurement.stack_of(capture), optics)
    except RejectedSetError as error:
        raise RejectedError(f"{capture.head.folder}: rejected: {error}") from None
    surface, vertex_mm = full.bin_figure(optics, checked).fit.surface, checked.tracer.vertex_z_mm

    def height(x: FloatArray, y: FloatArray) -> FloatArray:
        share = surface.radius_mm / np.maximum(np.hypot(x, y), 1.0)  # terms run away beyond the rim
        return np.asarray(vertex_mm + surface.height(x * share, y * share))

    return height, vertex_mm + surface.sag_mm


def _lines(pose: ring_pose.RingPose, out: Path) -> list[str]:
    lines = ["what              stated wrong by   +-        known before"]
    lines += [
        f"{name:<18}{value:>+13.4f}  {sigma:<9.4f} {parameters.usual_sigma(name):.3g}"
        for name, value, sigma in zip(ring_pose.POSE_NAMES, pose.values, pose.sigmas, strict=True)
    ]
    better = max(
        parameters.usual_sigma(name) / sigma for name, sigma in zip(ring_pose.POSE_NAMES, pose.sigmas, strict=True)
    )
    lines.append(f"edges are left {pose.rms_px:.3f} px RMS, {pose.points} of them; at best {better:.0f} times better")
    return [*lines, f"written: {out}; use it with calibrate --prior {out}"]
