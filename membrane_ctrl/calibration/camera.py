"""The commands that calibrate camera and screen alone: `calibrate-camera`, `calibrate-pose`,
`calibrate-display`.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from firmware_iface.display import DisplayResponse, Settling
from firmware_iface.roles import LinkError
from membrane_ctrl.acquisition import exposures, optical_bench, session
from membrane_ctrl.config.schema import CameraConfig, Config, PatternConfig
from membrane_ctrl.geometry.file import read_geometry
from membrane_ctrl.geometry.spread_file import read_prior, write_prior
from membrane_ctrl.measure import capture_set, measurement
from membrane_ctrl.measure.images import IMAGE_BYTES_MAX, decoded_image
from membrane_ctrl.metrology.calibration import geometry_tables, ring_pose
from membrane_ctrl.metrology.calibration.board import Board, on_screen
from membrane_ctrl.metrology.calibration.board_lens import BoardView, Lens, calibrate_lens
from membrane_ctrl.metrology.figure import bin_figure
from membrane_ctrl.metrology.frame_checks.checked_set import RejectedSetError
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.screen_scale import mm_per_rad
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.bench_parameters import usual_sigma
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.rim_outline import find_outline
from membrane_ctrl.model import errors, files
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.clock import RunClock

_IMAGES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg")


@dataclass(frozen=True)
class CameraOptions:
    """Options of the command: a folder of photographs, the board in them,
    the camera as configured.
    """

    folder: Path
    board: str
    config: Config
    out: Path
    as_json: bool


def calibrate_camera(options: CameraOptions) -> int:
    """Find the corners, fit the lens, write the prior and report the improvement. Raises
    CommandError.
    """
    board, camera = _board(options.board), options.config.optics.camera
    views = [_view(path, board, camera) for path in _images(options.folder)]
    try:
        lens = calibrate_lens(views, camera)
    except ValueError as error:
        raise errors.RejectedError(f"{options.folder}: {error}") from None
    tables = {"camera": _camera_table(camera, lens), "sigmas": lens.sigmas}
    write_prior(options.out, tables, "calibrate-camera", lens.used, lens.rms_px)
    report = {
        "schema": "membrane-calibrate-camera/1",
        "out": str(options.out),
        "rms_px": lens.rms_px,
        "stated_rms_px": lens.stated_rms_px,
        "used": list(lens.used),
        "left_out": list(lens.left_out),
        "camera": tables["camera"],
        "sigmas": lens.sigmas,
    }
    print(json.dumps(report) if options.as_json else "\n".join(_lines(camera, lens, options.out)))
    return int(errors.Exit.DONE)


def draw_board(out: Path, board_text: str, square_px: int, width_px: int, height_px: int) -> int:
    """Write the board as a picture for a screen of the given size in pixels. Raises
    errors.InputError.
    """
    try:
        levels = on_screen(_board(board_text), square_px, width_px, height_px)
    except ValueError as error:
        raise errors.InputError(f"calibrate-board: {error}") from None
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        written, picture = cv2.imencode(out.suffix, levels)
        if written:
            files.write_bytes_atomic(files.users(out), picture.tobytes())
    except (OSError, cv2.error):
        written = False
    if not written:
        raise errors.InputError(f"{out}: cannot be written; give a .png in a writable folder")
    print(
        f"{board_text} of {square_px} px squares written to {out}; display it pixel for pixel",
        file=sys.stderr,
    )
    return int(errors.Exit.DONE)


def _board(text: str) -> Board:
    try:
        return Board.parse(text)
    except ValueError as error:
        raise errors.InputError(f"--board {error}") from None


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise errors.InputError(f"{folder}: no such folder of photographs")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in _IMAGES)
    if not found:
        raise errors.InputError(f"{folder}: holds no photographs ({', '.join(_IMAGES)})")
    return found


def _view(path: Path, board: Board, camera: CameraConfig) -> BoardView:
    try:
        image = decoded_image(
            files.read_bytes(path, IMAGE_BYTES_MAX), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
        )
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise errors.InputError(f"{path}: {reason}") from None
    if image.shape != (camera.height_px, camera.width_px):
        raise errors.InputError(
            f"{path}: {image.shape[1]} x {image.shape[0]} pixels, but the configuration's "
            "optics.camera has "
            f"{camera.width_px} x {camera.height_px}"
        )
    if image.dtype != np.uint8:  # the detectors take 8 bits only, which suffice for corners
        image = (np.asarray(image, float) * (255.0 / max(1, int(image.max())))).astype(np.uint8)
    place, seen_px = board.corners(np.asarray(image, np.uint8))
    return BoardView(path.name, place, seen_px)


def _camera_table(camera: CameraConfig, lens: Lens) -> dict[str, Any]:
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "pixel_um": camera.pixel_um,
        "focal_mm": lens.focal_px * camera.pixel_um * 1e-3,
        "principal_px": list(lens.principal_px),
        "distortion": list(lens.distortion),
    }


def _lines(camera: CameraConfig, lens: Lens, out: Path) -> list[str]:
    found = _camera_table(camera, lens)
    stated = (camera.focal_mm, *camera.principal, *(*camera.distortion, 0.0, 0.0, 0.0, 0.0)[:4])
    values = (found["focal_mm"], *lens.principal_px, *lens.distortion)
    scales = (found["focal_mm"], *[1.0] * 6)
    lines = ["what              stated       found        +-           known before"]
    for name, before, value, scale in zip(lens.sigmas, stated, values, scales, strict=True):
        label = "focal_mm" if name == "focal_relative" else name
        sigma, usual = lens.sigmas[name] * scale, usual_sigma(name) * scale
        lines.append(f"{label:<16}{before:>10.5g}{value:>13.6g}  {sigma:<11.2g}  {usual:.2g}")
    lines.append(
        f"corner residuals {lens.rms_px:.3f} px RMS in {len(lens.used)} photographs; "
        f"with the stated lens {lens.stated_rms_px:.3f} px"
    )
    if lens.left_out:
        lines.append(f"omitted, without a board or with a bad fit: {', '.join(lens.left_out)}")
    if lens.sigmas["focal_relative"] > usual_sigma("focal_relative"):
        lines.append(
            "the focal length is no better known than from its data sheet: tilt the board "
            "more, both ways"
        )
    return [*lines, f"written: {out}; use it with calibrate --prior {out}"]


# The camera's pose, from the ring's ellipse in the white frame of a set.


@dataclass(frozen=True)
class PoseOptions:
    """Options of the command."""

    folder: Path
    geometry: Path | None
    priors: Sequence[Path]
    radius_sigma_mm: float
    out: Path
    as_json: bool


def calibrate_pose(options: PoseOptions) -> int:
    """Measure the set, find the rim, fit the pose, write the prior and report.
    Raises CommandError.
    """
    geometry = None if options.geometry is None else read_geometry(options.geometry)
    capture = capture_set.read_set(options.folder, geometry)
    optics = capture.head.optics
    for path in options.priors:
        optics = read_prior(path).over(optics)
    capture = replace(capture, head=replace(capture.head, optics=optics))
    stated = Geometry.from_config(optics)
    light, (rim_z, rim_mean_mm) = _light(capture), _rim(capture)
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
    print(json.dumps(report) if options.as_json else "\n".join(_pose_lines(pose, options.out)))
    return int(errors.Exit.DONE)


def _light(capture: capture_set.CaptureSet) -> FloatArray:
    """White minus black. Raises errors.InputError for a set without them."""
    names = [pattern.name for pattern in capture.head.patterns]
    if "white" not in names:
        raise errors.InputError(
            f"{capture.head.folder / 'capture.toml'}: kind: a full set is needed, for its "
            "white frame"
        )
    for name in ("white", "black"):
        if (k := names.index(name)) in capture.unusable:
            raise errors.RejectedError(
                f"{capture.head.folder}: {capture.head.files[k]}: {capture.unusable[k]}"
            )
    white, black = (capture.frames[names.index(name)].astype(float) for name in ("white", "black"))
    return np.asarray(white - black)


def _rim(capture: capture_set.CaptureSet) -> tuple[ray_tracing.HeightFunction, float]:
    """Height of the film at the rim in world, and its mean. Raises RejectedError for a set without
    a figure.
    """
    optics = capture.head.optics
    try:
        checked = check_set(measurement.stack_of(capture), optics)
    except RejectedSetError as error:
        raise errors.RejectedError(f"{capture.head.folder}: rejected: {error}") from None
    surface, vertex_mm = (
        bin_figure.bin_figure(optics, checked).fit.surface,
        checked.tracer.vertex_z_mm,
    )

    def height(x: FloatArray, y: FloatArray) -> FloatArray:
        share = surface.radius_mm / np.maximum(
            np.hypot(x, y), 1.0
        )  # the terms diverge beyond the rim
        return np.asarray(vertex_mm + surface.height(x * share, y * share))

    return height, vertex_mm + surface.sag_mm


def _pose_lines(pose: ring_pose.RingPose, out: Path) -> list[str]:
    lines = ["what              stated wrong by   +-        known before"]
    lines += [
        f"{name:<18}{value:>+13.4f}  {sigma:<9.4f} {usual_sigma(name):.3g}"
        for name, value, sigma in zip(ring_pose.POSE_NAMES, pose.values, pose.sigmas, strict=True)
    ]
    better = max(
        usual_sigma(name) / sigma
        for name, sigma in zip(ring_pose.POSE_NAMES, pose.sigmas, strict=True)
    )
    lines.append(
        f"edges left {pose.rms_px:.3f} px RMS at {pose.points} points, at best {better:.0f} "
        "times better"
    )
    return [*lines, f"written: {out}; use it with calibrate --prior {out}"]


_PHASES = 720  # per period, to include the worst one


def calibrate_display(config: Config, source: str, as_json: bool) -> int:
    """Open camera and screen, measure, and report the resulting error. Raises CommandError.

    Call from the main thread only (because of the screen).
    """
    if config.devices is None or config.devices.camera is None or config.devices.screen is None:
        raise errors.InputError(
            f"{source}: devices.camera and devices.screen are both needed to measure the screen"
        )
    section, clock = config.devices.screen, session.WaitingClock(RunClock.start())
    try:
        bench = optical_bench.configured_bench(config, clock)
        try:
            settling, response = measured(bench, clock, section.width_px, section.height_px)
        finally:
            bench.close()
    except LinkError as error:
        raise errors.DeviceError(f"{source}: {error}") from None
    except ValueError as error:
        raise errors.DeviceError(f"{source}: screen: {error}") from None
    report = report_of(settling, response, config.optics.pattern)
    print(json.dumps(report) if as_json else "\n".join(lines_of(report)))
    return int(errors.Exit.DONE)


def measured(
    bench: optical_bench.OpticalBench, clock: exposures.CycleClock, width_px: int, height_px: int
) -> tuple[Settling, DisplayResponse]:
    """Open the bench and measure its screen. Raises LinkError, or ValueError if the camera cannot
    see the screen.
    """
    bench.camera.open()
    bench.screen.open()
    test = optical_bench.DisplayTest(bench.screen, bench.camera, clock, width_px, height_px)
    return test.settling(), test.response()


def report_of(
    settling: Settling, response: DisplayResponse, pattern: PatternConfig
) -> dict[str, object]:
    """The findings, schema membrane-calibrate-display/1."""
    bare, corrected = (fringe_error_mm(response, pattern, linear) for linear in (False, True))
    return {
        "schema": "membrane-calibrate-display/1",
        "settle_ms": 1e3 * settling.settle_s,
        "latency_ms": 1e3 * settling.latency_s if np.isfinite(settling.latency_s) else None,
        "time_constant_ms": 1e3 * settling.tau_s if np.isfinite(settling.tau_s) else None,
        "gamma": response.gamma,
        "fringe_error_um": {"as_sent": 1e3 * bare, "corrected": 1e3 * corrected},
    }


def lines_of(report: dict[str, object]) -> list[str]:
    """Format the report for people, with the lines for the configuration."""
    error = report["fringe_error_um"]
    assert isinstance(error, dict)
    return [
        f"settles in {report['settle_ms']:.0f} ms, gamma {report['gamma']:.2f}",
        f"fringe error on the screen: {error['as_sent']:.1f} µm RMS as sent, "
        f"{error['corrected']:.1f} µm corrected, from the rounding of its levels",
        "for the configuration (otherwise every start measures both):",
        "[devices.screen]",
        f"settle_ms = {report['settle_ms']:.0f}",
        "linearise = true",
    ]


def fringe_error_mm(response: DisplayResponse, pattern: PatternConfig, corrected: bool) -> float:
    """RMS error of a screen coordinate from this display's sinusoids, whose harmonics appear as
    phase.
    """
    phase = 2 * np.pi * np.arange(_PHASES) / _PHASES
    shifts = 2 * np.pi * np.arange(pattern.steps) / pattern.steps
    wanted = (1 + np.cos(phase + shifts[:, None])) / 2
    levels = response.levels_of(wanted) if corrected else np.rint(255 * wanted)
    light = np.interp(levels, response.levels, response.light)
    seen = np.arctan2(-np.sin(shifts) @ light, np.cos(shifts) @ light)
    error = np.angle(np.exp(1j * (seen - phase)))
    return float(mm_per_rad(pattern) * np.std(error))
