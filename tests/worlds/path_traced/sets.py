"""Rendered light as the frames of a capture set, with its truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tests.worlds.path_traced.offset_compensation import compensated_film
from tests.worlds.path_traced.panel_texture import panel_texture
from tests.worlds.path_traced.scene import (
    COLOURS,
    RenderedBench,
    RenderSettings,
    render_surface,
)
from tests.worlds.second_optics import FRAME_S, Effects, Stated, Truth, World, patterns
from tests.worlds.second_optics.effects import Sensor
from tests.worlds.second_optics.rays import trace
from tests.worlds.second_optics.sensor import count, store
from tests.worlds.second_optics.world import DARK, EDGE_TILT, NOMINAL_WHITE, VIGNETTING, write_files

FloatArray = NDArray[np.float64]

RENDERED_THICKNESS_UM = 0.01  # the rendered front film is a sheet without thickness
GLARE_SHARE = 0.01  # of the light, spread over the picture by the lens
GLARE_SPREAD = 0.12  # sigma, of the picture's width
WHITE_PERCENTILE = 90  # of the pixels under a white screen: what the exposure is set to


@dataclass(frozen=True)
class AddedLight:
    """What is done to the rendered light before it is counted.

    Attributes
    ----------
    falloff : float
        Light that the panel loses at the viewing angle of the mirror's edge.
    glare_share : float
        Light that the lens spreads over the picture.
    """

    falloff: float = 0.0
    glare_share: float = GLARE_SHARE
    sensor: Sensor = field(default_factory=Sensor)


def write_rendered_set(
    bench: RenderedBench,
    folder: Path,
    settings: RenderSettings,
    seed: int,
    displacement_um: float = 0.0,
    stated: Stated | None = None,
    added: AddedLight | None = None,
) -> Truth:
    """Render a full set of 18 frames, write it, and return its truth.

    The film rests during the set; a front film is stated. Raises ImportError without Mitsuba.
    """
    added = added or AddedLight()
    pictures = patterns.full_set()
    # three pictures a rendering, as its three colours
    groups = [pictures[k : k + COLOURS] for k in range(0, len(pictures), COLOURS)]
    textures = [panel_texture(group) for group in groups]
    mirror = compensated_film(bench, displacement_um, settings)
    images = render_surface(bench, mirror, textures, settings)
    lights = [image[:, :, colour] for image in images for colour in range(COLOURS)]

    rng = np.random.default_rng((5003, seed))
    share_of_light = _viewing_loss(bench, displacement_um, added.falloff) * _vignetting(bench)
    white = lights[[picture.role for picture in pictures].index("white")]
    exposure = 1 / np.percentile(white, WHITE_PERCENTILE)
    frames = []
    for light in lights:
        seen = exposure * _with_glare(light, added.glare_share) * share_of_light
        frames.append(
            store(count(DARK + (NOMINAL_WHITE - DARK) * seen, added.sensor, rng), added.sensor)
        )

    world = World(
        bench.mirror, bench.bench, Effects(sensor=added.sensor), stated or Stated(sigma_share=0.01)
    )
    rows = []
    for k, picture in enumerate(pictures):
        row: dict[str, object] = {"file": f"{picture.name}.png", "role": picture.role}
        if picture.axis:
            row["axis"] = picture.axis
        row |= {"index": picture.index, "time_s": FRAME_S * k, "displacement_um": displacement_um}
        rows.append(row)
    table = world.stated_table()
    if bench.front is not None:
        table["mirror"]["front_film"] = {
            "bulge_mm": bench.front.sag_mm,
            "thickness_um": RENDERED_THICKNESS_UM,
        }
    names = [f"{picture.name}.png" for picture in pictures]
    write_files(folder, table | {"frames": rows}, names, frames)
    sinusoids = [k for k, picture in enumerate(pictures) if picture.role == "sin"]
    return world.truth(sinusoids, np.full(len(pictures), displacement_um))


def _viewing_loss(bench: RenderedBench, displacement_um: float, falloff: float) -> FloatArray:
    """Light of the panel (rows, columns) by the square of the viewing angle's tangent."""
    width_px, height_px = bench.bench.size_px
    column, row = np.meshgrid(np.arange(width_px, dtype=float), np.arange(height_px, dtype=float))
    seen = trace(bench.bench, bench.mirror, column.ravel(), row.ravel(), displacement_um)
    square = np.clip(np.sum(seen.tilt**2, axis=0) / EDGE_TILT**2, 0, 2)
    return np.asarray(1 - falloff * square.reshape(height_px, width_px))


def _vignetting(bench: RenderedBench) -> FloatArray:
    width_px, height_px = bench.bench.size_px
    columns = np.linspace(-1, 1, width_px)[None, :]
    rows = np.linspace(-1, 1, height_px)[:, None]
    return np.asarray(1 - VIGNETTING * (columns**2 + rows**2) / 2)


def _with_glare(light: FloatArray, share: float) -> FloatArray:
    spread = gaussian_filter(light, GLARE_SPREAD * light.shape[1], mode="constant")
    return np.asarray((1 - share) * light + share * spread)
