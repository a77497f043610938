"""Random benches rendered by a path tracer and measured; and the renderer's own error."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.studies.resumable_answers import answers
from tests.studies.second_world_errors import drawn_points_mm, measured_errors
from tests.worlds.path_traced.meshes import sphere_surface
from tests.worlds.path_traced.panel_texture import SIDE_MM
from tests.worlds.path_traced.ramp import ramp_places_mm, ramp_texture
from tests.worlds.path_traced.scene import (
    FrontFilm,
    RenderedBench,
    RenderSettings,
    render_surface,
)
from tests.worlds.path_traced.sets import AddedLight, write_rendered_set
from tests.worlds.second_optics import Bench, Stated, World, drawn_errors, drawn_mirror
from tests.worlds.second_optics.patterns import PERIOD_MM

FloatArray = NDArray[np.float64]

ANSWERS = Path("logs/path_traced.jsonl")
RENDERED = Path("logs/path_traced")  # rendered sets, measured again without rendering
PAGE = Path("docs/measurements/path-traced.md")
RESOLUTION = 0.125
SAMPLES = 36
SAMPLES_BEHIND_FILM = 100  # a path passes or is reflected by chance
FINE_SIGMAS = 0.01
POINTS = 10
PARTS = {"sag": slice(0, 1), "Z4 to Z11": slice(1, 9), "map at 10 points": slice(9, None)}
TWO_SIDED_95 = 1.96
SPHERE_MM = 3400.0
BLOCK_PX = 16
PAGE_TEXT = """\
# Sets rendered by a path tracer

[Mitsuba 3](https://mitsuba.readthedocs.io) renders the paper's bench from triangles: mirror, ring,
panel with its pixels, lens of finite aperture, a lit room and, in every fourth bench, the front
film with all its reflections and the gas behind it. Only the scene is this project's
(`tests/worlds/path_traced`); the film's shape is that of the second optical world (finite strains,
orthotropic). Made by `python -m benchmarks.metrology.path_traced campaign`, which needs the extra
`render`.

## The renderer's own error

Mitsuba's variants are in single precision. A sphere, against its closed form in double precision:
{renderer}.

## {benches} random benches, two sets each

306 x 256 pixels, {samples} paths a pixel ({samples_behind_film} behind a front film). Geometry as
drawn from its stated sigmas: those of a hand measurement, or (every second bench) a hundredth of
them. Verdicts of the first sets: {verdicts}.

| quantity | benches | inside 95 % | bar over scatter | number |
|---|---|---|---|---|
"""
DEPARTURES_TEXT = """
## Departures

Of {count} values {outside} are outside their 95 % intervals; by chance, {expected:.0f} would be.
The goal, 93 to 97 % inside, is missed because the bars are too wide, not too narrow. They contain
effects that these sets do not have: a bench that moved by less than a set can detect (two thirds
of the variance of a change of the map in bench 1), drift of the phases, motion of the film from the
x to the y frames (no laser is stated), a share of the previous picture, and a film whose law
differs from the fitted terms. Single figures of benches measured by hand have the bars of the
geometry.

The change of the figure (Z4 to Z11) is within {limit_nm:.0f} nm RMS in {within} of {benches}
benches. {wide}

Each value outside, in µm:

| bench | value | error | 1 sigma | error / sigma |
|---|---|---|---|---|
"""
WIDE_TEXT = """The others have the geometry of a hand measurement, whose errors scale a change of
sag: {wide}."""
CHANGE_LIMIT_UM = 0.03
# drawn errors that the rendered camera and screen do not have
NOT_RENDERED = ("principal", "k1", "k2", "p1", "p2", "bow", "glass", "air")


@dataclass(frozen=True)
class RendererError:
    """Rendered less true places on the screen, of a spherical mirror, in µm.

    Attributes
    ----------
    mean_um, blocks_um : float
        Mean over all pixels of both axes, and RMS of the means of blocks of 16 x 16 pixels.
    typical_um : float
        Of a single pixel: the median of the absolute error.
    lost_fraction : float
        Pixels that lost at least one of their paths between two triangles.
    """

    mean_um: float
    blocks_um: float
    typical_um: float
    lost_fraction: float

    def sentence(self) -> str:
        """The figures in words."""
        mrad = 2 * np.pi * self.blocks_um / (1e3 * PERIOD_MM) * 1e3
        return (
            f"rendered sphere: {self.mean_um:.2f} µm off on the screen in the mean, "
            f"{self.blocks_um:.2f} µm RMS over blocks of {BLOCK_PX} x {BLOCK_PX} pixels "
            f"({mrad:.2f} mrad of phase), {self.typical_um:.1f} µm a pixel; "
            f"{100 * self.lost_fraction:.3f} % of the pixels lost a path"
        )


def renderer_error(samples: int = SAMPLES, variant: str = "scalar_rgb") -> RendererError:
    """Render a sphere in the paper's bench and compare it with its closed form.

    Raises ImportError without Mitsuba.
    """
    bench = RenderedBench(bench=Bench.paper(RESOLUTION), room=0.0, aperture_mm=0.0)
    surface = sphere_surface(SPHERE_MM, bench.mirror.radius_mm)
    settings = RenderSettings(samples=samples, variant=variant)
    (image,) = render_surface(bench, surface, [ramp_texture()], settings)
    true_mm, inside = sphere_places_mm(bench.bench, bench.mirror.radius_mm)
    off_um = 1e3 * (ramp_places_mm(image) - true_mm)
    whole = np.abs(image[:, :, 2] - np.median(image[inside, 2])) < 1e-3
    good = inside & whole
    blocks = _block_means(np.where(good, off_um, np.nan))
    return RendererError(
        mean_um=float(np.abs(off_um[:, good].mean(axis=1)).max()),
        blocks_um=float(np.sqrt(np.nanmean(blocks**2))),
        typical_um=float(np.median(np.abs(off_um[:, good]))),
        lost_fraction=float(1 - whole[inside].mean()),
    )


def sphere_places_mm(bench: Bench, radius_mm: float) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Places (2, rows, columns) on the screen by the law of reflection at the sphere.

    The second array marks pixels on the mirror, 5 % away from its edge, that see the pattern.
    """
    width_px, height_px = bench.size_px
    column, row = np.meshgrid(np.arange(width_px, dtype=float), np.arange(height_px, dtype=float))
    ray = bench.directions(column.ravel(), row.ravel())
    centre = np.array([[0.0], [0.0], [SPHERE_MM]])
    from_centre = bench.camera.place_mm[:, None] - centre
    # |from_centre + t ray| = R: the far intersection is the bowl
    along = np.sum(from_centre * ray, axis=0)
    path = -along + np.sqrt(along**2 - np.sum(from_centre**2, axis=0) + SPHERE_MM**2)
    place = bench.camera.place_mm[:, None] + path * ray
    normal = (centre - place) / SPHERE_MM
    leaving = ray - 2 * np.sum(ray * normal, axis=0) * normal
    from_screen = bench.screen.axes @ (place - bench.screen.place_mm[:, None])
    outwards = bench.screen.axes @ leaving
    on_screen = from_screen - from_screen[2] / outwards[2] * outwards
    shape = (height_px, width_px)
    places = on_screen[:2].reshape(2, *shape)
    on_mirror = np.hypot(place[0], place[1]).reshape(shape) < 0.95 * radius_mm
    in_pattern = np.abs(places).max(axis=0) < 0.95 * SIDE_MM / 2
    return places, on_mirror & in_pattern


def _block_means(values: FloatArray) -> FloatArray:
    """Means of whole blocks (2, rows, columns) that are complete, NaN elsewhere."""
    axes, height, width = values.shape
    rows, columns = height // BLOCK_PX, width // BLOCK_PX
    cut = values[:, : rows * BLOCK_PX, : columns * BLOCK_PX]
    return np.asarray(cut.reshape(axes, rows, BLOCK_PX, columns, BLOCK_PX).mean(axis=(2, 4)))


def draw_bench(seed: int) -> tuple[RenderedBench, AddedLight, Stated, dict[str, float]]:
    """A random bench, what is added to its light, what is stated of it, and what was planted."""
    rng = np.random.default_rng((5011, seed))
    fine = bool(seed % 2)
    share = FINE_SIGMAS if fine else 1.0
    errors = drawn_errors(rng, share)
    errors = {n: 0.0 if n.startswith(NOT_RENDERED) else off for n, off in errors.items()}
    orthotropic = bool(rng.random() < 0.5)
    mirror = drawn_mirror(rng, orthotropic, sag_mm=float(rng.uniform(34.0, 38.0)))
    aperture_mm = float(rng.uniform(0.5, 2.0))
    room = float(rng.uniform(0.0, 0.03))
    behind_film = seed % 4 == 3
    bench = RenderedBench(
        mirror,
        Bench.paper(RESOLUTION).changed(errors),
        FrontFilm() if behind_film else None,
        room,
        aperture_mm,
    )
    added = AddedLight(
        falloff=float(rng.uniform(0.0, 0.12)), glare_share=float(rng.uniform(0.0, 0.02))
    )
    planted = {
        "orthotropic": float(orthotropic),
        "front film": float(behind_film),
        "lens aperture, mm": aperture_mm,
        "room light": room,
        "panel falls off": added.falloff,
        "veiling glare": added.glare_share,
    }
    return bench, added, Stated(sigma_share=share), planted


def draw_displacements_um(seed: int) -> tuple[float, float]:
    """Displacements of the film in the two sets of a bench, in µm."""
    first_um, second_um = np.random.default_rng((5012, seed)).uniform(-50.0, 50.0, 2).tolist()
    return first_um, second_um


def render_sets(seed: int, variant: str) -> list[tuple[Path, float]]:
    """Folders of the two sets of a bench and their displacements in µm; missing ones are rendered.

    Raises ImportError without Mitsuba.
    """
    bench, added, stated, _ = draw_bench(seed)
    displacements_um = draw_displacements_um(seed)
    samples = SAMPLES if bench.front is None else SAMPLES_BEHIND_FILM
    settings = RenderSettings(samples=samples, seed=seed, variant=variant)
    sets = []
    for k, displacement_um in enumerate(displacements_um):
        folder = RENDERED / f"bench{seed}" / f"set{k}"
        if not (folder / "capture.toml").exists():  # written last
            noise_seed = 2 * seed + k
            write_rendered_set(bench, folder, settings, noise_seed, displacement_um, stated, added)
        sets.append((folder, displacement_um))
    return sets


def bench_answer(seed: int, variant: str) -> dict[str, Any]:
    """Render and measure two sets of a bench: errors and sigmas of the first and of the change."""
    bench, _, _, planted = draw_bench(seed)
    points_mm = drawn_points_mm(np.random.default_rng((5013, seed)), POINTS)
    answer: dict[str, Any] = {"seed": seed, "fine": bool(seed % 2), "planted": planted, "sets": []}
    found = []
    for folder, displacement_um in render_sets(seed, variant):
        truth = World(bench.mirror, bench.bench).truth([0], np.array([displacement_um]))
        one = measured_errors(folder, bench.mirror, truth, points_mm)
        found.append(one)
        row: dict[str, Any] = {"verdict": one.verdict, "reason": one.reason}
        if one.error_um is not None and one.sigma_um is not None:
            row |= {"error_um": one.error_um.tolist(), "sigma_um": one.sigma_um.tolist()}
        answer["sets"].append(row)
    first, second = found
    if first.error_um is not None and second.error_um is not None:
        change_um = second.error_um - first.error_um
        answer["change"] = {
            "error_um": change_um.tolist(),
            "sigma_um": second.change_sigma_um(first).tolist(),
        }
    return answer


def coverage(given: list[dict[str, Any]], part: slice, change: bool) -> tuple[float, float, int]:
    """Share inside the 95 % interval, width of the bar over the scatter, and the count."""
    ratios = []
    for one in given:
        row = one.get("change") if change else one["sets"][0]
        if row and "error_um" in row:
            error, sigma = np.array(row["error_um"][part]), np.array(row["sigma_um"][part])
            ratios += (error / sigma).tolist()
    values = np.abs(np.array(ratios))
    if not len(values):
        return float("nan"), float("nan"), 0
    rms = float(np.sqrt(np.mean(values**2)))
    return float(np.mean(values < TWO_SIDED_95)), 1 / rms, len(values)


def write_campaign_page(count: int, variant: str) -> None:
    """Render and measure the missing benches and write the page of all."""
    given = answers(ANSWERS, count, partial(bench_answer, variant=variant))
    PAGE.write_text(page(given, renderer_error(variant=variant)), encoding="utf-8")


def page(given: list[dict[str, Any]], renderer: RendererError) -> str:
    """The page of measurements."""
    verdicts = [one["sets"][0]["verdict"] for one in given]
    counted = ", ".join(f"{verdicts.count(v)} `{v}`" for v in sorted(set(verdicts)))
    text = PAGE_TEXT.format(
        renderer=renderer.sentence(),
        benches=len(given),
        samples=SAMPLES,
        samples_behind_film=SAMPLES_BEHIND_FILM,
        verdicts=counted,
    )
    lines = text.splitlines()
    groups = {
        "geometry by hand": [one for one in given if not one["fine"]],
        "a hundredth": [one for one in given if one["fine"]],
    }
    for change in (False, True):
        for quantity, part in PARTS.items():
            for group, some in groups.items():
                share, width, number = coverage(some, part, change)
                name = f"change of {quantity}" if change else quantity
                lines.append(f"| {name} | {group} | {100 * share:.0f} % | {width:.2f} | {number} |")
    lines += departure_lines(given)
    lines += ["", "## Each bench", "", "Errors in µm; the worst in its own sigmas.", ""]
    lines += [
        "| bench | planted | verdict | sag | worst | change: Z4 to Z11, RMS | worst |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [_bench_row(one) for one in given]
    return "\n".join(lines) + "\n"


def departure_lines(given: list[dict[str, Any]]) -> list[str]:
    """What departs from the goals, and why."""
    names = ["sag", *(f"Z{j}" for j in range(4, 12))]
    names += [f"map, point {k}" for k in range(1, POINTS + 1)]
    rows: list[str] = []
    count = 0
    wide: list[str] = []
    for one in given:
        for prefix, found in (("", one["sets"][0]), ("change of ", one.get("change"))):
            if not found or "error_um" not in found:
                continue
            errors_um, sigmas_um = np.array(found["error_um"]), np.array(found["sigma_um"])
            ratios = errors_um / sigmas_um
            count += ratios.size
            rows += [
                f"| {one['seed']} | {prefix}{names[k]} | {errors_um[k]:.3f} "
                f"| {sigmas_um[k]:.3f} | {ratios[k]:.2f} |"
                for k in np.flatnonzero(np.abs(ratios) > TWO_SIDED_95).tolist()
            ]
        if change_rms_um(one) > CHANGE_LIMIT_UM:
            first_um, second_um = draw_displacements_um(one["seed"])
            wide.append(
                f"bench {one['seed']} {1e3 * change_rms_um(one):.0f} nm "
                f"(sag changed by {second_um - first_um:.0f} µm)"
            )
    text = DEPARTURES_TEXT.format(
        count=count,
        outside=len(rows),
        expected=0.05 * count,
        limit_nm=1e3 * CHANGE_LIMIT_UM,
        within=len(given) - len(wide),
        benches=len(given),
        wide=WIDE_TEXT.format(wide=", ".join(wide)) if wide else "",
    )
    return text.rstrip("\n").splitlines() + rows


def change_rms_um(one: dict[str, Any]) -> float:
    """RMS error of the change of Z4 to Z11 of a bench; NaN without one."""
    if "change" not in one:
        return float("nan")
    terms_um = np.array(one["change"]["error_um"][PARTS["Z4 to Z11"]])
    return float(np.sqrt(np.mean(terms_um**2)))


def _bench_row(one: dict[str, Any]) -> str:
    names = [
        name if name in ("orthotropic", "front film") else f"{name} {size:.3g}"
        for name, size in one["planted"].items()
        if size
    ]
    first = one["sets"][0]
    cells = [str(one["seed"]), ", ".join(names), first["verdict"]]
    if "error_um" in first:
        error, sigma = np.array(first["error_um"]), np.array(first["sigma_um"])
        cells += [f"{error[0]:.2f} ± {sigma[0]:.2f}", f"{np.abs(error / sigma).max():.1f}"]
    else:
        cells += ["", ""]
    if "change" in one:
        error, sigma = np.array(one["change"]["error_um"]), np.array(one["change"]["sigma_um"])
        cells += [f"{change_rms_um(one):.3f}", f"{np.abs(error / sigma).max():.1f}"]
    else:
        cells += ["", ""]
    return "| " + " | ".join(cells) + " |"
