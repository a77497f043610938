"""The paper's bench with one full capture set: simulated in memory, or recorded."""

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.optics import GeometryConfig
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.measure.capture_set import read_head, read_set
from membrane_ctrl.measure.measurement import stack_of
from membrane_ctrl.measure.simulate import shrink_camera
from membrane_ctrl.metrology.figure.pixel_figure import (
    FullResult,
    PixelPoints,
    measure_pixels,
    reconstruct_full,
)
from membrane_ctrl.metrology.film.film_law import FilmLaw
from membrane_ctrl.metrology.frame_checks.checked_set import Checked, RejectedSetError
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase import pattern_sequence
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.model import errors
from membrane_ctrl.paper.reference_pmd import PaperGeometry
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.trace import Trace

# The film of the paper's section 3.1: modulus, thickness, Poisson ratio and pressure.
MODULUS_PA = 4.1e9
THICKNESS_M = 50e-6
POISSON = 0.3
PRESSURE_PA = 600.0
STIFFNESS_N_PER_M = MODULUS_PA * THICKNESS_M
EDGE_BELOW_HENCKY_MM = 3.0  # at the edge; the paper does not give its sign
# The paper's geometry (section 2.3), with its standard uncertainties.
GEOMETRY = GeometryConfig(
    a_mm=2672.0,
    b_mm=2871.0,
    alpha_deg=80.9,
    a_sigma_mm=2.0,
    b_sigma_mm=2.0,
    alpha_sigma_deg=0.3,
    reference_displacement_um=0.0,
)
PIXEL_NOISE_ADU = 0.4  # section 3.1
_STRAINS = np.linspace(0.0, 5e-3, 200)


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """How large and how long the computation is.

    Attributes
    ----------
    shrink : int
        Pixels of the paper's camera for each pixel computed, along a side.
    sets : int
        Sets of the stability series; the paper has 451.
    trials : int
        Monte Carlo trials; the paper has 100.
    seed : int
    scheduler : str or None
        Address of a Dask scheduler that runs the trials.
    """

    shrink: int = 2
    sets: int = 451
    trials: int = 100
    seed: int = 1
    scheduler: str | None = None


def find_prestrain() -> float:
    """The pre-strain that makes the film 3 mm less deep than Hencky's at the paper's pressure."""
    # The sag that each of many pre-strains costs, and the one that costs the paper's 3 mm.
    ideal = FilmLaw(0.0, POISSON, STIFFNESS_N_PER_M, 500.0).under_pressure(PRESSURE_PA)
    strained = FilmLaw(_STRAINS[:, None], POISSON, STIFFNESS_N_PER_M, 500.0).under_pressure(
        PRESSURE_PA
    )
    missing_mm = float(ideal.sag_mm) - strained.sag_mm.ravel()
    return float(np.interp(EDGE_BELOW_HENCKY_MM, missing_mm, _STRAINS))


class MeasuredBench(ABC):
    """A bench with one full capture set; everything is computed when first used.

    Parameters
    ----------
    options : PaperOptions
        How large the computation is.
    optics : OpticsConfig
        Its geometry is in the short form: a, b and alpha.
    """

    def __init__(self, options: PaperOptions, optics: OpticsConfig) -> None:
        self.options = options
        self.optics = optics

    @property
    @abstractmethod
    def stack(self) -> FrameStack:
        """The 18 frames."""

    @property
    @abstractmethod
    def pixels_of_camera(self) -> int:
        """Pixels of the bench's camera for each pixel of the frames."""

    @property
    def geometry(self) -> PaperGeometry:
        """a, b and alpha for the paper's own equations. Raises InputError for another form."""
        stated = self.optics.geometry
        if stated.a_mm is None or stated.b_mm is None or stated.alpha_deg is None:
            raise errors.InputError(
                "geometry: the paper's equations need a_mm, b_mm and alpha_deg; general poses and "
                "calibrated geometries have none"
            )
        return PaperGeometry(stated.a_mm, stated.b_mm, math.radians(stated.alpha_deg))

    @property
    def has_angle(self) -> bool:
        """Whether the geometry is given as a, b and alpha."""
        stated = self.optics.geometry
        return None not in (stated.a_mm, stated.b_mm, stated.alpha_deg)

    @property
    def geometry_sigmas(self) -> tuple[float, float, float]:
        """Standard uncertainties of a and b, mm, and of alpha, rad: as stated, or the paper's."""
        own = self.optics.geometry
        stated = (own.a_sigma_mm, own.b_sigma_mm, own.alpha_sigma_deg)
        paper = (GEOMETRY.a_sigma_mm, GEOMETRY.b_sigma_mm, GEOMETRY.alpha_sigma_deg)
        a_mm, b_mm, alpha_deg = (
            (theirs or 0.0) if mine is None else mine
            for mine, theirs in zip(stated, paper, strict=True)
        )
        return a_mm, b_mm, math.radians(alpha_deg)

    @property
    def patterns(self) -> tuple[Pattern, ...]:
        """The 18 patterns."""
        return self.stack.patterns

    @cached_property
    def checked(self) -> Checked:
        """The set with its frames checked and its bins fitted. Raises RejectedError."""
        try:
            return check_set(self.stack, self.optics, None)
        except RejectedSetError as error:
            raise errors.RejectedError(f"the full set is rejected: {error}") from None

    @cached_property
    def pixels(self) -> PixelPoints:
        """All pixels that see the pattern."""
        return measure_pixels(self.optics, self.checked)

    @cached_property
    def full(self) -> FullResult:
        """The figure from all pixels."""
        return reconstruct_full(self.optics, self.checked, self.pixels)


class PaperBench(MeasuredBench):
    """The paper's bench and film, simulated."""

    def __init__(self, options: PaperOptions) -> None:
        default = OpticsConfig()
        camera = shrink_camera(default.camera, options.shrink)
        camera = camera.model_copy(update={"noise_adu": PIXEL_NOISE_ADU})
        optics = default.model_copy(update={"geometry": GEOMETRY, "camera": camera})
        super().__init__(options, optics)

    @property
    def pixels_of_camera(self) -> int:
        """The paper's camera has more pixels than the frames of a smaller computation."""
        return self.options.shrink**2

    @cached_property
    def film(self) -> FilmShape:
        """A film with the pre-strain that explains the paper's edge, mounted by hand."""
        prestrain = find_prestrain()
        radius_mm = self.optics.mirror.radius_mm
        law = FilmLaw(prestrain, POISSON, STIFFNESS_N_PER_M, radius_mm)
        sag_mm = float(law.under_pressure(PRESSURE_PA).sag_mm)
        return typical_film(sag_mm, radius_mm, self.options.seed, prestrain, POISSON)

    @cached_property
    def renderer(self) -> OpticsRenderer:
        """The twin's renderer, whose rays share no code with the reconstruction."""
        return OpticsRenderer(self.optics, self.film, seed=self.options.seed)

    @cached_property
    def stack(self) -> FrameStack:
        """The 18 frames of the film at rest."""
        patterns = pattern_sequence.full_sequence(self.optics.pattern)
        camera = self.optics.camera
        # the simulated camera has 8 bits, as the paper's
        frames = np.empty((len(patterns), camera.height_px, camera.width_px), np.uint8)
        for frame, pattern in zip(frames, patterns, strict=True):
            self.renderer.render_picture(pattern, 0.0, out=frame)
        return FrameStack(frames, patterns, np.zeros(len(patterns)), {})

    @cached_property
    def truth(self) -> Trace:
        """What each pixel truly sees, by the twin's rays."""
        return self.renderer.trace_pixels(0.0)


class RecordedBench(MeasuredBench):
    """A bench whose sets were recorded: a folder with one folder for each set.

    The first set in the order of their names is full.

    Parameters
    ----------
    options : PaperOptions
        How large the computation is.
    folder : Path
        The folder of the sets.

    Raises
    ------
    InputError
        There is no set, the first one is not full, or a set is of another mirror.
    RejectedError
        The first set is incomplete.
    """

    def __init__(self, options: PaperOptions, folder: Path) -> None:
        self.folders = find_sets(folder)
        capture = read_set(self.folders[0])
        if capture.head.kind != "full":
            raise errors.InputError(f"{self.folders[0]}: the first set must be a full one")
        try:
            self._stack = stack_of(capture)
        except RejectedSetError as error:
            raise errors.RejectedError(f"{self.folders[0]}: rejected: {error}") from None
        super().__init__(options, capture.head.optics)
        # found here, because computing the sets takes long
        for other in self.folders[1:]:
            if read_head(other).optics.mirror != self.optics.mirror:
                raise errors.InputError(
                    f"{other / 'capture.toml'}: [mirror] is not that of the first set"
                )

    @property
    def stack(self) -> FrameStack:
        """The frames of the first set."""
        return self._stack

    @property
    def pixels_of_camera(self) -> int:
        """The frames are the camera's own."""
        return 1


def fingerprint_sets(folders: Sequence[Path]) -> str:
    """A digest of the names, sizes and times of the sets' files: another one means other sets.
    Raises InputError.
    """
    digest = hashlib.sha256()
    for folder in folders:
        try:
            for path in sorted(folder.iterdir()):
                status = path.stat()
                row = (folder.name, path.name, status.st_size, status.st_mtime_ns)
                digest.update(repr(row).encode())
        except OSError as error:
            raise errors.InputError(f"{folder}: {errors.os_reason(error)}") from None
    return digest.hexdigest()


def find_sets(folder: Path) -> list[Path]:
    """Folders of the sets of a run, in the order of their names. Raises InputError if there are
    none.
    """
    try:
        sets = sorted(path.parent for path in folder.glob("*/capture.toml"))
    except OSError as error:
        raise errors.InputError(f"{folder}: {errors.os_reason(error)}") from None
    if not sets:
        raise errors.InputError(f"{folder}: no sets; each is a folder with a capture.toml")
    return sets
