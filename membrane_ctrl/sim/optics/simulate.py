"""Capture sets with known truth: the twin's pictures in a real bench's file format."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w

from firmware_iface import optical_roles, settings
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.program import describe_origin, file_origin
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.drum_modes import drum_modes
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.screen_face import project_onto_face
from membrane_ctrl.sim.optics.simulation_spec import SimulationSpec
from membrane_ctrl.sim.optics.trace import Trace

_GRID = 201  # points of the truth's map along its side: odd, so that the vertex is one
# Noise does not compress: higher levels cost time and save nothing.
_PNG_SPEED = (
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_RLE,
)
_CROSSED_PERIODS = 32
_STEPS = 5  # of the first frames of a tracking set: 72 degrees in x, twice that in y


def capture_table(spec: SimulationSpec, readings_um: FloatArray) -> dict[str, Any]:
    """Return the content of `capture.toml` (schema membrane-capture/1) for a simulated set.

    Parameters
    ----------
    spec : SimulationSpec
        The bench, the set, and what a person states of them.
    readings_um : (frames,) array
        Readings of the laser.

    Returns
    -------
    dict
    """
    # What a person would state of the bench: perhaps not what it is.
    geometry = _make_config_table(spec.stated_geometry or spec.optics.geometry)
    if spec.laser:
        geometry["reference_displacement_um"] = spec.reference_um
    camera = _make_config_table(spec.optics.camera)
    if spec.optics.camera.bits == 8:
        del camera["bits"]  # the default of readers
    camera["principal_px"] = list(spec.optics.camera.principal)
    table: dict[str, Any] = {**file_origin("membrane-capture/1"), "kind": spec.kind}
    if spec.reference:
        table["reference"] = spec.reference
    if spec.film.bowl == "hencky" and spec.film.sag_mm > 0:
        table["pressure_pa"] = spec.pressure_pa(_mean_um(spec))
    table |= {
        "pattern": _make_config_table(spec.optics.pattern),
        "geometry": geometry,
        "camera": camera,
        "mirror": _make_config_table(spec.stated_mirror or spec.optics.mirror),
    }
    # What is special about this set.
    if spec.artefact:
        table["artefact"] = dict(spec.artefact)
    if spec.screen_moved:
        table["screen_moved"] = dict(spec.screen_moved)
    if spec.mirror_turned:
        table["mirror_turned"] = dict(spec.mirror_turned)
    table["frames"] = [
        _frame_row(spec, frame, float(readings_um[frame])) for frame in range(len(spec.patterns))
    ]
    return table


def write_capture_toml(folder: Path, spec: SimulationSpec, readings_um: FloatArray) -> None:
    """Write `capture.toml` into the folder of a simulated set.

    Parameters
    ----------
    folder : Path
        It must exist.
    spec, readings_um
        As for `capture_table`.
    """
    (folder / "capture.toml").write_bytes(tomli_w.dumps(capture_table(spec, readings_um)).encode())


def write_truth(folder: Path, spec: SimulationSpec) -> None:
    """Write the truth of a set.

    `truth.npz`: `x_mm` (W,), `y_mm` (H,), `h_mm` (H, W) above the vertex, NaN outside the rim, at
    the mean displacement of the sinusoids; `h_per_sag` (H, W), its change with sag;
    `displacement_um` (frames,); `coeffs_um` (ZERNIKE_TERMS,), Noll with the surface 0 at the
    vertex, if these terms represent the shape. `truth.json`: the same numbers without the maps, and
    the request.

    Parameters
    ----------
    folder : Path
        It must exist.
    spec : SimulationSpec
        The set.
    """
    displacement_um = np.array([spec.displacement_um(frame) for frame in range(len(spec.patterns))])
    mean_um = _mean_um(spec)
    coeffs_um = spec.film.coeffs_um(mean_um)

    # The maps: height, and its change for 1 mm of sag.
    radius_mm = spec.film.radius_mm
    axis_mm = np.linspace(-radius_mm, radius_mm, _GRID)
    x_mm, y_mm = np.meshgrid(axis_mm, axis_mm)
    inside = x_mm**2 + y_mm**2 <= radius_mm**2
    h_mm = np.where(inside, spec.film.height_mm(x_mm, y_mm, mean_um), np.nan)
    deeper_mm = np.where(inside, spec.film.height_mm(x_mm, y_mm, mean_um + 1000.0), np.nan)
    maps: dict[str, Any] = {
        "x_mm": axis_mm,
        "y_mm": axis_mm,
        "h_mm": h_mm,
        "h_per_sag": deeper_mm - h_mm,
    }
    if coeffs_um is not None:
        maps["coeffs_um"] = coeffs_um
    origin = np.array(describe_origin("membrane-truth/1"))
    np.savez_compressed(
        folder / "truth.npz", origin=origin, displacement_um=displacement_um, **maps
    )

    # The numbers, and what was requested.
    film = _film_table(spec.film)
    front = None
    if spec.front is not None:
        front = asdict(spec.front) | {"shape": _film_table(spec.front.shape)}
    truth = {
        **file_origin("membrane-simulation/1"),
        "displacement_um": mean_um,
        "sag_mm": spec.film.sag_at_mm(mean_um),
        "coeffs_um": None if coeffs_um is None else coeffs_um.tolist(),
        "frame_displacement_um": displacement_um.tolist(),
        "film": film,
        "front_film": front,
        "geometry": _make_config_table(spec.optics.geometry)
        | {"reference_displacement_um": spec.reference_um},
        "light": asdict(spec.light),
        "screen_error": None if spec.screen_error is None else asdict(spec.screen_error),
        "seat": None if spec.seat is None else spec.seat.as_table(),
        "faults": [asdict(fault) for fault in spec.faults],
        "seed": spec.seed,
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=2) + "\n")


def _film_table(film: FilmShape) -> dict[str, Any]:
    """A film as it was asked for, without the numbers made of that."""
    return {name: value for name, value in asdict(film).items() if name != "terms"}


def _mean_um(spec: SimulationSpec) -> float:
    """Mean displacement of the sinusoids, without those of coarser fringes."""
    displacements_um = [
        spec.displacement_um(frame)
        for frame, pattern in enumerate(spec.patterns)
        if pattern.role == "sin" and not pattern.period_mm
    ]
    return float(np.mean(displacements_um))


def _make_config_table(section: settings.Section) -> dict[str, Any]:
    """A configuration table as written, without absent fields and empty lists."""
    return {
        key: value
        for key, value in section.model_dump(mode="json", exclude_none=True).items()
        if value != []
    }


def _frame_row(spec: SimulationSpec, frame: int, reading_um: float) -> dict[str, Any]:
    """One row `[[frames]]` of `capture.toml`."""
    pattern = spec.patterns[frame]
    row: dict[str, Any] = {"file": f"{pattern.name}.png", "role": pattern.role}
    if pattern.axis:
        row |= {"axis": pattern.axis, "index": pattern.index}
    if spec.shifts_rad and pattern.role == "sin":
        row["shift_rad"] = pattern.shift_rad
    if pattern.period_mm:
        row["period_mm"] = pattern.period_mm
    row["time_s"] = spec.time_s(frame)
    if spec.laser:
        row["displacement_um"] = reading_um
    return row


@dataclass(frozen=True, slots=True)
class _Exposure:
    """The true exposure of one file: pattern, place of the film, time and factor of the light."""

    pattern: optical_roles.Pattern
    displacement_um: float
    time_s: float
    gain: float = 1.0


def simulate_set(folder: str | Path, spec: SimulationSpec) -> None:
    """Simulate one capture set and write its frames, its description and the truth.

    Parameters
    ----------
    folder : str or Path
        Folder of the set; made if it does not exist.
    spec : SimulationSpec
        Bench, film, disturbances and seed.

    Raises
    ------
    OSError
        The folder or a file cannot be written.
    """
    _write_set(Path(folder), spec, _make_renderer(spec))


def simulate_run(
    folder: str | Path,
    spec: SimulationSpec,
    sets: int,
    interval_s: float = 4.0,
    on_set: Callable[[int], None] | None = None,
) -> None:
    """Write a run of sets: `0000` is the full set, the others are fringes that refer to it.

    All share one clock. The first set's motion continues through the others, its faults do not.

    Parameters
    ----------
    folder : path
        New folder; each set has one in it.
    spec : SimulationSpec
        The first set.
    sets : int
        Number of sets.
    interval_s : float
        From the start of one set to that of the next.
    on_set : callable, optional
        Gets the number of sets written, after each.

    Raises
    ------
    ValueError
        If the first set is not full or lists its displacements, or if the sets overlap in time.
    """
    if spec.kind != "full" or spec.displacements_um:
        raise ValueError(
            "kind: the first set of a run must be full, and move by motion, not displacements_um"
        )
    if sets < 1:
        raise ValueError(f"sets = {sets} must be 1 or more")
    if interval_s < len(spec.patterns) * spec.frame_interval_s:
        raise ValueError(
            f"interval_s = {interval_s:g} is shorter than the {len(spec.patterns)} frames of "
            "the first set"
        )

    # The first set is full; the others are fringes that refer to it.
    spec = _anchor_specification(spec)
    renderer = _make_renderer(spec)
    for number in range(sets):
        spec_of_set = spec
        if number > 0:
            spec_of_set = replace(
                spec,
                kind="fringes",
                reference="../0000",
                start_s=spec.start_s + number * interval_s,
                seed=spec.seed + number,
                faults=(),
            )
        _write_set(Path(folder) / f"{number:04d}", spec_of_set, renderer)
        if on_set is not None:
            on_set(number + 1)


def simulate_track(
    folder: str | Path,
    spec: SimulationSpec,
    frames: int,
    rate_hz: float = 20.0,
    on_frame: Callable[[int], None] | None = None,
) -> None:
    """Write a tracking set: `full`, and `track` with frames of a crossed pattern.

    Both share clock and motion. The first five frames step the pattern. `truth.npz` in `track` has
    `time_s`, `displacement_um`, `sag_um` (frames,) and, if these represent the film, `coeffs_um`
    (frames, ZERNIKE_TERMS), all without the vibrations, `drum_um` (frames, modes): RMS over the
    mirror.

    Parameters
    ----------
    folder : path
        New folder.
    spec : SimulationSpec
        The full set.
    frames : int
        Number of frames of the crossed pattern.
    rate_hz : float
        Frames per second.
    on_frame : callable, optional
        Gets the number of frames written, after each.

    Raises
    ------
    ValueError
        For frames or a rate that are not above 0, and for a specification that is not of a full
        set.
    """
    if spec.kind != "full" or spec.displacements_um or frames < 1 or not rate_hz > 0:
        raise ValueError(
            "track: one frame or more, at a rate above 0, of a film that moves by motion"
        )

    # The reference.
    spec = _anchor_specification(spec)
    renderer = _make_renderer(spec)
    target = Path(folder) / "track"
    _write_set(Path(folder) / "full", spec, renderer)
    target.mkdir(parents=True, exist_ok=True)

    # The frames of the crossed pattern.
    start_s = spec.start_s + len(spec.patterns) * spec.frame_interval_s
    time_s = start_s + np.arange(frames) / rate_hz
    displacement_um = np.array([spec.motion.at_um(float(t)) for t in time_s])
    noise_um = np.random.default_rng(spec.seed + 1).normal(0.0, spec.laser_noise_um, frames)
    rows = []
    for k in range(frames):
        # The first frames step the pattern, x once and y twice around: five steps separate both
        # phases and the mean.
        shift_x_rad = 0.0
        shift_y_rad = 0.0
        if k < _STEPS:
            shift_x_rad = 1 * 2 * np.pi * (k % _STEPS) / _STEPS
            shift_y_rad = 2 * 2 * np.pi * (k % _STEPS) / _STEPS
        pattern = optical_roles.Pattern(
            "crossed", "", _CROSSED_PERIODS, shift_x_rad, shift_y_rad=shift_y_rad
        )

        # Its row of `capture.toml`, and its picture.
        row: dict[str, Any] = {
            "file": f"t_{k:05d}.png",
            "role": "crossed",
            "shift_x_rad": shift_x_rad,
            "shift_y_rad": shift_y_rad,
            "time_s": round(float(time_s[k]), 9),
        }
        if spec.laser:
            row["displacement_um"] = float(displacement_um[k] + noise_um[k])
        at_um = float(displacement_um[k])
        picture = renderer.render_picture(pattern, at_um, time_s=float(time_s[k]))
        _write_png(target / row["file"], picture)
        rows.append(row)
        if on_frame is not None:
            on_frame(k + 1)

    # Their `capture.toml`.
    stated = spec.optics.pattern
    crossed = {
        "periods": _CROSSED_PERIODS,
        "period_mm": stated.periods * stated.period_mm / _CROSSED_PERIODS,
    }
    table: dict[str, Any] = {
        **file_origin("membrane-capture/1"),
        "kind": "track",
        "reference": "../full",
        "pattern": _make_config_table(stated) | {"crossed": crossed},
        "frames": rows,
    }
    (target / "capture.toml").write_bytes(tomli_w.dumps(table).encode())

    # Their truth: sag and displacement without vibrations, which have columns of their own.
    sag_um = np.array([1e3 * spec.film.sag_at_mm(float(d)) for d in displacement_um])
    truth: dict[str, Any] = {"time_s": time_s, "displacement_um": displacement_um, "sag_um": sag_um}
    coeffs = [spec.film.coeffs_um(float(d)) for d in displacement_um]
    if coeffs[0] is not None:
        truth["coeffs_um"] = np.array(coeffs)
    if renderer.modes:
        truth["drum_um"] = np.stack([mode.swing_um(time_s) for mode in renderer.modes], axis=1)
    origin = np.array(describe_origin("membrane-truth/1"))
    np.savez_compressed(target / "truth.npz", origin=origin, **truth)


def _anchor_specification(spec: SimulationSpec) -> SimulationSpec:
    """The specification with an explicit reference displacement of the geometry, common to all sets
    of a run.
    """
    geometry = spec.stated_geometry or spec.optics.geometry
    stated = geometry.model_copy(update={"reference_displacement_um": spec.reference_um})
    return replace(spec, stated_geometry=stated)


class _SeenDirectly(OpticsRenderer):
    """The screen itself before the camera; there is no film."""

    def _trace_film(
        self, directions: FloatArray, displacement_um: float, film: Any = None
    ) -> Trace:
        """The rays meet the screen's plane, and then its face."""
        # In the screen's own frame, with its normal as third axis.
        screen = self._screen_pose
        axes = np.stack([screen.s_x, screen.s_y, np.cross(screen.s_x, screen.s_y)])
        start = axes @ (self._camera_pose.position_mm - screen.origin_mm)
        along = directions @ axes.T
        tangents = along[:, :2].T / along[:, 2]

        # Where a ray crosses the plane, then the face along the ray.
        on_plane_mm = start[:2, None] - start[2] * tangents
        seen_mm = project_onto_face(on_plane_mm, tangents, screen.bow_per_mm, screen.height_map)
        zeros = np.zeros(len(along))
        return Trace(zeros, zeros.copy(), *seen_mm)


def _make_renderer(spec: SimulationSpec) -> OpticsRenderer:
    """The renderer of a specification: of the film, or of the screen itself."""
    kind = OpticsRenderer
    if spec.artefact.get("form") == "screen":
        kind = _SeenDirectly
    return kind(
        spec.optics,
        spec.film,
        spec.light,
        spec.reference_um,
        spec.screen_error,
        exact=spec.exact,
        seed=spec.seed,
        modes=drum_modes(spec.drum_nm),
        front=spec.front,
        disturbances=spec.disturbances,
    )


def _write_set(folder: Path, spec: SimulationSpec, renderer: OpticsRenderer) -> None:
    """Write one set with its faults. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)

    # Laser readings.
    noise = np.random.default_rng(spec.seed).normal(0.0, spec.laser_noise_um, len(spec.patterns))
    readings_um = noise + [spec.displacement_um(frame) for frame in range(len(spec.patterns))]
    faults = {(fault.kind, fault.frame) for fault in spec.faults}

    # The pictures, with the faults of single frames.
    before: optical_roles.Pixels | None = None
    for pattern, exposure in zip(spec.patterns, _list_exposures(spec), strict=True):
        if ("stale", pattern.name) in faults and before is not None:
            picture = before
        else:
            picture = renderer.render_picture(
                exposure.pattern,
                exposure.displacement_um,
                gain=exposure.gain,
                time_s=exposure.time_s,
            )
        before = picture
        if ("wrong_size", pattern.name) in faults:
            picture = picture[:-1]
        if ("wrong_depth", pattern.name) in faults:
            picture = _other_depth(picture)
        if ("missing", pattern.name) not in faults:
            _write_png(folder / f"{pattern.name}.png", picture)

    # The set's file, and the truth beside it.
    write_capture_toml(folder, spec, readings_um)
    write_truth(folder, spec)


def _list_exposures(spec: SimulationSpec) -> list[_Exposure]:
    """The true pattern, film position and exposure time of each frame."""
    # As intended, then changed by the faults in their order.
    exposures = [
        _Exposure(pattern, spec.displacement_um(frame), spec.time_s(frame))
        for frame, pattern in enumerate(spec.patterns)
    ]
    place = {pattern.name: frame for frame, pattern in enumerate(spec.patterns)}
    for fault in spec.faults:
        frame = place[fault.frame]
        this = exposures[frame]
        if fault.kind in ("saturated", "dark", "flicker"):
            exposures[frame] = replace(this, gain=fault.strength)
        elif fault.kind == "moved":
            exposures[frame] = replace(this, displacement_um=this.displacement_um + fault.strength)
        elif fault.kind == "swapped":
            exposures[frame] = exposures[frame + 1]
            exposures[frame + 1] = this
    return exposures


def _other_depth(picture: optical_roles.Pixels) -> optical_roles.Pixels:
    """The picture with the other number of bytes a pixel."""
    if picture.dtype == np.uint8:
        return picture.astype(np.uint16)
    return picture.astype(np.uint8)


def _write_png(path: Path, picture: optical_roles.Pixels) -> None:
    """Write a picture. Raises OSError."""
    if not cv2.imwrite(str(path), picture, _PNG_SPEED):
        raise OSError(f"{path}: cannot be written")
