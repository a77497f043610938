"""Each row of the uncertainty budget against the error that its cause plants in the second world.

A plant is one cause of the size of the row's sigma (or of the size given here, where the set itself
measures the sigma). The stated sigma of the row and the error that the planted cause adds are both
RMS heights over the analysis radius. If no row belongs to a cause, it is compared with the growth
of all rows that a set measures itself. Random causes are planted several times and averaged. If the
row is right, the ratio of the two is about 1.

The sound film does not follow the law of the fit either: another film is compared by the change of
the figure from the sound set to the planted one, as the budget states it for these rows. The part
of the film that no term of the fit represents is no error of its terms and is left out.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.uncertainty.height_map import height_matrix
from tests.studies.second_world_errors import MeasuredSurface, measure_surface
from tests.worlds.second_optics import (
    FRAME_S,
    HAND_SIGMAS,
    PITCH,
    YAW,
    Bench,
    Effects,
    Ghost,
    Material,
    Mirror,
    Panel,
    Sensor,
    Stated,
    World,
    Wrinkles,
    drawn_errors,
)

FloatArray = NDArray[np.float64]

AGREES = 1.5  # ratio of stated sigma and caused error, either way
NEGLIGIBLE_UM = 0.05  # RMS height: stated and caused errors below it agree
ROWS_OF_PIXELS = {"principal_x_mm": "principal_x_px", "principal_y_mm": "principal_y_px"}
# rows that no stated sigma of the bench gives: the set measures them itself
OWN_ROWS = (
    "film_law",
    "film_waves",
    "film_x_to_y_um",
    "film_corrected",
    "film_patches_um",
    "film_seen_um",
    "vertex_um",
    "blur_px",
    "light_relative",
    "film_um",
    "slope_urad",
    "response_waves",
    "noise_adu",
    "image_lag_share",
    "image_lag_noise",
    "moment_um",
    "second_image",
    "phase_drift",
)
FRAMES = 18
MIDDLE_S = 5.5 * FRAME_S  # of the sinusoids of a full set
DISC = 0.95  # analysis radius over the ring's
QUIET = Sensor(bits=16, read_adu=0.5, full_well=0.0)
STILL = Effects(sensor=QUIET, psf_px=0.0, laser_noise_um=0.0)


@dataclass(frozen=True)
class Plant:
    """One cause, and the rows of the budget that should cover it.

    Attributes
    ----------
    rows : tuple of str
        Names in the budget; their variances are added.
    description : str
        The cause with its size.
    errors : mapping
        Errors of the bench, named as in `HAND_SIGMAS`.
    effects : function from a seed
    film : Mirror or None
        Another film than the sound one.
    trials : int
        Of a random cause.
    own_rows : bool
        Whether the planted set itself measures the sigma; else the rows are those of the sound set.
    displacement_um : float
        Of the film from the laser's reference.
    on_drawn_benches : bool
        Whether each trial is on a bench with random errors, of which the sound set has the same:
        for a row that states what errors of the bench make of the cause.
    sigma_share : float
        Stated sigmas of the bench over those of a hand measurement. What a bench known by hand
        hides is larger than a small cause: the fringes must be able to show it.
    """

    rows: tuple[str, ...]
    description: str
    errors: dict[str, float] = field(default_factory=dict)
    effects: Callable[[int], Effects] = lambda _: STILL
    film: Mirror | None = None
    trials: int = 1
    own_rows: bool = True
    displacement_um: float = 0.0
    on_drawn_benches: bool = False
    sigma_share: float = 1.0


@dataclass(frozen=True)
class Comparison:
    """Stated sigma and caused error of one plant, RMS heights in µm."""

    plant: Plant
    stated_um: float
    caused_um: float

    @property
    def ratio(self) -> float:
        """Stated over caused."""
        return self.stated_um / max(self.caused_um, 1e-9)

    @property
    def agrees(self) -> bool:
        """Whether they agree within `AGREES`, or both are negligible."""
        negligible = max(self.stated_um, self.caused_um) < NEGLIGIBLE_UM
        return negligible or 1 / AGREES <= self.ratio <= AGREES


def _walk(seed: int, step_um: float) -> Callable[[float], float]:
    places = step_um * np.random.default_rng((77, seed)).standard_normal(FRAMES)
    return lambda time_s: float(places[min(round(time_s / FRAME_S), FRAMES - 1)])


def _later(step_um: float) -> Callable[[float], float]:
    """The film is deeper in the y frames (from frame 8)."""
    return lambda time_s: step_um * (time_s > 7.5 * FRAME_S)


def _lagging_panel(share: float, seed: int) -> Panel:
    """A slow panel, whose greys follow each other by 1 % more or less than black and white do."""
    return Panel(previous_share=share, between_greys=(1.01, 0.99)[seed])


def _camera_turning(degree: int, turn_rad: float) -> Callable[[int], Effects]:
    """The camera turns steadily during the set, about its stated pose."""
    per_s = np.zeros(6)
    per_s[degree] = turn_rad / (FRAMES * FRAME_S)
    effects = replace(STILL, camera_motion=lambda time_s: per_s * (time_s - MIDDLE_S))
    return lambda _: effects


def _geometry_plants() -> list[Plant]:
    plants = []
    for name, sigma in HAND_SIGMAS.items():
        if name == "laser_relative":
            continue
        row = ROWS_OF_PIXELS.get(name, name)
        plants.append(Plant((row,), f"{name} {sigma:g}", {name: sigma}, own_rows=False))
    return plants


PLANTS = (
    *_geometry_plants(),
    Plant(
        ("vertex_um",),
        "laser's scale 1e-3, 2 mm from the reference",
        effects=lambda _: replace(STILL, laser_scale=1 + HAND_SIGMAS["laser_relative"]),
        displacement_um=2000.0,
    ),
    Plant(
        ("vertex_um", "film_x_to_y_um", "moment_um"),
        "laser's noise 1 µm",
        effects=lambda _: replace(STILL, laser_noise_um=1.0),
        trials=4,
    ),
    Plant(
        ("film_x_to_y_um", "film_patches_um", "film_seen_um", "vertex_um"),
        "film 50 µm deeper in y, no laser",
        effects=lambda _: replace(STILL, laser=False, film_motion_um=_later(50.0)),
    ),
    Plant(
        ("film_x_to_y_um", "film_patches_um", "film_seen_um", "vertex_um"),
        "film 5 µm deeper in y, no laser, bench known to a hundredth",
        effects=lambda _: replace(STILL, laser=False, film_motion_um=_later(5.0)),
        sigma_share=0.01,
    ),
    Plant(
        ("film_corrected", "film_um"),
        "film 50 µm deeper in y, with laser, benches off at random",
        effects=lambda _: replace(STILL, film_motion_um=_later(50.0)),
        trials=4,
        on_drawn_benches=True,
    ),
    Plant(
        ("film_um",),
        "film moves by 1 µm RMS from frame to frame, with laser",
        effects=lambda seed: replace(STILL, film_motion_um=_walk(seed, 1.0)),
        trials=4,
    ),
    Plant(
        ("film_corrected", "film_um"),
        "film moves by 20 µm RMS from frame to frame, with laser, benches off at random",
        effects=lambda seed: replace(STILL, film_motion_um=_walk(seed, 20.0)),
        trials=4,
        on_drawn_benches=True,
    ),
    Plant(
        ("light_relative",),
        "light differs by 5e-4 from frame to frame",
        effects=lambda _: replace(STILL, flicker=5e-4),
        trials=4,
    ),
    Plant(
        ("light_relative",),
        "light differs by 1 % from frame to frame",
        effects=lambda _: replace(STILL, flicker=0.01),
        trials=4,
    ),
    Plant(
        ("light_relative",),
        "ambient light grows by 3 %",
        effects=lambda _: replace(STILL, ambient=0.03),
    ),
    Plant(
        ("noise_adu",),
        "pixel noise of 3 of 255",
        effects=lambda _: replace(STILL, sensor=replace(QUIET, read_adu=3 * 257.0)),
        trials=4,
    ),
    Plant(
        ("blur_px",),
        "blur of 1 px of a quarter",
        effects=lambda _: replace(STILL, psf_px=1.0),
    ),
    Plant(
        ("slope_urad", "response_waves"),
        "gamma 2.2",
        effects=lambda _: replace(STILL, panel=Panel(gamma=2.2)),
    ),
    Plant(
        ("slope_urad", "response_waves"),
        "gamma 1.6, 0.3 more from one side to the other",
        effects=lambda _: replace(STILL, panel=Panel(gamma=1.6, gamma_by_angle=0.3)),
    ),
    Plant(
        ("image_lag_share", "image_lag_noise"),
        "the previous picture is 1 % of a frame, between greys 1 % more or less of that",
        effects=lambda seed: replace(STILL, panel=_lagging_panel(0.01, seed)),
        trials=2,
    ),
    Plant(
        ("image_lag_share", "image_lag_noise"),
        "the previous picture is 5 % of a frame, between greys 1 % more or less of that",
        effects=lambda seed: replace(STILL, panel=_lagging_panel(0.05, seed)),
        trials=2,
    ),
    Plant(
        ("second_image",),
        "second reflection of 1 %, 12 and 5 mm beside the first",
        effects=lambda _: replace(STILL, panel=Panel(ghost=Ghost(0.01))),
    ),
    Plant(
        OWN_ROWS,
        "panel 12 % darker at the mirror's edge",
        effects=lambda _: replace(STILL, panel=Panel(falloff=0.12)),
    ),
    Plant(
        OWN_ROWS,
        "panel of 12 % less contrast at the mirror's edge",
        effects=lambda _: replace(STILL, panel=Panel(contrast_falloff=0.12)),
    ),
    *(
        Plant(
            ("phase_drift",),
            f"camera {name} by 20 µrad during the set",
            effects=_camera_turning(degree, 20e-6),
        )
        for name, degree in (("yaws", YAW), ("pitches", PITCH))
    ),
    Plant(("slope_urad",), "20 spots of dust", effects=lambda _: replace(STILL, dust=20), trials=3),
    Plant(
        ("film_law", "film_waves", "slope_urad"),
        "Poisson ratio 0.42",
        film=Mirror(material=Material(poisson=0.42)),
    ),
    Plant(
        ("film_law", "film_waves", "slope_urad"),
        "pre-strain 5e-4",
        film=Mirror(material=Material(prestrain=(5e-4, 5e-4, 0.0))),
    ),
    Plant(
        ("film_law", "film_waves", "slope_urad"),
        "orthotropic film, E2/E1 0.9",
        film=Mirror(material=Material(ratio=0.9, direction_rad=0.5)),
    ),
    Plant(
        ("film_law", "film_waves", "slope_urad"),
        "wrinkles of 5 µm at the rim",
        film=Mirror(wrinkles=Wrinkles(5.0)),
    ),
)
BY_DESCRIPTION = {plant.description: plant for plant in PLANTS}


def compare(plant: Plant, resolution: float = 0.25) -> Comparison:
    """Measure the sound and the planted bench: stated sigma and caused error."""
    sound, sound_error_mm = _sound(resolution, plant.displacement_um)
    bench = Bench.paper(resolution).changed(plant.errors)
    squares, stated_squares = [], []
    for trial in range(plant.trials):
        mirror = plant.film or SOUND_FILM
        effects = plant.effects(trial)
        if effects.psf_px:
            effects = replace(effects, psf_px=effects.psf_px * 4 * resolution)
        if plant.on_drawn_benches:
            errors = drawn_errors(np.random.default_rng((78, trial)))
            bench = Bench.paper(resolution).changed(errors)
            scale = 1 + errors["laser_relative"]
            effects = replace(effects, laser_scale=scale)
            still = replace(STILL, laser_scale=scale)
            _, sound_error_mm = _measured(mirror, bench, still, trial, plant.displacement_um)
        measured, error_mm = _measured(
            mirror, bench, effects, trial, plant.displacement_um, plant.sigma_share
        )
        squares.append(_mean_square_um2(_take_represented(error_mm - sound_error_mm)))
        if plant.film:
            stated_squares.append(_stated_change_um2(measured, sound, plant.rows))
        else:
            stated = measured if plant.own_rows else sound
            stated_squares.append(_stated_square_um2(stated, plant.rows))
        if plant.rows == OWN_ROWS:
            stated_squares[-1] -= _stated_square_um2(sound, plant.rows)
    stated_um = max(float(np.mean(stated_squares)), 0.0) ** 0.5
    return Comparison(plant, stated_um, float(np.mean(squares)) ** 0.5)


SOUND_FILM = Mirror()


def sound_rows(resolution: float) -> set[str]:
    """Names of all rows that the budget of a sound set has."""
    found, _ = _sound(resolution, 0.0)
    return {row["name"] for row in found.rows}


@cache
def _sound(resolution: float, displacement_um: float) -> tuple[MeasuredSurface, FloatArray]:
    return _measured(SOUND_FILM, Bench.paper(resolution), STILL, 0, displacement_um)


def _measured(
    mirror: Mirror,
    bench: Bench,
    effects: Effects,
    seed: int,
    displacement_um: float,
    sigma_share: float = 1.0,
) -> tuple[MeasuredSurface, FloatArray]:
    """The measured surface, and its height less the true one at points of the disc, in mm."""
    with tempfile.TemporaryDirectory() as folder:
        world = World(mirror, bench, effects, Stated(sigma_share=sigma_share), seed)
        truth = world.write_set(Path(folder), displacement_um)
        found = measure_surface(Path(folder))
    x_mm, y_mm = _points_mm()
    heights_mm = height_matrix(x_mm, y_mm, mirror.radius_mm) @ found.parameters_mm
    smooth = mirror.without_wrinkles()
    return found, heights_mm - smooth.height_mm(x_mm, y_mm, truth.displacement_um)


@cache
def _points_mm() -> tuple[FloatArray, FloatArray]:
    """Points spread evenly over the analysis radius."""
    rank = np.arange(400) + 0.5
    radius_mm = 500 * DISC * np.sqrt(rank / rank.size)
    angle = np.pi * (1 + 5**0.5) * rank
    return radius_mm * np.cos(angle), radius_mm * np.sin(angle)


def _take_represented(height_mm: FloatArray) -> FloatArray:
    """The part of heights at the points of the disc that the fit's parameters represent."""
    matrix = height_matrix(*_points_mm(), 500.0)
    return np.asarray(matrix @ np.linalg.lstsq(matrix, height_mm, rcond=None)[0])


def _mean_square_um2(height_mm: FloatArray) -> float:
    return float(np.mean((1e3 * height_mm) ** 2))


def _stated_square_um2(found: MeasuredSurface, rows: tuple[str, ...]) -> float:
    sizes = [row["height_rms_um"] for row in found.rows if row["name"] in rows]
    return float(np.sum(np.square(sizes)))


def _stated_change_um2(
    found: MeasuredSurface, earlier: MeasuredSurface, rows: tuple[str, ...]
) -> float:
    """Mean square of the change since another set by some rows."""
    before = {source.name: source for source in earlier.budget.sources}
    squares_um2 = 0.0
    for source in found.budget.sources:
        if source.name not in rows:
            continue
        for effects_mm in source.list_change_effects(before.get(source.name)):
            sizes = found.budget.compute_sigmas_um(effects_mm @ effects_mm.T)
            squares_um2 += sizes["height_rms_um"] ** 2
    return squares_um2
