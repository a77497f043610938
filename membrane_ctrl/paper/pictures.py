"""Pictures of the paper's figures, as PNG bytes."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from membrane_ctrl.measure.matplotlib_sheet import new_sheet
from membrane_ctrl.model.arrays import AnyArray, BoolArray, FloatArray, IntArray

_THINNED = 400  # pixels along a side of an image in the document
_MAP_COLOURS = "viridis"


def draw_frames(frames: Sequence[AnyArray], names: Sequence[str]) -> bytes:
    """Draw frames in two rows.

    Parameters
    ----------
    frames : sequence of (H, W) arrays
        The frames.
    names : sequence of str
        One title each.

    Returns
    -------
    bytes
        A PNG.
    """
    columns = (len(frames) + 1) // 2
    figure, axes = new_sheet(2.2 * columns, 4.4, 2, columns)
    for cell, frame, name in zip(np.ravel(axes), frames, names, strict=True):
        cell.imshow(_thin_image(frame), cmap="gray")
        cell.set_title(name, fontsize=8)
        cell.set_axis_off()
    return to_png(figure)


def draw_images(images: Sequence[AnyArray], titles: Sequence[str]) -> bytes:
    """Draw images of the camera beside each other, each with its colour bar.

    Parameters
    ----------
    images : sequence of (H, W) arrays
        The images.
    titles : sequence of str
        One each.

    Returns
    -------
    bytes
        A PNG.
    """
    figure, axes = new_sheet(3.4 * len(images), 3.0, 1, len(images))
    for cell, image, title in zip(np.ravel(axes), images, titles, strict=True):
        shown = cell.imshow(_thin_image(image), cmap=_MAP_COLOURS, interpolation="nearest")
        figure.colorbar(shown, ax=cell, shrink=0.8)
        cell.set_title(title, fontsize=9)
        cell.set_axis_off()
    return to_png(figure)


def draw_maps(
    maps: Mapping[str, FloatArray],
    axis_mm: FloatArray,
    unit: str,
    marks_mm: Mapping[str, tuple[float, float]] | None = None,
) -> bytes:
    """Draw maps over the mirror beside each other, with colour bars.

    Parameters
    ----------
    maps : mapping of (m, m) arrays
        By their title.
    axis_mm : (m,) array
        Places of their rows and columns.
    unit : str
        Label of the colour bars.
    marks_mm : mapping of (float, float)
        Points to mark in each map, by name.

    Returns
    -------
    bytes
        A PNG.
    """
    figure, axes = new_sheet(4.2 * len(maps), 3.6, 1, len(maps))
    half_mm = float(axis_mm[-1])
    for cell, (title, values) in zip(np.ravel(axes), maps.items(), strict=True):
        extent = (-half_mm, half_mm, -half_mm, half_mm)
        shown = cell.imshow(values, cmap=_MAP_COLOURS, origin="lower", extent=extent)
        figure.colorbar(shown, ax=cell, shrink=0.8, label=unit)
        for name, (x_mm, y_mm) in (marks_mm or {}).items():
            cell.plot(x_mm, y_mm, "r+")
            cell.annotate(name, (x_mm, y_mm), color="r")
        cell.set_title(title, fontsize=9)
        cell.set_xlabel("x, mm")
        cell.set_ylabel("y, mm")
    return to_png(figure)


def draw_gray_table(bits: BoolArray, k1: IntArray, k2: IntArray) -> bytes:
    """Draw a Gray code as black and white cells, with the orders below.

    Parameters
    ----------
    bits : (bits, half periods) bool array
        The code.
    k1, k2 : (half periods,) int array
        Orders of the fringes and of the shifted ones.

    Returns
    -------
    bytes
        A PNG.
    """
    figure, axes = new_sheet(7.0, 2.4)
    cell: Any = np.ravel(axes)[0]
    cell.imshow(bits, cmap="gray", aspect="auto", vmin=0, vmax=1)
    cell.set_yticks(range(len(bits)), [f"GC{number + 1}" for number in range(len(bits))])
    labels = [f"{first}\n{second}" for first, second in zip(k1, k2, strict=True)]
    cell.set_xticks(range(len(labels)), labels, fontsize=8)
    cell.set_xlabel("half period of the screen: K1 above, K2 below")
    return to_png(figure)


def draw_curves(
    curves: Mapping[str, tuple[Sequence[float] | FloatArray, Sequence[float] | FloatArray]],
    x_label: str,
    y_label: str,
    *,
    logarithmic: bool = False,
    level: float | None = None,
    bands: Mapping[str, FloatArray] | None = None,
) -> bytes:
    """Draw curves with a legend.

    Parameters
    ----------
    curves : mapping of two (n,) arrays
        x and y of each, by name.
    x_label, y_label : str
        With their units.
    logarithmic : bool
        Whether y is.
    level : float or None
        A dashed line at this y.
    bands : mapping of (n,) arrays
        Half width of a band around a curve, by the curve's name.

    Returns
    -------
    bytes
        A PNG.
    """
    figure, axes = new_sheet(6.5, 4.0)
    cell: Any = np.ravel(axes)[0]
    for name, (x, y) in curves.items():
        (line,) = cell.plot(x, y, marker="." if len(x) < 50 else None, label=name)
        half = None if bands is None else bands.get(name)
        if half is not None:
            middle = np.asarray(y)
            cell.fill_between(x, middle - half, middle + half, color=line.get_color(), alpha=0.3)
    if level is not None:
        cell.axhline(level, color="r", linestyle="--")
    if logarithmic:
        cell.set_yscale("log")
    cell.set_xlabel(x_label)
    cell.set_ylabel(y_label)
    cell.legend(fontsize=8)
    cell.grid(alpha=0.3)
    return to_png(figure)


def to_png(figure: Any) -> bytes:
    """The bytes of a drawn sheet, without what differs from run to run."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110, metadata={"Software": None})
    return file.getvalue()


def _thin_image(image: AnyArray) -> AnyArray:
    """Every n-th pixel, so that a side has about `_THINNED`."""
    step = max(1, max(image.shape) // _THINNED)
    return image[::step, ::step]
