"""Screen and camera of the twin: the screen as the camera sees it in the film, at any moment."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Protocol

import numpy as np

from firmware_iface.display_patterns import ScreenRaster
from firmware_iface.optical_roles import Frame, Levels, Pattern, Pixels
from firmware_iface.roles import LinkError
from membrane_ctrl.config.schema import DisturbancesConfig, OpticsConfig, TwinConfig
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.figure_changes import FigureChange, list_figure_changes
from membrane_ctrl.sim.optics.bench_poses import (
    ScreenError,
    camera_pose,
    pixel_directions,
    screen_pose,
)
from membrane_ctrl.sim.optics.disturbances import Disturber, Nodes
from membrane_ctrl.sim.optics.drum_modes import DrumMode, drum_modes
from membrane_ctrl.sim.optics.film_images import (
    NO_ADDED_LIGHT,
    AddedLight,
    light_of_panel,
    light_of_pattern,
    shade_images,
)
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.film_terms import FilmTerms
from membrane_ctrl.sim.optics.front_film import FrontFilm, make_front_film
from membrane_ctrl.sim.optics.node_interpolation import cubic_weights, node_positions
from membrane_ctrl.sim.optics.pattern_levels import Light, level_table
from membrane_ctrl.sim.optics.pixel_noise import noise_bank, normal_quantiles
from membrane_ctrl.sim.optics.shade import shade_rows, vignetting_loss
from membrane_ctrl.sim.optics.shade_crossed import shade_crossed_rows
from membrane_ctrl.sim.optics.shade_panel import PanelPicture, shade_panel_rows
from membrane_ctrl.sim.optics.trace import Trace, trace_rays
from membrane_ctrl.sim.optics.trace_cushion import trace_cushion
from membrane_ctrl.sim.truth import Truth

# Distance of the nodes on the mirror: a typical film's phase is then less than 1e-4 rad off the
# exact trace (asserted in the tests).
_NODE_MM = 4.6
# Distance of the displacements that are traced: a parabola through three of them is exact to 1e-6
# rad, a straight line only to 2e-5 rad.
_CELL_UM = 100.0
_KEPT_TRACES = 8
_MAPS = 3  # at the nodes: screen point, squared distance from the vertex
_DARK = Pattern("black")
_NO_PATTERN = Pattern("picture")  # of a panel whose pixels are given


@dataclass
class OpticsRenderer:
    """Renders the camera's picture of any pattern at any displacement of the film.

    The film is traced at nodes (see module `shade`) and, unless `exact`, at displacements _CELL_UM
    apart: a parabola through the three nearest gives the maps at any other, so that a moving film
    costs nothing until it leaves its cell. `exact` traces every pixel at every displacement: slow,
    for sets that must be exact. A `front` film adds further images of the screen. At `reference_um`
    the vertex is at the origin of the geometry. Each picture has its own pixel noise
    (`camera.noise_adu`). Raises ValueError if the film's rim is not the configured one.
    """

    optics: OpticsConfig
    film: FilmShape
    light: Light = field(default_factory=Light)
    reference_um: float = 0.0
    screen_error: ScreenError | None = None
    exact: bool = False
    seed: int = 0
    modes: tuple[DrumMode, ...] = ()
    front: FrontFilm | None = None
    disturbances: DisturbancesConfig = field(default_factory=DisturbancesConfig)
    _disturber: Disturber | None = field(default=None, init=False, repr=False)
    _traces: OrderedDict[float, FloatArray] = field(
        default_factory=OrderedDict, init=False, repr=False
    )
    _swings: dict[DrumMode | FigureChange, FloatArray] = field(
        default_factory=dict, init=False, repr=False
    )
    _pictures: int = field(default=0, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.film.radius_mm != self.optics.mirror.radius_mm:
            raise ValueError(
                f"film radius {self.film.radius_mm:g} mm is not mirror.radius_mm = "
                f"{self.optics.mirror.radius_mm:g}"
            )
        camera = self.optics.camera
        self._camera_pose = camera_pose(self.optics.geometry)
        self._screen_pose = screen_pose(self.optics.geometry, self.screen_error)
        # Size of a pixel on the mirror, and pixels between nodes.
        distance_mm = float(np.linalg.norm(self._camera_pose.position_mm))
        pixel_mm = camera.pixel_um / 1000.0 / camera.focal_mm * distance_mm
        self._step = 1 if self.exact else max(1, int(_NODE_MM / pixel_mm + 0.5))
        self._weights = cubic_weights(self._step)
        self._columns = node_positions(camera.width_px, self._step)
        self._rows = node_positions(camera.height_px, self._step)
        columns, rows = np.meshgrid(self._columns, self._rows)
        self._directions = pixel_directions(
            camera, self._camera_pose, columns.ravel(), rows.ravel()
        )
        # Side of the pattern's region.
        self._side_mm = self.optics.pattern.periods * self.optics.pattern.period_mm
        self._loss = vignetting_loss(camera.width_px, camera.height_px, self.light.vignetting)
        if self.disturbances != DisturbancesConfig():
            self._disturber = self._disturb_nodes()

    def make_blank_picture(self) -> Pixels:
        """An empty picture, (H, W): uint8 for an 8-bit camera, uint16 for any deeper one."""
        shape = (self.optics.camera.height_px, self.optics.camera.width_px)
        if self.optics.camera.bits == 8:
            return np.empty(shape, np.uint8)
        return np.empty(shape, np.uint16)

    def render_picture(
        self,
        shown: Pattern | PanelPicture,
        displacement_um: float,
        out: Pixels | None = None,
        gain: float = 1.0,
        time_s: float = 0.0,
        changes: Sequence[tuple[FigureChange, float]] = (),
    ) -> Pixels:
        """Return the picture of what is shown.

        Parameters
        ----------
        shown : Pattern or PanelPicture
        displacement_um : float
            Of the mirror's centre.
        out : (H, W) array, optional
            As of `make_blank_picture`: it is filled and returned; otherwise a new array is made.
        gain : float
            Exposure over the nominal one.
        time_s : float
            Of the exposure: the vibrations are those of this time.
        changes : sequence of (FigureChange, float)
            Small changes of the film's form, each with its amount.

        Raises
        ------
        ValueError
            The pattern is unknown, or `out` has another shape or type.
        """
        camera = self.optics.camera
        picture = out
        if picture is None:
            picture = self.make_blank_picture()
        depth = np.dtype(np.uint8 if camera.bits == 8 else np.uint16)
        if picture.shape != (camera.height_px, camera.width_px) or picture.dtype != depth:
            raise ValueError(
                f"out is {picture.shape} {picture.dtype}, not ({camera.height_px}, "
                f"{camera.width_px}) {depth}"
            )
        self._pictures += 1
        paint = self._make_painter(shown, gain)
        # Maps at the nodes, and light of the front film's images of the screen.
        maps = self._interpolate_nodes(displacement_um)
        nodes = maps[:_MAPS]
        added = NO_ADDED_LIGHT
        if self.front is not None:
            added = self._shade_images(maps[_MAPS:], self.front, shown, gain)

        # The maps moved by the bench's disturbances and by vibrations.
        times_s = np.array([[time_s]])
        if self._disturber is not None:
            nodes = nodes + self._disturber.ray_disturbance(time_s)
            times_s = self._disturber.row_times_s(time_s)
        for mode in self.modes:
            nodes = nodes + mode.swing_um(times_s) * self._swing_maps(mode)[:_MAPS]
        for change, amount in changes:
            nodes = nodes + amount * self._swing_maps(change)[:_MAPS]
        if self._disturber is not None:
            pattern = _NO_PATTERN
            if isinstance(shown, Pattern):
                pattern = shown
            nodes = np.concatenate([nodes, self._disturber.light_disturbance(time_s, pattern)])

        # Half of the rows on each of two threads.
        seed = (self.seed << 32) + self._pictures
        middle = camera.height_px // 2
        other = _second_thread().submit(
            paint, nodes, seed, added, picture, middle, camera.height_px
        )
        paint(nodes, seed, added, picture, 0, middle)
        other.result()
        return picture

    def _make_painter(self, shown: Pattern | PanelPicture, gain: float) -> Callable[..., None]:
        """The function that shades rows of a picture of what is shown."""
        if isinstance(shown, PanelPicture):
            return self._make_panel_painter(shown, gain)
        if shown.role == "crossed":
            return self._make_crossed_painter(shown, gain)
        return self._make_stripe_painter(shown, gain)

    def _make_panel_painter(self, panel: PanelPicture, gain: float) -> Callable[..., None]:
        """Shades rows of a picture of a panel's pixels."""
        noise_adu = self.optics.camera.noise_adu
        radius_mm = self.film.radius_mm
        dark, white, full = self._compute_levels(gain)
        scale = np.array([dark, white, self.light.leak, full])
        light = panel.light_of_pixels(self.light)
        places = panel.places

        def paint(
            nodes: FloatArray, seed: int, added: AddedLight, picture: Pixels, start: int, stop: int
        ) -> None:
            noise = normal_quantiles(), noise_adu, seed
            shade_panel_rows(
                nodes,
                self._weights,
                radius_mm,
                places,
                light,
                scale,
                self._loss,
                noise,
                tuple(added),
                picture,
                start,
                stop,
            )

        return paint

    def _make_stripe_painter(self, pattern: Pattern, gain: float) -> Callable[..., None]:
        """Shades rows of a picture of a pattern along one axis."""
        noise_adu = self.optics.camera.noise_adu
        table = level_table(pattern, self.optics.pattern, self.light)
        dark, white, full = self._compute_levels(gain)

        def paint(
            nodes: FloatArray, seed: int, added: AddedLight, picture: Pixels, start: int, stop: int
        ) -> None:
            shade_rows(
                nodes,
                self._weights,
                int(pattern.axis == "y"),
                self.film.radius_mm,
                self._side_mm,
                (table.values, table.cell_mm, table.smooth),
                np.array([dark, white, self.light.leak, full]),
                self._loss,
                (normal_quantiles(), noise_adu, seed),
                tuple(added),
                picture,
                start,
                stop,
            )

        return paint

    def _make_crossed_painter(self, pattern: Pattern, gain: float) -> Callable[..., None]:
        """Shades rows of a picture of crossed fringes."""
        if pattern.index < 1:
            raise ValueError(f"pattern {pattern.name!r}: crossed fringes need 1 or more periods")
        # All numbers in single precision, as `shade_crossed_rows` needs them.
        shape = _to_singles(
            pattern.index / self._side_mm,
            pattern.shift_rad / (2 * np.pi) - 0.5,
            pattern.shift_y_rad / (2 * np.pi) - 0.5,
            self._side_mm / 2,
            self.film.radius_mm**2,
        )
        dark, white, full = self._compute_levels(gain)
        noise_adu = self.optics.camera.noise_adu
        scale = _to_singles(dark, white, self.light.leak, self.light.gamma, noise_adu, full)
        weights = self._weights.T.astype(np.float32)
        column_loss, row_loss = (loss.astype(np.float32) for loss in self._loss)
        # Columns k + step * cell in row k.
        padded = np.pad(column_loss, (0, -column_loss.size % self._step))
        loss = (padded.reshape(-1, self._step).T.copy(), row_loss)

        def paint(
            nodes: FloatArray, seed: int, added: AddedLight, picture: Pixels, start: int, stop: int
        ) -> None:
            shade_crossed_rows(
                nodes,
                weights,
                shape,
                scale,
                loss,
                (noise_bank(), seed),
                tuple(added),
                picture,
                start,
                stop,
            )

        return paint

    def _compute_levels(self, gain: float) -> tuple[float, float, float]:
        """Counts without light, of a white screen in the mirror above that, and full scale.

        A front film takes its share of the light twice.
        """
        full = float(2**self.optics.camera.bits - 1)
        dark = self.light.dark_fraction * full
        white = gain * (self.light.white_fraction * full - dark)
        if self.front is not None:
            white *= self.front.transmittance**2
        return dark, white, full

    def _shade_images(
        self, maps: FloatArray, front: FrontFilm, shown: Pattern | PanelPicture, gain: float
    ) -> AddedLight:
        """Light of the images of the screen that a front film makes."""
        if isinstance(shown, PanelPicture):
            light_at = light_of_panel(shown, self.light)
        else:
            light_at = light_of_pattern(shown, self.optics.pattern, self.light)
        dark, _, full = self._compute_levels(gain)
        return shade_images(
            maps.reshape(2, 2, *maps.shape[1:]),
            front.image_shares,
            self._side_mm,
            light_at,
            self._weights,
            gain * (self.light.white_fraction * full - dark),
            self._loss,
        )

    def trace_pixels(self, displacement_um: float) -> Trace:
        """Exact s_x, s_y and place on the film of every pixel, each (H * W,), row by row; nothing
        interpolated. A front film is not in it.
        """
        camera = self.optics.camera
        columns, rows = np.meshgrid(
            np.arange(float(camera.width_px)), np.arange(float(camera.height_px))
        )
        directions = pixel_directions(camera, self._camera_pose, columns.ravel(), rows.ravel())
        return self._trace_film(directions, displacement_um)

    def _trace_film(
        self, directions: FloatArray, displacement_um: float, film: FilmTerms | None = None
    ) -> Trace:
        """Follow rays (N, 3) to the film at a displacement, or to another, and to the screen."""
        vertex_z_mm = -(displacement_um - self.reference_um) / 1000.0
        sag_mm = self.film.sag_at_mm(displacement_um)
        film = film or self.film.terms_at(displacement_um)
        return trace_rays(
            self._camera_pose, directions, film, sag_mm, vertex_z_mm, self._screen_pose
        )

    def _interpolate_nodes(self, displacement_um: float) -> FloatArray:
        """Traced maps at the nodes, (3, rows, columns), at this displacement (Lagrange through the
        nearest three).
        """
        if self.exact:
            return self._trace_nodes(displacement_um)

        # Between the traced displacements below, at and above the nearest one.
        nearest = float(np.floor(displacement_um / _CELL_UM + 0.5))
        f = displacement_um / _CELL_UM - nearest
        below, here, above = (self._trace_nodes((nearest + k) * _CELL_UM) for k in (-1, 0, 1))
        weight_below = 0.5 * f * (f - 1.0)
        weight_here = (1.0 - f) * (1.0 + f)
        weight_above = 0.5 * f * (f + 1.0)
        return weight_below * below + weight_here * here + weight_above * above

    def _trace_nodes(self, displacement_um: float) -> FloatArray:
        """Traced maps at the nodes; the last ones are kept."""
        if displacement_um in self._traces:
            self._traces.move_to_end(displacement_um)
            return self._traces[displacement_um]
        maps = self._trace_maps(displacement_um)
        self._traces[displacement_um] = maps
        while len(self._traces) > (1 if self.exact else _KEPT_TRACES):
            self._traces.popitem(last=False)
        return maps

    def _trace_maps(self, displacement_um: float) -> FloatArray:
        """Maps at the nodes; with a front film also s_x and s_y of its images, (7, rows,
        columns).
        """
        if self.front is None:
            return self._make_maps(self._trace_film(self._directions, displacement_um))
        found = trace_cushion(
            self._camera_pose,
            self._directions,
            self.film.terms_at(displacement_um),
            self.film.sag_at_mm(displacement_um),
            -(displacement_um - self.reference_um) / 1000.0,
            self.front,
            self._screen_pose,
        )
        maps = self._make_maps(found.main)
        images_mm = found.images_mm.reshape(4, *maps.shape[1:]) + self._side_mm / 2.0
        return np.concatenate([maps, images_mm])

    def _swing_maps(self, mode: DrumMode | FigureChange) -> FloatArray:
        """Change of the maps at the nodes by 1 µm of a mode, or by an amount of 1 of a change:
        linear to 1e-4 of it, at any displacement.
        """
        if mode not in self._swings:
            still = self._trace_film(self._directions, 0.0)
            moved = self._trace_film(self._directions, 0.0, mode.displace_film(self.film))
            self._swings[mode] = self._make_maps(moved) - self._make_maps(still)
        return self._swings[mode]

    def _disturb_nodes(self) -> Disturber:
        """The disturbances, for the nodes of a film at displacement 0."""
        still = self._trace_film(self._directions, 0.0)
        maps = self._make_maps(still)

        # The same with the camera 1 mm further away, as the growth of its mount moves it.
        pose = self._camera_pose
        further_mm = pose.position_mm * (1 + 1 / np.linalg.norm(pose.position_mm))
        self._camera_pose = replace(pose, position_mm=further_mm)
        grown = self._make_maps(self._trace_film(self._directions, 0.0))
        self._camera_pose = pose

        nodes = Nodes(
            s_x_mm=maps[0],
            s_y_mm=maps[1],
            x_mm=still.x_mm.reshape(maps.shape[1:]),
            y_mm=still.y_mm.reshape(maps.shape[1:]),
            row_share=(self._rows + 0.5) / self.optics.camera.height_px - 0.5,
            side_mm=self._side_mm,
            radius_mm=self.film.radius_mm,
            full_adu=self._compute_levels(1.0)[2],
            grown=grown - maps,
        )
        return Disturber(self.disturbances, nodes, self.seed)

    def _make_maps(self, found: Trace) -> FloatArray:
        """Screen point from the region's low edges, squared distance from the vertex: (3, rows,
        columns).
        """
        half_side_mm = self._side_mm / 2.0
        maps = np.stack(
            [
                found.s_x_mm + half_side_mm,
                found.s_y_mm + half_side_mm,
                found.x_mm**2 + found.y_mm**2,
            ]
        )
        return maps.reshape(3, len(self._rows), len(self._columns))


def _to_singles(*values: float) -> tuple[float, ...]:
    """The numbers in single precision."""
    return tuple(np.array(values, np.float32))


@cache
def _second_thread() -> ThreadPoolExecutor:
    """A thread that shades half of each picture."""
    return ThreadPoolExecutor(1, "shade")


class FilmPosition(Protocol):
    """True position of the film; `membrane_ctrl.sim.truth.Truth` is one."""

    @property
    def displacement_um(self) -> float:
        """Of the centre, positive when the bowl is deeper."""

    @property
    def sag_mm(self) -> float:
        """Depth of the bowl."""


class Clock(Protocol):
    """The run's clock."""

    def now(self) -> float:
        """Seconds since the run's start."""


class TwinOptics:
    """The optical half of the simulated bench: one film, one `screen`, one `camera`.

    Bowl and rim follow the truth; only the sag at displacement 0 is taken from it, once, at the
    first look.

    Parameters
    ----------
    optics : OpticsConfig
        The configured optics; without a reference displacement the geometry refers to the film at
        the first look.
    twin : TwinConfig
        Seed, disturbances, and the true geometry if it differs from the configured one.
    truth : callable
        Returns the film's true displacement and sag now.
    clock : Clock
        The run's clock: a frame has its time.
    film : FilmShape or None
        None: a Hencky bowl with the figure of `typical_film`, drawn from the twin's seed.
    """

    def __init__(
        self,
        optics: OpticsConfig,
        twin: TwinConfig,
        truth: Callable[[], FilmPosition],
        clock: Clock,
        film: FilmShape | None = None,
    ) -> None:
        if twin.geometry is not None:
            optics = optics.model_copy(update={"geometry": twin.geometry})
        self._optics = optics
        self._twin = twin
        self._truth = truth
        self._clock = clock
        self._film = film
        self._renderer: OpticsRenderer | None = None
        self.screen = TwinScreen()
        self.camera = TwinCamera(self)

    def prepare(self) -> None:
        """Trace the film where it is and take one picture, so that the first real one comes at the
        usual speed.
        """
        self._expose(_DARK, None)

    @property
    def film(self) -> FilmShape:
        """The film; its sag belongs to displacement 0."""
        return self._find_renderer().film

    def expose(self, out: Pixels | None) -> Frame:
        """Take one picture of the screen now."""
        if self.screen.shown is None:
            raise LinkError("twin camera: the screen shows nothing: show a pattern first")
        return self._expose(self.screen.shown, out)

    def view(self) -> Pixels:
        """What the sensor of an emulated camera sees now; before the first picture the screen is
        dark.
        """
        return self._expose(self.screen.shown or _DARK, None).pixels

    def _expose(self, shown: Pattern | PanelPicture, out: Pixels | None) -> Frame:
        """Take one picture of what is shown, at the film's true position."""
        renderer = self._find_renderer()
        time_s = self._clock.now()
        position = self._truth()
        changes: Sequence[tuple[FigureChange, float]] = ()
        if isinstance(position, Truth):
            changes = list_figure_changes(position)
        picture = renderer.render_picture(
            shown, position.displacement_um, out, time_s=time_s, changes=changes
        )
        return Frame(picture, time_s)

    def _find_renderer(self) -> OpticsRenderer:
        """The renderer, made at the first call from the film's position then."""
        if self._renderer is None:
            # The film at the laser's zero.
            position = self._truth()
            sag_mm = position.sag_mm - position.displacement_um / 1000.0
            film = self._film or typical_film(
                sag_mm,
                self._optics.mirror.radius_mm,
                self._twin.seed,
                self._twin.film_prestrain,
                self._twin.film_poisson,
            )

            # The displacement for which the geometry holds.
            stated = self._optics.geometry.reference_displacement_um
            reference_um = stated
            if reference_um is None:
                reference_um = position.displacement_um
            self._renderer = OpticsRenderer(
                self._optics,
                film,
                reference_um=reference_um,
                seed=self._twin.seed,
                front=make_front_film(self._optics.mirror, film.sag_mm, self._twin.seed),
                modes=drum_modes(self._twin.drum_nm),
                disturbances=self._twin.disturbances,
            )
        return self._renderer


class TwinScreen:
    """Role Screen: lit and settled at once."""

    def __init__(self) -> None:
        self.shown: Pattern | PanelPicture | None = None

    def show(self, pattern: Pattern) -> None:
        """Show the pattern."""
        self.shown = pattern

    def show_picture(self, levels: Levels, raster: ScreenRaster) -> None:
        """Show the pixels that an emulated display has received.

        Parameters
        ----------
        levels : (height, width) uint8 array
            What each pixel shows, 0 to 255.
        raster : ScreenRaster
            Place of the pixels on the screen.
        """
        self.shown = PanelPicture(levels, raster)

    def close(self) -> None:
        """Go dark."""
        self.shown = None


class TwinCamera:
    """Role Camera: renders what a camera would have taken."""

    def __init__(self, optics: TwinOptics) -> None:
        self._optics = optics
        self._open = True

    def grab(self, out: Pixels | None = None) -> Frame:
        """One exposure; the picture lands in `out` (H, W) if given, else in a new array.

        Raises LinkError if the camera is closed or the screen shows nothing.
        """
        if not self._open:
            raise LinkError("twin camera: closed")
        return self._optics.expose(out)

    def close(self) -> None:
        """No more pictures."""
        self._open = False
