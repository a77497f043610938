"""A bench as a scene of Mitsuba, and its light under pictures on the screen."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.worlds.path_traced.meshes import (
    Surface,
    bulging_surface,
    ring_surface,
)
from tests.worlds.path_traced.panel_texture import SIDE_MM
from tests.worlds.second_optics import Bench, Mirror

FloatArray = NDArray[np.float64]
Singles = NDArray[np.float32]

COLOURS = 3  # pictures that one rendering carries
RING_WIDTH_MM = 40.0
RING_GAP_MM = 0.5  # between film and ring, so that no ray meets both
RING_REFLECTANCE = 0.15
GAS_BELOW_FILM_MM = 1.0  # a ray that has passed the film starts 0.05 mm further on
MIRROR_REFLECTANCE = 0.88  # of aluminium


@dataclass(frozen=True)
class FrontFilm:
    """A clear film before the mirror, on the same ring, bulging towards the camera.

    Attributes
    ----------
    sag_mm : float
        Height of its centre above the ring.
    refractive_index : float
        Of the film; each of its faces reflects ((n - 1) / (n + 1))^2.
    gas_index_excess : float
        Refractive index of the gas behind it over that of the air before it, less 1.
    """

    sag_mm: float = 63.4
    refractive_index: float = 1.60
    gas_index_excess: float = 7e-6


@dataclass(frozen=True)
class RenderedBench:
    """What is rendered. The camera's lens has no distortion, and the screen is plane.

    Attributes
    ----------
    room : float
        Light of the room, of a white screen.
    aperture_mm : float
        Radius of the lens; it is focused on the mirror's vertex.
    """

    mirror: Mirror = field(default_factory=Mirror)
    bench: Bench = field(default_factory=lambda: Bench.paper(0.125))
    front: FrontFilm | None = None
    room: float = 0.01
    aperture_mm: float = 1.0


@dataclass(frozen=True)
class RenderSettings:
    """How it is rendered.

    Attributes
    ----------
    samples : int
        Paths of a pixel: a square number.
    seed : int
        Of the paths, which are the same for each picture: what is lost by chance is lost in all.
    variant : str
        Of Mitsuba: "scalar_rgb" runs everywhere, "llvm_ad_rgb" needs LLVM's library.
    """

    samples: int = 64
    seed: int = 0
    variant: str = "scalar_rgb"


def render_surface(
    bench: RenderedBench, mirror: Surface, textures: list[Singles], settings: RenderSettings
) -> list[FloatArray]:
    """Light of each pixel (rows, columns, 3) under each texture of the panel (n, n, 3).

    The rows of a texture run along s_y, its columns along s_x. Raises ImportError without Mitsuba.
    """
    import mitsuba

    mitsuba.set_variant(settings.variant)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        still = _still_parts(mitsuba, bench, mirror, settings, folder)
        pictures = []
        for texture in textures:
            scene = mitsuba.load_dict(still | {"screen": _screen(mitsuba, bench.bench, texture)})
            image = mitsuba.render(scene, spp=settings.samples, seed=settings.seed)
            pictures.append(np.asarray(image, np.float64))
    return pictures


def _still_parts(
    mitsuba: Any, bench: RenderedBench, mirror: Surface, settings: RenderSettings, folder: Path
) -> dict[str, Any]:
    """Everything but the screen."""
    mirror.deeper_by_half_the_offset().write_ply(folder / "mirror.ply")
    ring_mm = bench.mirror.sag_mm
    radius_mm = bench.mirror.radius_mm
    inner_mm = radius_mm + RING_GAP_MM
    ring_surface(inner_mm, inner_mm + RING_WIDTH_MM, ring_mm).write_ply(folder / "ring.ply")
    parts: dict[str, Any] = {
        "type": "scene",
        # Russian roulette would end paths by chance
        "integrator": {"type": "path", "max_depth": 12, "rr_depth": 100},
        "sensor": _camera(mitsuba, bench, settings),
        "mirror": {
            "type": "ply",
            "filename": str(folder / "mirror.ply"),
            "bsdf": {
                "type": "conductor",
                "material": "none",
                "specular_reflectance": {"type": "rgb", "value": MIRROR_REFLECTANCE},
            },
        },
        "ring": {
            "type": "ply",
            "filename": str(folder / "ring.ply"),
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "rgb", "value": RING_REFLECTANCE},
            },
        },
        "room": {"type": "constant", "radiance": {"type": "rgb", "value": bench.room}},
    }
    if bench.front is not None:
        parts |= _front_film(bench.front, ring_mm, radius_mm, folder)
    return parts


def _front_film(front: FrontFilm, ring_mm: float, radius_mm: float, folder: Path) -> dict[str, Any]:
    """The film with its reflections, and behind it the boundary of the gas."""
    film = Mirror(sag_mm=front.sag_mm, radius_mm=radius_mm)
    bulging_surface(film, ring_mm).write_ply(folder / "front.ply")
    bulging_surface(film, ring_mm, -GAS_BELOW_FILM_MM).write_ply(folder / "gas.ply")
    return {
        "front": {
            "type": "ply",
            "filename": str(folder / "front.ply"),
            "bsdf": {
                "type": "thindielectric",
                "int_ior": front.refractive_index,
                "ext_ior": 1.0,
            },
        },
        "gas": {
            "type": "ply",
            "filename": str(folder / "gas.ply"),
            "bsdf": {
                "type": "dielectric",
                "int_ior": 1.0 + front.gas_index_excess,
                "ext_ior": 1.0,
            },
        },
    }


def _camera(mitsuba: Any, bench: RenderedBench, settings: RenderSettings) -> dict[str, Any]:
    camera = bench.bench.camera
    width_px, height_px = bench.bench.size_px
    middle_px = ((width_px - 1) / 2, (height_px - 1) / 2)
    if not np.allclose(bench.bench.principal_px, middle_px):
        raise ValueError("the rendered camera has its principal point in the middle")
    place = camera.place_mm
    ahead = place + 1000 * camera.axes[2]
    lens: dict[str, Any] = {"type": "perspective"}
    if bench.aperture_mm:
        distance_mm = float(-camera.axes[2] @ place)  # the vertex is at 0
        lens = {
            "type": "thinlens",
            "aperture_radius": bench.aperture_mm,
            "focus_distance": distance_mm,
        }
    return lens | {
        "fov": float(2 * np.degrees(np.arctan(width_px / 2 / bench.bench.focal_px))),
        "fov_axis": "x",
        "near_clip": 10.0,
        "far_clip": 1e5,
        "to_world": mitsuba.ScalarTransform4f().look_at(
            origin=place.tolist(), target=ahead.tolist(), up=(-camera.axes[1]).tolist()
        ),
        "film": {
            "type": "hdrfilm",
            "width": width_px,
            "height": height_px,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": "multijitter", "sample_count": settings.samples},
    }


def _screen(mitsuba: Any, bench: Bench, texture: Singles) -> dict[str, Any]:
    """A luminous rectangle as large as the pattern, whose first axis is s_x and second s_y."""
    screen = bench.screen
    to_world = np.eye(4)
    to_world[:3, 0] = SIDE_MM / 2 * bench.pitch * screen.axes[0]
    to_world[:3, 1] = SIDE_MM / 2 * bench.pitch * screen.axes[1]
    to_world[:3, 2] = screen.axes[2]
    to_world[:3, 3] = screen.place_mm
    return {
        "type": "rectangle",
        "to_world": mitsuba.ScalarTransform4f(to_world),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {
            "type": "area",
            "radiance": {
                "type": "bitmap",
                "bitmap": mitsuba.Bitmap(texture),
                "raw": True,
                "filter_type": "nearest",
                "wrap_mode": "clamp",
            },
        },
    }
