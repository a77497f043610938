"""The specification of a simulated capture set, checked before anything is written."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, isinf, pi, sin, sqrt
from typing import Any, Literal, get_args

import numpy as np

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import (
    DisturbancesConfig,
    GeometryConfig,
    MirrorConfig,
    OpticsConfig,
)
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim import film as gas_film
from membrane_ctrl.sim.optics import bench_poses, film_shape, pattern_levels, zernike_polynomials
from membrane_ctrl.sim.optics.front_film import FrontFilm
from membrane_ctrl.sim.optics.turned_film import MirrorSeat

# Faults of single frames on a real bench, for simulated sets.
FaultKind = Literal[
    "stale",
    "swapped",
    "missing",
    "saturated",
    "dark",
    "flicker",
    "moved",
    "wrong_size",
    "wrong_depth",
]

# Strength of a fault: relative exposure, or µm of film displacement
_DEFAULT_AMOUNT: dict[FaultKind, float] = {
    "saturated": 2.0,
    "dark": 0.05,
    "flicker": 0.8,
    "moved": 200.0,
}
# Of a sphere that leans: its coma is of micrometres, its terms above radial order 7 far below a
# nanometre.
_LEANING_TERMS = 36
_FITTED_RINGS = 40  # and as many spokes: points at which such a sphere is fitted


@dataclass(frozen=True, slots=True)
class FrameFault:
    """One fault of one frame.

    Attributes
    ----------
    kind : FaultKind
        "stale" (the picture of the frame before, byte for byte), "swapped" (with the frame after),
        "missing" (listed but not written), "saturated", "dark", "flicker" (wrong exposure), "moved"
        (the film moved unnoticed by the laser), "wrong_size" (one row short), "wrong_depth" (8 for
        16 bit or the reverse).
    frame : str
        The frame's name, as `x_sin_2`.
    amount : float, optional
        Relative exposure, or µm for "moved"; None: a typical one.
    """

    kind: FaultKind
    frame: str
    amount: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in get_args(FaultKind):
            raise ValueError(
                f"faults: kind {self.kind!r} is not one of {', '.join(get_args(FaultKind))}"
            )
        if self.amount is not None and self.kind not in _DEFAULT_AMOUNT:
            raise ValueError(f"faults: {self.kind} has no amount")

    @property
    def strength(self) -> float:
        """The amount, or the typical one of this kind."""
        if self.amount is None:
            return _DEFAULT_AMOUNT[self.kind]
        return self.amount

    @classmethod
    def parse(cls, text: str) -> "FrameFault":
        """Read `kind:frame` or `kind:frame:amount`.

        Raises ValueError if the form, the kind or the amount is invalid.
        """
        kind, _, rest = text.partition(":")
        frame, _, amount = rest.partition(":")
        if not frame:
            raise ValueError(
                f"faults: {text!r} must read kind:frame or kind:frame:amount, as "
                "flicker:x_sin_2:0.8"
            )
        try:
            strength = None
            if amount:
                strength = float(amount)
        except ValueError:
            raise ValueError(f"faults: amount {amount!r} of {text!r} is not a number") from None
        return cls(kind, frame, strength)  # type: ignore[arg-type]  # checked above


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of the film's centre: start + drift t + amplitude sin(2 pi frequency t + phase)."""

    start_um: float = 0.0
    drift_um_per_s: float = 0.0
    amplitude_um: float = 0.0
    frequency_hz: float = 0.0
    phase_rad: float = 0.0

    def at_um(self, time_s: float) -> float:
        """Displacement at a time."""
        swing = self.amplitude_um * sin(2.0 * pi * self.frequency_hz * time_s + self.phase_rad)
        return self.start_um + self.drift_um_per_s * time_s + swing


def make_artefact_shape(
    curvature_mm: float,
    radius_mm: float,
    lean_x: float,
    lean_y: float,
    form_um: FloatArray | None = None,
) -> film_shape.FilmShape:
    """A concave sphere, or a flat, in the mirror's place.

    Parameters
    ----------
    curvature_mm : float
        Radius of curvature; infinite for a flat.
    radius_mm : float
        Radius of the artefact's rim.
    lean_x, lean_y : float
        Slopes at the vertex: a sphere that leans by 1 mrad has micrometres of coma.
    form_um : (terms,) array, optional
        Noll terms of its form error.

    Returns
    -------
    FilmShape
        The upright sphere as its bowl, and what leaning and form error add as Zernike terms.
    """
    coeffs_um = np.zeros(_LEANING_TERMS)
    if form_um is not None:
        coeffs_um = np.array(form_um)
    coeffs_um[1:3] += 1e3 * radius_mm / 2 * np.array([lean_x, lean_y])
    if isinf(curvature_mm):
        return film_shape.FilmShape(0.0, radius_mm, "paraboloid", tuple(coeffs_um.tolist()))

    # Points of the unit disc: rings of equal area, spokes.
    ring_radii = np.sqrt((np.arange(_FITTED_RINGS) + 0.5) / _FITTED_RINGS)
    angles = 2 * pi * np.arange(_FITTED_RINGS) / _FITTED_RINGS
    rho, theta = np.meshgrid(ring_radii, angles)
    x = (rho * np.cos(theta)).ravel()
    y = (rho * np.sin(theta)).ravel()

    # Heights of the leaning sphere, with its centre at R (-lean_x, -lean_y, 1) / length, and of the
    # upright one.
    length = sqrt(1 + lean_x**2 + lean_y**2)
    centre = curvature_mm * np.array([-lean_x, -lean_y, 1.0]) / length
    from_axis = (radius_mm * x - centre[0]) ** 2 + (radius_mm * y - centre[1]) ** 2
    leaning = centre[2] - np.sqrt(curvature_mm**2 - from_axis)
    upright = curvature_mm - np.sqrt(curvature_mm**2 - radius_mm**2 * (x * x + y * y))

    # Their difference without the tilt, which is in the terms already, as Zernike terms.
    tilt = radius_mm * (lean_x * x + lean_y * y)
    terms = [zernike_polynomials.zernike_polynomial(row) for row in np.eye(coeffs_um.size)]
    design = np.stack([np.polynomial.polynomial.polyval2d(x, y, term) for term in terms], axis=1)
    coeffs_um += 1e3 * np.linalg.lstsq(design, leaning - upright - tilt, rcond=None)[0]
    sag_mm = curvature_mm - sqrt(curvature_mm**2 - radius_mm**2)
    return film_shape.FilmShape(sag_mm, radius_mm, "sphere", tuple(coeffs_um.tolist()))


@dataclass(frozen=True, slots=True)
class SimulationSpec:
    """One simulated capture set. Raises ValueError naming the field and a valid value.

    Attributes
    ----------
    optics : OpticsConfig
        The bench as it truly is, with the camera's depth (`bits`) and noise and the pattern's
        steps.
    film : film_shape.FilmShape
        Its sag belongs to displacement 0.
    kind : "full" or "fringes" or "frequencies"
        18 frames (for four steps), the sinusoids alone, or the sinusoids of several periods.
    reference : str
        The full set whose fringe orders anchor a fringes set, as `../0000`.
    shifts_rad : tuple of float
        One phase shift a step, written into each frame; empty: 2 pi k / N, not written.
    coarser_mm : tuple of float
        Further periods of a set of kind "frequencies", longer than the pattern's.
    motion : Motion
        Motion of the film on the run's clock.
    displacements_um : tuple of float
        Displacements instead of `motion`: one a frame, in the order of `patterns`.
    start_s : float
        Start of the first exposure on the run's clock.
    frame_interval_s : float
    laser : bool
        Whether the frames carry the laser's reading.
    laser_noise_um : float
        Standard deviation of that reading.
    stated_geometry : GeometryConfig, optional
        Geometry in `capture.toml` if not the true one.
    stated_mirror : MirrorConfig, optional
        Mirror in `capture.toml` if not that of `optics`.
    front : FrontFilm, optional
        The clear film in front of the mirror, as it truly is.
    light : pattern_levels.Light
    screen_error : bench_poses.ScreenError, optional
    disturbances : DisturbancesConfig
    drum_nm : float
        Amplitude of each of the film's vibrations.
    exact : bool
    seed : int
    artefact : Mapping[str, str | float]
        `[artefact]` of a set that shows one.
    screen_moved : Mapping[str, Any]
        `[screen_moved]`, if the true one is elsewhere.
    mirror_turned : Mapping[str, Any]
        `[mirror_turned]`, if the mirror was turned about its axis.
    seat : MirrorSeat, optional
        Where such a mirror truly stands; `film` is as it is seen there.
    faults : tuple of FrameFault
        Faults of single frames.
    stiffness_n_per_m : float
        Modulus times thickness, for the gauge's reading.
    """

    optics: OpticsConfig
    film: film_shape.FilmShape
    kind: Literal["full", "fringes", "frequencies"] = "full"
    reference: str = ""
    shifts_rad: tuple[float, ...] = ()
    coarser_mm: tuple[float, ...] = ()
    motion: Motion = Motion()
    displacements_um: tuple[float, ...] = ()
    start_s: float = 0.0
    frame_interval_s: float = 0.1
    laser: bool = True
    laser_noise_um: float = 0.0
    stated_geometry: GeometryConfig | None = None
    stated_mirror: MirrorConfig | None = None
    front: FrontFilm | None = None
    light: pattern_levels.Light = field(default_factory=pattern_levels.Light)
    screen_error: bench_poses.ScreenError | None = None
    disturbances: DisturbancesConfig = field(default_factory=DisturbancesConfig)
    drum_nm: float = 0.0
    exact: bool = False
    seed: int = 1
    artefact: Mapping[str, str | float] = field(default_factory=dict)
    screen_moved: Mapping[str, Any] = field(default_factory=dict)
    mirror_turned: Mapping[str, Any] = field(default_factory=dict)
    seat: MirrorSeat | None = None
    faults: tuple[FrameFault, ...] = ()
    stiffness_n_per_m: float = gas_film.MODULUS_PA * gas_film.MIRROR_FILM.thickness_um * 1e-6

    def __post_init__(self) -> None:
        # What belongs to one kind of set alone.
        if self.kind == "fringes" and not self.reference:
            raise ValueError(
                "reference: a fringes set needs the full set that anchors it, as ../0000"
            )
        if self.kind != "fringes" and self.reference:
            raise ValueError("reference: only a fringes set has one")
        if (self.kind == "frequencies") != bool(self.coarser_mm):
            raise ValueError(
                "coarser_mm: a set of several frequencies has further periods, any other has none"
            )
        if any(
            not isfinite(period) or period <= self.optics.pattern.period_mm
            for period in self.coarser_mm
        ):
            raise ValueError(
                "coarser_mm: every period must exceed period_mm = "
                f"{self.optics.pattern.period_mm:g}"
            )
        if len(set(self.coarser_mm)) < len(self.coarser_mm):
            raise ValueError("coarser_mm: a period occurs twice")

        # One number for each phase step and each frame, all finite.
        if self.shifts_rad and len(self.shifts_rad) != self.optics.pattern.steps:
            raise ValueError(
                f"shifts_rad: {len(self.shifts_rad)} shifts for steps = {self.optics.pattern.steps}"
            )
        if self.displacements_um and self.motion != Motion():
            raise ValueError("displacements_um: give these or motion, not both")
        names = [pattern.name for pattern in self.patterns]
        if self.displacements_um and len(self.displacements_um) != len(names):
            raise ValueError(
                f"displacements_um: {len(self.displacements_um)} values for {len(names)} frames"
            )
        if not all(isfinite(self.displacement_um(frame)) for frame in range(len(names))):
            raise ValueError("motion, displacements_um: every value must be a number")
        for name, value in (
            ("frame_interval_s", self.frame_interval_s),
            ("laser_noise_um", self.laser_noise_um),
            ("seed", self.seed),
        ):
            if not (isfinite(value) and value >= 0):
                raise ValueError(f"{name} = {value} must be 0 or more")

        # Faults of frames that the set has; a stale frame needs one before it, a swapped one after.
        for fault in self.faults:
            if fault.frame not in names:
                raise ValueError(
                    f"faults: no frame {fault.frame!r} in this set ({names[0]} .. {names[-1]})"
                )
            if (fault.kind, fault.frame) in (("stale", names[0]), ("swapped", names[-1])):
                raise ValueError(f"faults: {fault.frame} has no neighbour to be {fault.kind} with")

    @property
    def patterns(self) -> list[Pattern]:
        """The patterns, frame by frame."""
        return pattern_levels.pattern_sequence(
            self.kind, self.optics.pattern, self.shifts_rad, self.coarser_mm
        )

    def time_s(self, frame: int) -> float:
        """Start of exposure of a frame on the run's clock."""
        return self.start_s + frame * self.frame_interval_s

    def displacement_um(self, frame: int) -> float:
        """True position of the film during a frame (faults aside)."""
        if self.displacements_um:
            return self.displacements_um[frame]
        return self.motion.at_um(self.time_s(frame))

    def pressure_pa(self, displacement_um: float) -> float:
        """Gauge pressure under a Hencky film there."""
        load, _ = self.film.load_and_bowl(displacement_um)
        return load * self.stiffness_n_per_m / (1e-3 * self.film.radius_mm)

    @property
    def reference_um(self) -> float:
        """Displacement for which the geometry holds: as stated, or that of the first frame."""
        geometry = self.stated_geometry or self.optics.geometry
        stated_um = geometry.reference_displacement_um
        if stated_um is None:
            return self.displacement_um(0)
        return stated_um
