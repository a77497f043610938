"""Capture sets on disk (docs/reference/interfaces.md, section 3): `capture.toml` and one image per
frame, read and checked.

An invalid description of a set is an InputError. Defects of single frames (missing, unreadable,
different size or depth) are kept beside the frames: the measurement decides whether it can do
without.
"""

import math
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import Field

from firmware_iface.optical_roles import Pattern
from firmware_iface.settings import Section
from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.config.origin import OriginSection
from membrane_ctrl.geometry.file import GeometryFile, GeometryOrigin, stated_origin
from membrane_ctrl.geometry.set_tables import (
    ArtefactTable,
    MirrorTurnedTable,
    ScreenMovedTable,
    move_screen,
)
from membrane_ctrl.measure.images import IMAGE_BYTES_MAX, decoded_image
from membrane_ctrl.measure.pixel_format import find_pixel_mistake, find_size_mistake
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence, full_sequence
from membrane_ctrl.metrology.rays.artefacts import Artefact
from membrane_ctrl.metrology.rays.turned_mirror import TurnedMirror
from membrane_ctrl.model.arrays import FloatArray, Image
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.files import read_bytes

_DEPTHS = (10, 12, 14, 16)  # bits of a sensor in 16-bit files, if not stated
_READERS = 2
# All frames of a set are in memory at once: 18 of a camera of 16 megapixels.
_PIXELS_MAX = 300_000_000


class FrameRow(Section):
    """One `[[frames]]` table."""

    file: str
    role: Literal["sin", "gray", "white", "black"]
    axis: Literal["x", "y"] | None = None
    index: Annotated[int, Field(ge=0, le=1023)] = 0
    shift_rad: float | None = None
    period_mm: Annotated[float, Field(gt=0, le=1e4)] | None = None
    time_s: float | None = None
    displacement_um: float | None = None


class CaptureFile(OriginSection):
    """The content of `capture.toml`."""

    schema_: Annotated[Literal["membrane-capture/1"], Field(alias="schema")]
    kind: Literal["full", "fringes", "frequencies"]
    reference: str | None = None
    pressure_pa: Annotated[float, Field(gt=0, le=1e5)] | None = None
    pattern: schema.PatternConfig
    geometry: schema.GeometryConfig
    camera: schema.CameraConfig
    mirror: schema.MirrorConfig
    artefact: ArtefactTable | None = None
    screen_moved: ScreenMovedTable | None = None
    mirror_turned: MirrorTurnedTable | None = None
    frames: tuple[FrameRow, ...]


@dataclass(frozen=True)
class CaptureHead:
    """Content of `capture.toml`, checked and in order.

    Attributes
    ----------
    folder : Path
        Folder of the set.
    kind : "full" or "fringes" or "frequencies"
    reference : Path, optional
        The full set that anchors a fringes set.
    optics : schema.OpticsConfig
        Geometry, camera, pattern and mirror; `camera.bits` is valid only if `bits_stated`.
    bits_stated : bool
        Whether the set states its bit depth.
    files : tuple of str
        File names, in the order of the patterns.
    patterns : tuple of Pattern
        The x sinusoids, x Gray bits, y sinusoids, y Gray bits, white, black (of a full set).
    time_s : (frames,) array
        Time of each frame; NaN where not stated.
    displacement_um : (frames,) array
        Laser reading of each frame; NaN where not stated.
    pressure_pa : float
        Gauge pressure during the set; NaN where not stated.
    ignored : tuple of str
        Unknown keys of the file.
    geometry : GeometryOrigin
        Origin of the geometry in `optics`.
    artefact : Artefact | Literal['screen'], optional
        The object that is seen instead of the film.
    screen_moved : ScreenMovedTable, optional
        Move of the screen from its usual place; `optics` has it after the move.
    before_move : schema.GeometryConfig, optional
        The geometry before the move.
    turned : TurnedMirror, optional
        How the mirror stood, if it was turned about its axis.
    """

    folder: Path
    kind: Literal["full", "fringes", "frequencies"]
    reference: Path | None
    optics: schema.OpticsConfig
    bits_stated: bool
    files: tuple[str, ...]
    patterns: tuple[Pattern, ...]
    time_s: FloatArray
    displacement_um: FloatArray
    pressure_pa: float
    ignored: tuple[str, ...]
    geometry: GeometryOrigin
    artefact: Artefact | Literal["screen"] | None = None
    screen_moved: ScreenMovedTable | None = None
    before_move: schema.GeometryConfig | None = None
    turned: TurnedMirror | None = None

    @property
    def finest_frames(self) -> list[int]:
        """Frames of the finest sinusoids, which are measured."""
        return [k for k, p in enumerate(self.patterns) if p.role == "sin" and not p.period_mm]

    @property
    def mean_reading_um(self) -> float:
        """Mean laser reading during them, to which the figure belongs; NaN unless all have one."""
        return float(np.mean(self.displacement_um[self.finest_frames]))


@dataclass(frozen=True)
class CaptureSet:
    """A set with its frames.

    Attributes
    ----------
    head : CaptureHead
        Its `optics.camera.bits` is now the true depth.
    frames : (frames, height, width) array
        uint8 or uint16; zeros where a frame is in `unusable`.
    unusable : dict from frame to reason
        Frames that could not be read like the others.
    lost : tuple of int
        Those among them without any picture.
    """

    head: CaptureHead
    frames: Image
    unusable: dict[int, str]
    lost: tuple[int, ...] = ()


def read_head(folder: str | Path, geometry: GeometryFile | None = None) -> CaptureHead:
    """Read `capture.toml` of a set.

    Parameters
    ----------
    folder : str or Path
        The set.
    geometry : GeometryFile or None
        Replaces the set's own geometry, with the lens and pitch calibrated with it.

    Returns
    -------
    CaptureHead

    Raises
    ------
    InputError
        The file is missing or describes no valid set.
    """
    folder = Path(folder)
    path = folder / "capture.toml"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such capture set")
    tables = toml_file.read_toml(path, follow=False)
    toml_file.with_height_map(tables.get("geometry"), path, follow=False)
    ignored = toml_file.prune_unknown_keys(tables, CaptureFile)
    if geometry is not None:
        tables["geometry"] = geometry.geometry.model_dump(exclude_none=True)
    bits_stated = isinstance(tables.get("camera"), dict) and "bits" in tables["camera"]

    # The frames in order, all of them in the folder, and the reference.
    content = toml_file.parse_tables(tables, CaptureFile, str(path))
    rows = _order_rows(content, path)
    reference = None
    for row in content.frames:
        require_inside(row.file, folder, path)
    if content.kind == "fringes":
        if content.reference is None:
            raise InputError(f"{path}: reference: a fringes set names the full set that anchors it")
        reference = reference_of(content.reference, folder, path)

    # The bench. If screen and pattern are incompatible, the error names the geometry's file.
    sections = ("geometry", "camera", "pattern", "mirror")
    bench_tables = {name: getattr(content, name) for name in sections}
    bench_path = path
    if geometry is not None:
        bench_path = geometry.path
    optics = toml_file.parse_tables(bench_tables, schema.OpticsConfig, str(bench_path))
    if geometry is not None:
        optics = geometry.apply_to_optics(optics)
    if reference is None:
        optics = _with_reference_displacement(optics, content.frames[0].displacement_um)

    # A screen that was moved, and an artefact in the mirror's place.
    before = optics.geometry
    moved = content.screen_moved
    if moved is not None:
        optics = optics.model_copy(update={"geometry": move_screen(before, moved.shift_mm)})
    origin = stated_origin(optics) if geometry is None else geometry.origin
    artefact = None
    if content.artefact is not None:
        artefact = content.artefact.make_artefact(content.mirror.radius_mm, path)
    return CaptureHead(
        folder=folder,
        kind=content.kind,
        reference=reference,
        optics=optics,
        bits_stated=bits_stated,
        files=tuple(row.file for row, _ in rows),
        patterns=tuple(pattern for _, pattern in rows),
        time_s=_to_number_column([row.time_s for row, _ in rows]),
        displacement_um=_to_number_column([row.displacement_um for row, _ in rows]),
        pressure_pa=math.nan if content.pressure_pa is None else content.pressure_pa,
        ignored=ignored,
        geometry=origin,
        artefact=artefact,
        screen_moved=moved,
        before_move=before,
        turned=None if content.mirror_turned is None else content.mirror_turned.make_turn(),
    )


def read_set(folder: str | Path, geometry: GeometryFile | None = None) -> CaptureSet:
    """Read a capture set with its images.

    Parameters
    ----------
    folder, geometry
        As for `read_head`.

    Returns
    -------
    CaptureSet

    Raises
    ------
    InputError
        As `read_head`; also if no frame is usable, or the frames have too many pixels.
    """
    head = read_head(folder, geometry)
    camera = head.optics.camera
    if len(head.files) * camera.width_px * camera.height_px > _PIXELS_MAX:
        raise InputError(
            f"{head.folder / 'capture.toml'}: camera.width_px, height_px: {len(head.files)} "
            f"frames of {camera.width_px} x {camera.height_px} pixels exceed the limit of "
            f"{_PIXELS_MAX / 1e6:.0f} million for a set"
        )
    with ThreadPoolExecutor(_READERS) as pool:
        images = list(pool.map(read_image, [head.folder / name for name in head.files]))
    return assemble_set(head, images)


def assemble_set(head: CaptureHead, images: Sequence[Image | str]) -> CaptureSet:
    """Collect the frames of one size and depth in one array.

    Parameters
    ----------
    head : CaptureHead
        The set's `capture.toml`.
    images : sequence of images or str
        Its frames; a text is the reason for the absence of an image.

    Raises
    ------
    InputError
        If no frame is readable, or if most contradict the camera in the file.
    """
    path = head.folder / "capture.toml"
    good = [image for image in images if not isinstance(image, str)]
    if not good:
        raise InputError(
            f"{path}: frames: none of the {len(images)} images is readable ({images[0]})"
        )

    # Size and depth that most frames have.
    camera = head.optics.camera
    size = (camera.height_px, camera.width_px)
    depth = _find_most_common([image.dtype for image in good])
    seen = _find_most_common([image.shape for image in good])
    if seen != size:
        problem = f"{size[1]} x {size[0]}, but the images are {seen[1]} x {seen[0]}"
        packing = find_size_mistake(seen, size, depth)
        if packing:
            problem += f"; {packing}, have this size: unpack them to one value a pixel"
        raise InputError(f"{path}: camera.width_px, height_px: {problem}")

    # The frames that have them, and why others are unusable.
    frames: Image = np.zeros((len(images), *size), depth)
    unusable: dict[int, str] = {}
    for k, image in enumerate(images):
        if isinstance(image, str):
            unusable[k] = image
        elif image.shape != size:
            unusable[k] = (
                f"wrong size: {image.shape[1]} x {image.shape[0]} pixels, the others "
                f"{size[1]} x {size[0]}"
            )
        elif image.dtype != depth:
            unusable[k] = (
                f"wrong bit depth: {8 * image.itemsize} bit, the others {8 * depth.itemsize} bit"
            )
        else:
            frames[k] = image
    if mistake := find_pixel_mistake(frames):
        raise InputError(
            f"{path}: frames: {mistake}: put right, neighbouring pixels differ several times "
            "less; convert the camera's data accordingly and write the images again"
        )
    bits = _find_sensor_bits(head, frames, path)
    optics = head.optics.model_copy(update={"camera": camera.model_copy(update={"bits": bits})})
    lost = tuple(k for k, image in enumerate(images) if isinstance(image, str))
    return CaptureSet(replace(head, optics=optics), frames, unusable, lost)


def anchor_head(head: CaptureHead, reference: CaptureHead) -> CaptureHead:
    """Return the head of a fringes set with the geometry of its stated displacement, else of its
    reference's.

    Parameters
    ----------
    head : CaptureHead
        Of the fringes set.
    reference : CaptureHead
        Of the set that gives its fringe orders.

    Returns
    -------
    CaptureHead

    Raises
    ------
    InputError
        The two cannot belong together: another camera, another pattern.
    """
    ours = head.optics
    theirs = reference.optics
    where = head.folder / "capture.toml"
    if reference.kind == "fringes":
        raise InputError(f"{where}: reference: {reference.folder} is a set of fringes alone")
    # Both must be of one camera and one pattern.
    for section in ("camera", "pattern"):
        a = getattr(ours, section)
        b = getattr(theirs, section)
        for key in ("width_px", "height_px", "periods", "period_mm"):
            if getattr(a, key, None) != getattr(b, key, None):
                raise InputError(
                    f"{where}: {section}.{key} = {getattr(a, key)}, the reference has "
                    f"{getattr(b, key)}"
                )
    displacement_um = theirs.geometry.reference_displacement_um
    return replace(head, optics=_with_reference_displacement(ours, displacement_um))


def _with_reference_displacement(
    optics: schema.OpticsConfig, displacement_um: float | None
) -> schema.OpticsConfig:
    """The head with the displacement for which its geometry holds, unless it states one."""
    geometry = optics.geometry
    if geometry.reference_displacement_um is not None or displacement_um is None:
        return optics
    update = {"reference_displacement_um": displacement_um}
    return optics.model_copy(update={"geometry": geometry.model_copy(update=update)})


def read_image(path: Path) -> Image | str:
    """The image, or the reason for its absence."""
    try:
        image = decoded_image(read_bytes(path, IMAGE_BYTES_MAX), cv2.IMREAD_UNCHANGED)
    except FileNotFoundError:
        return "missing: no such file"
    except OSError as error:
        return f"unreadable: {error.strerror or error}"
    except ValueError as error:
        return f"unreadable: {error}"
    if image.ndim != 2:
        return f"unreadable: {image.shape[2]} colour channels instead of one"
    if image.dtype not in (np.uint8, np.uint16):
        return f"wrong bit depth: {image.dtype} pixels"
    return image


def _find_sensor_bits(head: CaptureHead, frames: Image, path: Path) -> int:
    """Bits of the sensor: as stated, or the smallest usual depth that holds the brightest pixel."""
    bits = head.optics.camera.bits
    if not head.bits_stated:
        if frames.dtype == np.uint8:
            return 8
        return next(depth for depth in _DEPTHS if int(frames.max()) < 2**depth)
    if (bits == 8) != (frames.dtype == np.uint8):
        raise InputError(
            f"{path}: camera.bits = {bits}, but the images have {8 * frames.itemsize} bit pixels"
        )
    if int(frames.max()) >= 2**bits:
        raise InputError(f"{path}: camera.bits = {bits}, but pixels reach {int(frames.max())}")
    return bits


def require_inside(name: str, folder: Path, path: Path) -> None:
    """Refuse a file name that leads out of the set's folder: a set may come from anywhere.

    Parameters
    ----------
    name : str
        As the set states it, relative to its folder.
    folder : Path
        The set. Symbolic links on the way are followed before the comparison.
    path : Path
        Its `capture.toml`, for the message.

    Raises
    ------
    InputError
        The name is empty, absolute, has a `..`, or leads elsewhere by a link.
    """
    try:
        inside = bool(name) and (folder / name).resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):  # a NUL, too long a name, circular links
        inside = False
    if not inside or Path(name).is_absolute() or ".." in Path(name).parts:
        raise InputError(f"{path}: frames: {name!r} is outside the set's folder")


def reference_of(name: str, folder: Path, path: Path) -> Path:
    """Return the folder of the set that anchors this one.

    Parameters
    ----------
    name : str
        As the set states it, relative to its own folder.
    folder : Path
        The set.
    path : Path
        Its `capture.toml`, for the message.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        The name cannot be a folder.
    """
    try:
        return (folder / name).resolve()
    except (OSError, ValueError, RuntimeError):  # a NUL, too long a name, circular links
        raise InputError(f"{path}: reference: {name!r} leads to no folder") from None


def _order_rows(content: CaptureFile, path: Path) -> list[tuple[FrameRow, Pattern]]:
    """Rows with their patterns in the order of the sequence.

    Raises InputError for missing, duplicate or surplus ones.
    """
    # The pattern of each row.
    found: dict[str, tuple[FrameRow, Pattern]] = {}
    for row in content.frames:
        if row.role in ("sin", "gray") and row.axis is None:
            raise InputError(f"{path}: frames: {row.file} has role {row.role} and no axis")
        axis = row.axis or ""
        pattern = Pattern(row.role, axis, row.index if row.axis else 0)
        if row.role == "sin":
            shift_rad = row.shift_rad
            if shift_rad is None:
                shift_rad = 2 * math.pi * row.index / content.pattern.steps
            period_mm = _coarser_mm(row, content, path)
            pattern = Pattern(row.role, axis, row.index, shift_rad, period_mm)
        if pattern.name in found:
            raise InputError(
                f"{path}: frames: {pattern.name} appears twice "
                f"({found[pattern.name][0].file}, {row.file})"
            )
        found[pattern.name] = (row, pattern)

    # The patterns that a set of this kind has.
    sequence = fringe_sequence
    if content.kind == "full":
        sequence = full_sequence
    names = [pattern.name for pattern in sequence(content.pattern)]
    if content.kind == "frequencies":
        coarser = sorted({pattern.period_mm for _, pattern in found.values()} - {0.0})
        if not coarser:
            raise InputError(
                f"{path}: frames: a set of kind frequencies needs frames of another period_mm"
            )
        fringes = fringe_sequence(content.pattern)
        names += [replace(p, period_mm=period).name for period in coarser for p in fringes]
    if missing := [name for name in names if name not in found]:
        raise InputError(
            f"{path}: frames: a {content.kind} set of {content.pattern.steps} steps needs "
            f"{missing[0]}"
        )
    if extra := [name for name in found if name not in names]:
        raise InputError(f"{path}: frames: {extra[0]} does not belong to a {content.kind} set")
    for name, times in Counter(row.file for row in content.frames).items():
        if times > 1:
            raise InputError(f"{path}: frames: {name} is given for {times} frames")
    return [found[name] for name in names]


def _coarser_mm(row: FrameRow, content: CaptureFile, path: Path) -> float:
    """Period of a frame of coarser fringes; 0 for the pattern's own. Raises InputError."""
    if row.period_mm is None or row.period_mm == content.pattern.period_mm:
        return 0.0
    if content.kind != "frequencies":
        raise InputError(
            f"{path}: frames: {row.file} has its own period_mm: the kind of such a set is "
            "frequencies"
        )
    if row.period_mm < content.pattern.period_mm:
        raise InputError(
            f"{path}: frames: {row.file}: period_mm = {row.period_mm:g} is finer than "
            "pattern.period_mm"
        )
    return row.period_mm


def _to_number_column(values: list[float | None]) -> FloatArray:
    """Numbers (n,); NaN for None."""
    return np.array([math.nan if value is None else value for value in values])


def _find_most_common(values: list[Any]) -> Any:
    """The value that occurs most often."""
    return Counter(values).most_common(1)[0][0]
