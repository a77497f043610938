"""A live calibration: its setpoints, and its folder `<logs>/calibration/<UTC>-<name>/` of plan,
sets and geometry.
"""

import math
import shutil
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np

from membrane_ctrl.config import schema
from membrane_ctrl.control.setpoint_ramp import RAMP_SHARE
from membrane_ctrl.geometry.file import GeometryFile, GeometryOrigin, read_geometry
from membrane_ctrl.metrology.calibration.verdict import GOOD_SPREAD_UM, LEAST_SPREAD_UM
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model import errors, files
from membrane_ctrl.sessions.folder import begin_session, read_session

SCHEMA = "membrane-live-calibration/1"


@dataclass(frozen=True, slots=True)
class CalibrationHead:
    """`session.json`."""

    source: str  # the run it started on
    created_utc: str
    # Setpoint to return to; the measurements by hand are assumed valid there
    start_um: float
    shape_on: bool  # whether the shape loop was on
    setpoints_um: tuple[float, ...]  # of the sets, in their order


@dataclass(frozen=True, slots=True)
class CalibrationSession:
    """A live calibration on disk; it continues with the missing sets."""

    path: Path
    head: CalibrationHead
    config: schema.Config

    @property
    def sets(self) -> tuple[Path, ...]:
        """Folders of all sets, existing or not."""
        return tuple(
            self.path / "sets" / f"set-{k + 1}" for k in range(len(self.head.setpoints_um))
        )

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices of the missing sets."""
        return tuple(k for k, folder in enumerate(self.sets) if not folder.exists())

    @property
    def geometry(self) -> Path:
        """Path of the result."""
        return self.path / "geometry.toml"

    def keep(self, index: int, taken: Path) -> None:
        """Copy a set from the run's folder, atomically. Raises DeviceError."""
        folder = self.sets[index]
        part = folder.with_name(f".{folder.name}.part")
        try:
            folder.parent.mkdir(exist_ok=True)
            shutil.rmtree(part, ignore_errors=True)
            shutil.copytree(taken, part)
            part.replace(folder)
        except (OSError, shutil.Error) as error:
            raise errors.DeviceError(
                f"{folder}: cannot copy the set {taken} here ({error})"
            ) from None


def begin(
    logs: Path, name: str, head: CalibrationHead, config: schema.Config
) -> CalibrationSession:
    """Begin a session. Raises errors.InputError for a bad name, DeviceError if it cannot be
    written.
    """
    return CalibrationSession(
        begin_session(logs / "calibration", name, head, config, SCHEMA), head, config
    )


def resume(path: Path) -> CalibrationSession:
    """Open an existing session. Raises errors.InputError if it is not one."""
    return CalibrationSession(path, *read_session(path, CalibrationHead, SCHEMA))


# Comparison of old and new geometry, and the exchange of the files.


def compared(optics: schema.OpticsConfig, origin: GeometryOrigin, new: GeometryFile) -> list[str]:
    """The geometry in force (`optics`, `origin`) beside the new one, in numbers that a tape measure
    can check.
    """
    old = "by hand" if not origin.calibrated_utc else f"calibrated {origin.calibrated_utc}"
    lines = [
        f"in force: {old}, hash {origin.hash}; new: hash {new.origin.hash}",
        f"{'':<28}{'in force':>12}{'new':>12}",
    ]
    rows = zip(
        _by_tape(Geometry.from_config(optics)),
        _by_tape(Geometry.from_config(new.over(optics))),
        strict=True,
    )
    lines += [f"{name:<28}{before:>12.3f}{after:>12.3f}" for (name, before), (_, after) in rows]
    return lines


def _by_tape(geometry: Geometry) -> list[tuple[str, float]]:
    pinhole, screen = geometry.pinhole_mm, geometry.screen_origin_mm
    facing = np.cross(geometry.screen_s_x, geometry.screen_s_y)
    leans = np.degrees(np.arccos(np.clip(abs(facing @ screen) / np.linalg.norm(screen), -1.0, 1.0)))
    return [
        ("a, vertex to pinhole, mm", float(np.linalg.norm(pinhole))),
        ("b, vertex to screen, mm", float(np.linalg.norm(screen))),
        (
            "alpha of the camera, deg",
            float(np.degrees(np.arctan2(pinhole[2], np.hypot(pinhole[0], pinhole[1])))),
        ),
        ("the screen leans by, deg", float(leans)),
    ]


def adopt(new: Path, place: Path) -> Path | None:
    """Put a geometry where the configuration looks for it; returns where the previous one is kept.

    Raises DeviceError if it cannot be written; the old one then stays in place.
    """
    with errors.writing(place, errors.DeviceError):
        place.parent.mkdir(parents=True, exist_ok=True)
        place = files.users(place)
        kept = _kept(place) if place.exists() else None
        if kept is not None:
            files.write_bytes_atomic(kept, files.read_bytes(place, files.SMALL_BYTES, follow=True))
        files.write_text_atomic(place, files.read_text(new))
    return kept


def _kept(place: Path) -> Path:
    """A free name with the date of the calibration, or of the file if a person wrote it."""
    try:
        written = datetime.fromisoformat(read_geometry(place).origin.calibrated_utc)
    except (errors.InputError, ValueError):
        written = datetime.fromtimestamp(place.stat().st_mtime, UTC)
    stem = f"{place.stem}-{written.astimezone(UTC):%Y%m%dT%H%M%SZ}"
    for number in range(1, 1000):
        kept = place.with_name(f"{stem}{'' if number == 1 else f'-{number}'}{place.suffix}")
        if not kept.exists():
            return kept
    raise OSError(f"a thousand files {stem} exist")


# Of the limiting pressure: it gives the sag of a Hencky bowl to a per cent, and a sag gives the
# pressure to three; a pretensioned film needs less extra pressure than this for more depth
_PRESSURE_SHARE = 0.95
# at a setpoint: the gas is back at the air's temperature (12 s), and the ramp has no more effect
SETTLE_S = 15.0
# The current cycle ends first, then 18 frames, their reconstruction and writing
_SET_S = 15.0
_PIECES = 8  # to integrate a move's duration: the leak grows with the cube of the depth


@dataclass(frozen=True, slots=True)
class HeldMirror:
    """The held mirror before any move."""

    setpoint_um: float  # without the trim
    sag_mm: float  # seen by the camera with the geometry in force
    pressure_pa: float  # gauge reading
    leak_um_per_s: float  # speed at which the centre sinks without the pump
    swing_adu: float  # amplitude of the fringes
    shape_on: bool  # whether the shape loop is on

    def sag_at_mm(self, setpoint_um: float) -> float:
        """Sag at another setpoint; the ring does not move."""
        return self.sag_mm + 1e-3 * (setpoint_um - self.setpoint_um)

    def leak_at_um_per_s(self, setpoint_um: float) -> float:
        """Leak at another setpoint: like the pressure,
        it grows with the cube of the sag (Hencky).
        """
        return self.leak_um_per_s * float(self.sag_at_mm(setpoint_um) / self.sag_mm) ** 3


@dataclass(frozen=True, slots=True)
class Reach:
    """Range of the setpoint, and what limits it."""

    low_um: float
    high_um: float
    low_why: str
    high_why: str


def reach_of(held: HeldMirror, config: schema.Config) -> Reach:
    """The safety table's limits less a margin: a lagging mirror must
    not trip them during a move.
    """
    limits, margin_um = config.limits, config.limits.following_error_max_um
    high_um, why = limits.displacement_max_um - margin_um, "limits.displacement_max_um"
    if held.pressure_pa > 0:
        share = _PRESSURE_SHARE * limits.gauge_pressure_max_pa / held.pressure_pa
        by_pressure_um = held.setpoint_um + 1e3 * held.sag_mm * (share ** (1 / 3) - 1)
        if by_pressure_um < high_um:
            high_um, why = by_pressure_um, "limits.gauge_pressure_max_pa"
    low_um = limits.displacement_min_um + margin_um
    return Reach(math.ceil(low_um), math.floor(high_um), "limits.displacement_min_um", why)


def setpoints_um(
    held: HeldMirror, reach: Reach, range_um: float | None, sets: int
) -> tuple[float, ...]:
    """Setpoints of the sets, evenly spaced about where the mirror is held, nearer end first.

    Raises errors.InputError if there is no room for what is asked, or for less than 1 mm.

    Parameters
    ----------
    reach : Reach
        The range is shifted to fit into it.
    range_um : float or None
        From the first to the last; None: 8 mm, or less if limited.
    sets : int
        Number of sets.
    """
    room_um = reach.high_um - reach.low_um
    allowed = f"{reach.low_why} and {reach.high_why} leave {max(room_um, 0.0):.0f} µm"
    if range_um is not None and range_um > room_um:
        raise errors.InputError(
            f"--range-um {range_um:g}: {allowed}; reduce it, or widen the limits if the film allows"
        )
    wide_um = min(GOOD_SPREAD_UM, room_um) if range_um is None else range_um
    if wide_um < LEAST_SPREAD_UM:
        what = allowed if range_um is None else f"--range-um {range_um:g}"
        raise errors.InputError(
            f"{what}: sets closer together than {LEAST_SPREAD_UM:.0f} µm add nothing to one set; "
            f"{GOOD_SPREAD_UM:.0f} µm is good"
        )
    low_um = min(max(held.setpoint_um - wide_um / 2, reach.low_um), reach.high_um - wide_um)
    ascending = [float(each) for each in np.round(np.linspace(low_um, low_um + wide_um, sets), 1)]
    return tuple(sorted(ascending, reverse=held.setpoint_um - low_um > wide_um / 2))


def way_s(held: HeldMirror, from_um: float, to_um: float, config: schema.Config) -> float:
    """Duration of the setpoint's ramp; inf if the mirror does not sink,
    or the pump has no reserve.
    """
    loop, most_um_per_s = config.loop, config.loop.flow_most_um_per_s(config.pump)
    total_s = 0.0
    for a_um, b_um in pairwise(np.linspace(from_um, to_um, _PIECES + 1).tolist()):
        leak_um_per_s = held.leak_at_um_per_s((a_um + b_um) / 2)
        free_um_per_s = most_um_per_s - leak_um_per_s if b_um > a_um else leak_um_per_s
        speed_um_per_s = min(loop.setpoint_ramp_um_per_s, RAMP_SHARE * free_um_per_s)
        total_s += abs(b_um - a_um) / speed_um_per_s if speed_um_per_s > 0 else float("inf")
    return total_s


def step_s(held: HeldMirror, from_um: float, to_um: float, config: schema.Config) -> float:
    """Duration of the move, of settling and of the set."""
    return way_s(held, from_um, to_um, config) + SETTLE_S + _SET_S
