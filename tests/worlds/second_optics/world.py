"""Frames of a mirror on a bench with planted effects, in memory or as a capture set on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter

from tests.worlds.second_optics import patterns
from tests.worlds.second_optics.bench import A_MM, ALPHA_DEG, B_MM, FOCAL_MM, HAND_SIGMAS, Bench
from tests.worlds.second_optics.clear_film import (
    ClearFilm,
    trace_cushion,
    trace_reflections,
)
from tests.worlds.second_optics.effects import Effects, Ghost
from tests.worlds.second_optics.mirror import Mirror
from tests.worlds.second_optics.patterns import Picture
from tests.worlds.second_optics.rays import trace
from tests.worlds.second_optics.sensor import count, store

FloatArray = NDArray[np.float64]
Singles = NDArray[np.float32]
Counts = NDArray[np.uint8] | NDArray[np.uint16]

FRAME_S = 0.12  # from one frame to the next
NODE_MM = 20.0  # distance of traced rays on the mirror; between them splines of degree 5
WRINKLED_NODE_MM = 5.0
NODE_UM = 120.0  # displacements traced for a bench at rest; a parabola through three gives others
EDGE_TILT = 0.17  # tangent of the viewing angle from the screen's middle to the mirror's edge
SAMPLES = 2  # of a pixel, along each side
NOMINAL_WHITE = 0.8  # of full scale
DARK = 0.02
VIGNETTING = 0.12  # loss in the picture's corner
SURROUNDINGS = 0.01  # light beside the film, of white
DUST_MM = 3.0


@dataclass(frozen=True)
class Stated:
    """What the capture set states of the bench, where it differs from the paper's bench.

    Attributes
    ----------
    sigma_share : float
        Stated sigmas over those of a hand measurement (`bench.HAND_SIGMAS`).
    geometry : mapping
        Keys that replace those of `[geometry]`.
    camera : mapping
        Keys that replace those of `[camera]`.
    turned_deg : float or None
        Angle of `[mirror_turned]`, without which the mirror stands as usual.
    front_film : mapping or None
        `[mirror.front_film]`; None: a single film is stated.
    """

    sigma_share: float = 1.0
    geometry: Mapping[str, Any] = field(default_factory=dict)
    camera: Mapping[str, Any] = field(default_factory=dict)
    turned_deg: float | None = None
    front_film: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Truth:
    """The film during one set: the mean over the sinusoids."""

    displacement_um: float
    sag_um: float
    zernike_um: FloatArray  # (36,): Noll 1..36 over the ring's disc
    displacements_um: FloatArray  # (frames,)


@dataclass
class _Maps:
    """Of every sample of the picture: place on the screen, viewing angle, radius on the film."""

    screen: Singles  # (2, rows, columns), mm
    tilt: Singles  # (2, rows, columns)
    film: Singles  # (2, rows, columns), in radii


@dataclass
class World:
    """A mirror on a bench, its effects, and what is stated. Noise is drawn from `seed`."""

    mirror: Mirror = field(default_factory=Mirror)
    bench: Bench = field(default_factory=Bench.paper)
    effects: Effects = field(default_factory=Effects)
    stated: Stated = field(default_factory=Stated)
    seed: int = 0
    samples: int = SAMPLES
    clear_film: ClearFilm | None = None

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng((4711, self.seed))
        self._at_rest: dict[int, FloatArray] = {}
        radius = 0.95 * np.sqrt(self._rng.random(self.effects.dust))
        angle = 2 * np.pi * self._rng.random(self.effects.dust)
        self._dust = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        self._previous = Picture("black")
        columns = np.abs(np.linspace(-1, 1, self.bench.size_px[0]))[None, :]
        rows = np.abs(np.linspace(-1, 1, self.bench.size_px[1]))[:, None]
        self._vignetting = 1 - VIGNETTING * (columns**2 + rows**2) / 2

    def move_bench(self, camera: FloatArray, screen: FloatArray) -> None:
        """Move camera and screen from now on, in six degrees of freedom each (`SIX`)."""
        self.bench = self.bench.moved(camera, screen)
        self._at_rest = {}

    # -- frames in memory

    def frames(
        self, pictures: Sequence[Picture], displacement_um: float = 0.0, begin_s: float = 0.0
    ) -> tuple[list[Counts], FloatArray, FloatArray]:
        """Frames of pictures shown one after the other, true displacements, laser readings."""
        times_s = begin_s + FRAME_S * np.arange(len(pictures))
        moved = self.effects.film_motion_um
        added = [0.0 if moved is None else moved(time_s) for time_s in times_s]
        displacements_um = displacement_um + np.array(added)
        frames: list[Counts] = []
        for k, picture in enumerate(pictures):
            ambient = self.effects.ambient * k / max(len(pictures) - 1, 1)
            stale = self.effects.stale_frame == k
            shown = self._previous if stale else picture
            frames.append(self.frame(shown, float(displacements_um[k]), float(times_s[k]), ambient))
            self._previous = picture
        noise_um = self.effects.laser_noise_um * self._rng.standard_normal(len(pictures))
        readings_um = self.effects.laser_scale * displacements_um + noise_um
        if not self.effects.laser:
            readings_um = np.full(len(pictures), np.nan)
        return frames, displacements_um, readings_um

    def frame(
        self, picture: Picture, displacement_um: float, time_s: float = 0.0, ambient: float = 0.0
    ) -> Counts:
        """One exposure as the file has it: depth, container and orientation included."""
        light = self._light(picture, self._maps(displacement_um, time_s)) + ambient
        light = light * (1 + self.effects.flicker * self._rng.standard_normal())
        if self.effects.psf_px:
            light = gaussian_filter(light, self.effects.psf_px, mode="nearest")
        sensor = self.effects.sensor
        share = DARK + (NOMINAL_WHITE - DARK) * sensor.exposure * self._vignetting * light
        return _oriented(store(count(share, sensor, self._rng), sensor), self.effects.orientation)

    def screen_map(self, displacement_um: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Exact places on the screen (2, rows, columns) of the pixels' centres, and on the film.

        Every pixel is traced; nothing is interpolated.
        """
        width, height = self.bench.size_px
        column, row = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
        seen = trace(self.bench, self.mirror, column.ravel(), row.ravel(), displacement_um)
        shape = (2, height, width)
        return seen.screen_mm.reshape(shape), self.mirror.radius_mm * seen.film.reshape(shape)

    # -- capture sets on disk

    def write_set(
        self,
        folder: Path,
        displacement_um: float = 0.0,
        begin_s: float = 0.0,
        pressure_pa: float | None = None,
    ) -> Truth:
        """Write a full set (18 frames) and return its truth."""
        pictures = patterns.full_set()
        frames, displacements_um, readings_um = self.frames(pictures, displacement_um, begin_s)
        rows = []
        for k, picture in enumerate(pictures):
            row: dict[str, Any] = {"file": f"{picture.name}.png", "role": picture.role}
            if picture.axis:
                row["axis"] = picture.axis
            row["index"] = picture.index
            row["time_s"] = begin_s + FRAME_S * k
            if self.effects.laser:
                row["displacement_um"] = float(readings_um[k])
            rows.append(row)
        table = self.stated_table() | {"frames": rows}
        if self.stated.turned_deg is not None:
            table["mirror_turned"] = {"angle_deg": self.stated.turned_deg}
        if pressure_pa is not None:
            table["pressure_pa"] = pressure_pa
        write_files(folder, table, [row["file"] for row in rows], frames)
        return self.truth([k for k, p in enumerate(pictures) if p.role == "sin"], displacements_um)

    def write_track(
        self,
        folder: Path,
        reference: Path,
        count_frames: int,
        displacement_um: float = 0.0,
        begin_s: float = 0.0,
        stepped: bool = True,
    ) -> FloatArray:
        """Write a tracking set beside its reference; returns the true displacements (frames,)."""
        pictures = patterns.tracking_set(count_frames, stepped)
        frames, displacements_um, readings_um = self.frames(pictures, displacement_um, begin_s)
        rows = []
        for k, picture in enumerate(pictures):
            row: dict[str, Any] = {
                "file": f"t_{k:05d}.png",
                "role": "crossed",
                "shift_x_rad": float(picture.shift_rad[0]),
                "shift_y_rad": float(picture.shift_rad[1]),
                "time_s": begin_s + FRAME_S * k,
            }
            if self.effects.laser:
                row["displacement_um"] = float(readings_um[k])
            rows.append(row)
        side_mm = patterns.PERIODS * patterns.PERIOD_MM
        crossed = {
            "periods": patterns.CROSSED_PERIODS,
            "period_mm": side_mm / patterns.CROSSED_PERIODS,
        }
        table = {
            "schema": "membrane-capture/1",
            "kind": "track",
            "reference": f"../{reference.name}",
            "pattern": _pattern_table() | {"crossed": crossed},
            "frames": rows,
        }
        write_files(folder, table, [row["file"] for row in rows], frames)
        return displacements_um

    def truth(self, sinusoids: Sequence[int], displacements_um: FloatArray) -> Truth:
        """Truth of a set whose sinusoids are these frames."""
        mean_um = float(displacements_um[list(sinusoids)].mean())
        sag_um = self.mirror.rim_sag_um(mean_um)
        return Truth(mean_um, sag_um, self.mirror.zernike_um(mean_um), displacements_um)

    def stated_table(self) -> dict[str, Any]:
        """The tables of `capture.toml` without its frames."""
        share = self.stated.sigma_share
        named = ("a_mm", "b_mm", "alpha_deg")
        sigmas = {n: share * s for n, s in HAND_SIGMAS.items() if n not in named}
        sigmas["principal_mm"] = sigmas.pop("principal_x_mm")
        sigmas.pop("principal_y_mm")
        geometry: dict[str, Any] = {"a_mm": A_MM, "b_mm": B_MM, "alpha_deg": ALPHA_DEG}
        geometry |= {
            f"{n.rsplit('_', 1)[0]}_sigma_{n.rsplit('_', 1)[1]}": share * HAND_SIGMAS[n]
            for n in named
        }
        geometry |= {"reference_displacement_um": 0.0, "sigmas": sigmas}
        width, height = self.bench.size_px
        camera: dict[str, Any] = {
            "width_px": width,
            "height_px": height,
            "focal_mm": FOCAL_MM,
            "pixel_um": 1e3 * self.bench.pixel_mm,
            "principal_px": [(width - 1) / 2, (height - 1) / 2],
            "noise_adu": self.effects.sensor.read_adu,
        }
        if self.effects.sensor.bits > 8 and self.effects.sensor.container == "plain":
            camera["bits"] = self.effects.sensor.bits
        return {
            "schema": "membrane-capture/1",
            "kind": "full",
            "pattern": _pattern_table(),
            "geometry": geometry | dict(self.stated.geometry),
            "camera": camera | dict(self.stated.camera),
            "mirror": self._mirror_table(),
        }

    def _mirror_table(self) -> dict[str, Any]:
        table: dict[str, Any] = {
            "radius_mm": self.mirror.radius_mm,
            "analysis_radius_mm": 0.95 * self.mirror.radius_mm,
        }
        if self.stated.front_film is not None:
            table["front_film"] = dict(self.stated.front_film)
        return table

    # -- light

    def _light(self, picture: Picture, maps: _Maps) -> FloatArray:
        """Light of each pixel, of a white screen: mean over its samples."""
        panel = self.effects.panel
        light = self._panel_light(picture, maps.screen, maps.tilt)
        if panel.previous_share and self._previous != picture:
            before = self._panel_light(self._previous, maps.screen, maps.tilt)
            share = panel.previous_share
            if self._previous.role == picture.role == "sin":
                share *= panel.between_greys
            light += np.float32(share) * (before - light)
        if panel.ghost is not None:
            light += np.float32(panel.ghost.share) * self._panel_light(
                picture, _ghost_screen(panel.ghost, maps.screen), maps.tilt
            )
        if self.clear_film is not None:
            light *= np.float32((1 - self.clear_film.reflectance) ** 2)
            self._add_reflections(picture, light)
        film = maps.film[0] ** 2 + maps.film[1] ** 2 <= 1
        light = np.where(film, light, np.float32(SURROUNDINGS))
        for x, y in self._dust:
            near = np.hypot(maps.film[0] - x, maps.film[1] - y) < DUST_MM / self.mirror.radius_mm
            light[near] *= 0.5
        n = self.samples
        height, width = light.shape[0] // n, light.shape[1] // n
        return light.reshape(height, n, width, n).mean(axis=(1, 3), dtype=np.float64)

    def _add_reflections(self, picture: Picture, light: Singles) -> None:
        """Add the images of the pattern by the clear film, of a mirror at rest."""
        for share, part, screen_mm, tilt in self._reflections:
            inside = np.all(np.abs(screen_mm) < patterns.PERIODS * patterns.PERIOD_MM / 2, axis=0)
            seen = self._panel_light(picture, screen_mm, tilt)
            light[part] += np.float32(share) * np.where(inside, seen, np.float32(0))

    @cached_property
    def _reflections(self) -> list[tuple[float, tuple[slice, slice], Singles, Singles]]:
        """Of both images: share, part of the samples, and screen points and tilts there."""
        assert self.clear_film is not None
        width, height = self.bench.size_px
        columns, rows = _samples(width, self.samples), _samples(height, self.samples)
        found = []
        for k in range(2):
            # A coarse grid over the middle shows which part sees the pattern.
            coarse_x, coarse_y = columns[:: 4 * self.samples], rows[:: 4 * self.samples]
            near_x = coarse_x[np.abs(coarse_x - width / 2) < width / 5]
            near_y = coarse_y[np.abs(coarse_y - height / 2) < height / 5]
            grid = np.meshgrid(near_x, near_y)
            traced = trace_reflections(
                self.bench, self.mirror, self.clear_film, grid[0].ravel(), grid[1].ravel(), 0.0
            )
            seen = np.all(np.abs(traced[k][1].screen_mm) < 300.0, axis=0)
            if not seen.any():
                continue
            low_x, high_x = np.searchsorted(columns, _reach(grid[0].ravel()[seen]))
            low_y, high_y = np.searchsorted(rows, _reach(grid[1].ravel()[seen]))
            part = slice(int(low_y), int(high_y)), slice(int(low_x), int(high_x))
            x, y = np.meshgrid(columns[part[1]], rows[part[0]])
            traced = trace_reflections(
                self.bench, self.mirror, self.clear_film, x.ravel(), y.ravel(), 0.0
            )
            share, image = traced[k]
            shape = (2, *x.shape)
            screen_mm = image.screen_mm.reshape(shape).astype(np.float32)
            found.append((share, part, screen_mm, image.tilt.reshape(shape).astype(np.float32)))
        return found

    def _panel_light(self, picture: Picture, screen: Singles, tilt: Singles) -> Singles:
        panel = self.effects.panel
        s_x, s_y = (
            (screen[1], screen[0]) if self.effects.screen_exchanged else (screen[0], screen[1])
        )
        level = picture.level(s_x, s_y)
        if panel.gamma_by_angle:
            change = panel.gamma_by_angle * np.clip(tilt[0] / (2 * EDGE_TILT), -1.5, 1.5)
            level = np.clip(level, 0, 1) ** (panel.gamma + change)
        elif panel.gamma != 1:
            level = np.clip(level, 0, 1) ** np.float32(panel.gamma)
        square = np.clip((tilt[0] ** 2 + tilt[1] ** 2) / EDGE_TILT**2, 0, 2)
        if panel.contrast_falloff:
            level = level + panel.contrast_falloff * square * (0.5 - level)
        light = panel.leak + (1 - panel.leak) * level
        if panel.falloff or panel.falloff_slope:
            sideways = tilt[0] / EDGE_TILT
            light = light * (1 - panel.falloff * square - panel.falloff_slope * sideways)
        return np.asarray(light, np.float32)

    # -- geometry

    def _maps(self, displacement_um: float, time_s: float) -> _Maps:
        """Of this moment; a bench at rest is traced at a few displacements only."""
        camera, screen = self.effects.camera_motion, self.effects.screen_motion
        if camera is None and screen is None:
            tilt, film = self._slow_maps
            return _Maps(self._spread(self._nodes_at_rest(displacement_um)[:2]), tilt, film)
        still = np.zeros(6)
        bench = self.bench.moved(
            still if camera is None else camera(time_s), still if screen is None else screen(time_s)
        )
        maps = self._spread(self._traced(bench, displacement_um))
        return _Maps(maps[0:2], maps[2:4], maps[4:6])

    def _nodes_at_rest(self, displacement_um: float) -> FloatArray:
        """Traced values at the nodes, by a parabola through three displacements."""
        middle = round(displacement_um / NODE_UM)
        f = displacement_um / NODE_UM - middle
        if abs(f) < 1e-9:
            return self._node(middle)
        below, here, above = (self._node(middle + k) for k in (-1, 0, 1))
        return f * (f - 1) / 2 * below + (1 - f) * (1 + f) * here + f * (f + 1) / 2 * above

    def _node(self, index: int) -> FloatArray:
        if index not in self._at_rest:
            self._at_rest[index] = self._traced(self.bench, NODE_UM * index)
        return self._at_rest[index]

    def _traced(self, bench: Bench, displacement_um: float) -> FloatArray:
        """Screen, tilt and film (6, rows, columns) of the rays at the nodes."""
        columns, rows = self._node_places
        column, row = np.meshgrid(columns, rows)
        places = column.ravel(), row.ravel()
        if self.clear_film is None:
            seen = trace(bench, self.mirror, *places, displacement_um)
        else:
            seen = trace_cushion(bench, self.mirror, self.clear_film, *places, displacement_um)
        values = np.concatenate([seen.screen_mm, seen.tilt, seen.film])
        return values.reshape(6, rows.size, columns.size)

    @cached_property
    def _slow_maps(self) -> tuple[Singles, Singles]:
        """Viewing angles and places on the film: they hardly change with the displacement."""
        maps = self._spread(self._node(0)[2:])
        return maps[0:2], maps[2:4]

    def _spread(self, values: FloatArray) -> Singles:
        """Values of all samples from those at the nodes (maps, rows, columns): splines."""
        by_row, by_column = self._spline_matrices
        return np.stack([(by_row @ (each @ by_column)).astype(np.float32) for each in values])

    @cached_property
    def _node_places(self) -> tuple[FloatArray, FloatArray]:
        """Columns and rows of the traced rays."""
        node_mm = WRINKLED_NODE_MM if self.mirror.wrinkles else NODE_MM
        pixel_mm = float(np.linalg.norm(self.bench.camera.place_mm)) / self.bench.focal_px
        width, height = self.bench.size_px
        return _nodes(width, node_mm / pixel_mm), _nodes(height, node_mm / pixel_mm)

    @cached_property
    def _spline_matrices(self) -> tuple[FloatArray, FloatArray]:
        """Splines of degree 5: (samples, nodes) along rows, (nodes, samples) along columns."""
        columns, rows = self._node_places
        width, height = self.bench.size_px
        by_row = make_interp_spline(rows, np.eye(rows.size), k=5)(_samples(height, self.samples))
        by_column = make_interp_spline(columns, np.eye(columns.size), k=5)(
            _samples(width, self.samples)
        )
        return by_row, np.ascontiguousarray(by_column.T)


def _nodes(size_px: int, step_px: float) -> FloatArray:
    count_nodes = max(8, int(np.ceil((size_px + 1) / step_px)) + 1)
    return np.linspace(-1.0, float(size_px), count_nodes)


def _samples(size_px: int, samples: int) -> FloatArray:
    """Places of the samples of a row or column of pixels, whose centres are whole numbers."""
    return np.asarray((np.arange(size_px * samples) + 0.5) / samples - 0.5)


def _reach(places: FloatArray) -> tuple[float, float]:
    """Lowest and highest place, with a margin for the coarse grid."""
    return float(places.min()) - 6.0, float(places.max()) + 6.0


def _ghost_screen(ghost: Ghost, screen: Singles) -> Singles:
    shift = np.array(ghost.shift_mm, np.float32)[:, None, None]
    return np.asarray(np.float32(ghost.scale) * screen + shift)


def _oriented(frame: Counts, orientation: str) -> Counts:
    """The frame as a camera that stands otherwise stores it, with the same size."""
    if orientation == "rotated 180":
        return np.ascontiguousarray(frame[::-1, ::-1])
    if orientation == "mirrored left-right":
        return np.ascontiguousarray(frame[:, ::-1])
    if orientation == "mirrored up-down":
        return np.ascontiguousarray(frame[::-1])
    if orientation == "axes exchanged":  # the middle square is transposed
        height, width = frame.shape
        turned = np.full_like(frame, int(frame[0, 0]))
        left = (width - height) // 2
        turned[:, left : left + height] = frame[:, left : left + height].T
        return turned
    return frame


def _pattern_table() -> dict[str, Any]:
    return {
        "steps": patterns.STEPS,
        "periods": patterns.PERIODS,
        "period_mm": patterns.PERIOD_MM,
    }


def write_files(
    folder: Path, table: Mapping[str, Any], names: Sequence[str], frames: Sequence[Counts]
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame in zip(names, frames, strict=True):
        cv2.imwrite(str(folder / name), frame, [cv2.IMWRITE_PNG_COMPRESSION, 0])
    (folder / "capture.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
