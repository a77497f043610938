"""The `simulate` command: capture sets with known truth, from the twin's optics."""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from membrane_ctrl.config import sight
from membrane_ctrl.config.front_film import FrontFilmConfig
from membrane_ctrl.config.optics import ScreenPoseConfig
from membrane_ctrl.config.schema import CameraConfig, Config, OpticsConfig
from membrane_ctrl.geometry.file import read_geometry
from membrane_ctrl.geometry.set_tables import move_screen
from membrane_ctrl.model import errors, terminal
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.optics import film_shape, pattern_levels, simulate, simulation_spec
from membrane_ctrl.sim.optics.front_film import make_front_film
from membrane_ctrl.sim.optics.turned_film import MirrorSeat, turn_film

_USED = 0.95  # of the artefact's radius, as of the mirror's
_LEANS = 2e-3  # a hand puts it down to some tenths of a millimetre
_RADIUS_KNOWN, _VERTEX_KNOWN_MM, _FORM_KNOWN_UM = 1e-4, 0.05, 0.05  # what the file states
_SHIFT_KNOWN_MM, _TURN_KNOWN_DEG = 0.05, 0.5  # of a screen on a rail
_TILTED_RAD = np.radians(25.0)


@dataclass(frozen=True)
class SimulateOptions:
    """Options of the command; quantities as in `SimulationSpec`."""

    folder: Path
    config: Config
    sag_mm: float
    figure: bool
    steps: int | None
    bits: int | None
    noise_adu: float | None
    shrink: int
    gamma: float
    motion: simulation_spec.Motion
    laser_noise_um: float
    stated: Path | None
    exact: bool
    seed: int
    faults: tuple[str, ...]
    sets: int
    interval_s: float
    coarser_mm: tuple[float, ...] = ()
    artefact: str = ""  # "flat:RADIUS", "sphere:CURVATURE:RADIUS" or "screen:DISTANCE", mm
    screen_moved_mm: float = 0.0  # towards the mirror
    turned_deg: float | None = None  # angle of a mirror that was turned about its axis
    front_film: bool = False  # the paper's clear film, if the configuration has none
    unstated_front_film: bool = False  # a front film that the set does not mention
    track: int = 0  # frames of a tracking set
    rate_hz: float = 20.0


def simulate_command(options: SimulateOptions) -> int:
    """Write a set, or a run of sets. Raises InputError."""
    if options.folder.exists() and any(options.folder.iterdir()):
        raise errors.InputError(
            f"{options.folder}: is not empty; simulate needs a new or empty folder"
        )
    try:
        # One track, one set, or a run of sets.
        spec = make_specification(options)
        with errors.convert_write_errors(options.folder):
            if options.track:
                simulate.simulate_track(
                    options.folder,
                    spec,
                    options.track,
                    options.rate_hz,
                    _make_progress_counter(options.track),
                )
            elif options.sets == 1:
                simulate.simulate_set(options.folder, spec)
            else:
                simulate.simulate_run(
                    options.folder,
                    spec,
                    options.sets,
                    options.interval_s,
                    _make_progress_counter(options.sets),
                )
    except ValueError as error:
        raise errors.InputError(f"simulate: {error}") from None
    written = (
        f"{options.track} frames and their reference" if options.track else f"{options.sets} set(s)"
    )
    print(f"{written} written to {options.folder}", file=sys.stderr)
    return 0


def make_specification(options: SimulateOptions) -> simulation_spec.SimulationSpec:
    """The set described by the options. Raises ValueError naming an impossible one."""
    optics = _adjust_optics(options)
    single = options.artefact or options.screen_moved_mm or options.turned_deg is not None
    if single and (options.sets > 1 or options.track):
        raise ValueError("--artefact, --screen-moved-mm, --turned-deg: one set, for `calibrate`")
    if options.turned_deg is not None and (options.artefact or options.screen_moved_mm):
        raise ValueError("--turned-deg: of the film, with the screen in its place")
    if options.artefact.startswith("screen:"):
        return _of_screen(options, optics)
    if options.artefact:
        return _of_artefact(options, optics)
    if options.screen_moved_mm:
        return _with_screen_moved(options, optics)
    return _of_film(options, optics)


def _of_film(options: SimulateOptions, optics: OpticsConfig) -> simulation_spec.SimulationSpec:
    """A set of the film, or the first of a run."""
    radius_mm = optics.mirror.radius_mm
    twin = options.config.twin
    mounted = film_shape.typical_film(
        options.sag_mm, radius_mm, options.seed, twin.film_prestrain, twin.film_poisson
    )
    shape = mounted
    if not options.figure:
        shape = replace(mounted, zernike_um=())
    seat = None
    stated_turn = {}
    if options.turned_deg is not None:
        # the film is that of --seed; its seat differs from angle to angle
        seat = MirrorSeat.drawn(options.turned_deg, options.seed + round(1e3 * options.turned_deg))
        shape = turn_film(shape, seat, options.motion.start_um)
        stated_turn = {"angle_deg": options.turned_deg}
    seed = None
    if options.figure:
        seed = options.seed
    stated_mirror = None
    if options.unstated_front_film:
        stated_mirror = optics.mirror.model_copy(update={"front_film": None})
    return replace(
        _make_rest_specification(options, optics, shape),
        front=make_front_film(optics.mirror, options.sag_mm, seed),
        stated_mirror=stated_mirror,
        mirror_turned=stated_turn,
        seat=seat,
        stiffness_n_per_m=twin.film_stiffness_n_per_m,
        disturbances=twin.disturbances,
        drum_nm=twin.drum_nm,
        motion=options.motion,
        laser_noise_um=options.laser_noise_um,
    )


def _make_rest_specification(
    options: SimulateOptions, optics: OpticsConfig, shape: film_shape.FilmShape
) -> simulation_spec.SimulationSpec:
    """A set of a surface at rest."""
    return simulation_spec.SimulationSpec(
        optics,
        shape,
        kind="frequencies" if options.coarser_mm else "full",
        coarser_mm=options.coarser_mm,
        stated_geometry=None if options.stated is None else read_geometry(options.stated).geometry,
        light=pattern_levels.Light(gamma=options.gamma),
        exact=options.exact,
        seed=options.seed,
        faults=tuple(simulation_spec.FrameFault.parse(text) for text in options.faults),
    )


def _of_artefact(options: SimulateOptions, optics: OpticsConfig) -> simulation_spec.SimulationSpec:
    """A set of a flat or a sphere in the mirror's place, put there by hand, so that it leans.

    Raises ValueError for a text that names none, and for a run of sets.
    """
    # Form and sizes as the option states them.
    form, *sizes = options.artefact.split(":")
    try:
        curvature_mm, radius_mm = [math.inf, *map(float, sizes)][-2:]
    except ValueError:
        raise ValueError(f"--artefact {options.artefact}: sizes are numbers, mm") from None
    if len(sizes) != {"flat": 1, "sphere": 2}.get(form) or not 0 < radius_mm < curvature_mm:
        raise ValueError(
            f"--artefact {options.artefact}: flat:RADIUS or sphere:CURVATURE_RADIUS:RADIUS, mm"
        )

    # What the set's file states of it.
    table: dict[str, str | float] = {
        "form": form,
        "vertex_sigma_mm": _VERTEX_KNOWN_MM,
        "form_sigma_um": _FORM_KNOWN_UM,
    }
    if form == "sphere":
        table |= {
            "curvature_radius_mm": curvature_mm,
            "curvature_radius_sigma_mm": _RADIUS_KNOWN * curvature_mm,
        }

    # The artefact itself, leaning as a hand leaves it.
    lean_x, lean_y = np.random.default_rng(options.seed).uniform(-_LEANS, _LEANS, 2).tolist()
    shape = simulation_spec.make_artefact_shape(curvature_mm, radius_mm, lean_x, lean_y)
    mirror = type(optics.mirror)(radius_mm=radius_mm, analysis_radius_mm=_USED * radius_mm)
    spec = _make_rest_specification(options, optics.model_copy(update={"mirror": mirror}), shape)
    return replace(spec, artefact=table, laser=False)


def _with_screen_moved(
    options: SimulateOptions, optics: OpticsConfig
) -> simulation_spec.SimulationSpec:
    """The film with the screen elsewhere than stated, which is known as the file states it."""
    shift_mm = np.array([0.0, 0.0, options.screen_moved_mm])
    table = {
        "shift_mm": shift_mm.tolist(),
        "shift_sigma_mm": _SHIFT_KNOWN_MM,
        "turn_sigma_deg": _TURN_KNOWN_DEG,
    }
    # one move of one bench, whatever the set's own seed
    rng = np.random.default_rng(int(abs(options.screen_moved_mm)))
    rail, turn = (
        _rotation_matrix(np.radians(_TURN_KNOWN_DEG) * rng.normal(size=3)) for _ in range(2)
    )
    x, y, z = rail @ shift_mm + _SHIFT_KNOWN_MM * rng.normal(size=3)
    there = move_screen(optics.geometry, (x, y, z), turn)
    spec = _of_film(options, optics.model_copy(update={"geometry": there}))
    return replace(
        spec, screen_moved=table, stated_geometry=spec.stated_geometry or optics.geometry
    )


def _of_screen(options: SimulateOptions, optics: OpticsConfig) -> simulation_spec.SimulationSpec:
    """The screen itself before the camera, tilted to any side.
    Raises ValueError for another text.
    """
    try:
        distance_mm = float(options.artefact.removeprefix("screen:"))
    except ValueError:
        raise ValueError(f"--artefact {options.artefact}: screen:DISTANCE, mm") from None
    # Rolled about the camera's axis, and tilted towards a side.
    pinhole, (right, down, forward), *_ = sight.compute_poses(optics.geometry)
    side, roll = np.random.default_rng(options.seed).uniform(0, 2 * math.pi, 2)
    tilt_axis = math.cos(side) * right + math.sin(side) * down
    turn = _rotation_matrix(_TILTED_RAD * tilt_axis) @ _rotation_matrix(roll * forward)
    pose = {
        "origin_mm": pinhole + distance_mm * forward,
        "s_x": turn @ right,
        "s_y": -turn @ down,
    }
    stated_screen = optics.geometry.screen or ScreenPoseConfig()
    screen = stated_screen.model_copy(
        update={name: tuple(value.tolist()) for name, value in pose.items()}
    )

    # The bench with that screen, and a flat that is not seen.
    there = move_screen(optics.geometry, (0.0, 0.0, 0.0)).model_copy(update={"screen": screen})
    shape = simulation_spec.make_artefact_shape(math.inf, optics.mirror.radius_mm, 0.0, 0.0)
    spec = _make_rest_specification(options, optics.model_copy(update={"geometry": there}), shape)
    stated = spec.stated_geometry or optics.geometry
    return replace(spec, artefact={"form": "screen"}, laser=False, stated_geometry=stated)


def _rotation_matrix(vector: FloatArray) -> FloatArray:
    """Matrix (3, 3) of a turn about a vector by its length."""
    return np.asarray(cv2.Rodrigues(vector)[0], np.float64)


def _adjust_optics(options: SimulateOptions) -> OpticsConfig:
    """The configuration's optics with the depth, noise, steps and size from the options."""
    optics = options.config.optics
    pattern = optics.pattern
    camera = shrink_camera(optics.camera, options.shrink)
    changes: dict[str, object] = {}
    if options.bits is not None:
        changes["bits"] = options.bits
    if options.noise_adu is not None:
        changes["noise_adu"] = options.noise_adu
    steps = {}
    if options.steps is not None:
        steps = {"steps": options.steps}
    mirror = optics.mirror
    asked = options.front_film or options.unstated_front_film
    if asked and mirror.front_film is None:
        mirror = mirror.model_copy(update={"front_film": FrontFilmConfig()})
    return OpticsConfig(
        geometry=optics.geometry,
        camera=type(camera)(**{**camera.model_dump(exclude_none=True), **changes}),
        pattern=type(pattern)(**{**pattern.model_dump(), **steps}),
        mirror=mirror,
    )


def _make_progress_counter(total: int) -> Callable[[int], None] | None:
    """Count sets, or frames, in one line, on a terminal only."""
    if not sys.stderr.isatty():
        return None
    return lambda done: terminal.live_line(f"{done} of {total}", "" if done < total else "\n")


def shrink_camera(camera: CameraConfig, shrink: int) -> CameraConfig:
    """Return a camera of the same field with fewer, larger pixels.

    Parameters
    ----------
    camera : CameraConfig
        The camera.
    shrink : int
        How many times larger the pixels are.
    """
    column, row = camera.principal
    # pixel centres are integers: the middle of the first large pixel is (shrink - 1) / 2
    first = (shrink - 1) / 2
    return camera.model_copy(
        update={
            "width_px": camera.width_px // shrink,
            "height_px": camera.height_px // shrink,
            "pixel_um": camera.pixel_um * shrink,
            "principal_px": ((column - first) / shrink, (row - first) / shrink),
        }
    )
