"""Reads and writes the files of results: strict JSON, arrays and pictures."""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.model import program
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.files import read_bytes, write_bytes_atomic, write_text_atomic

if TYPE_CHECKING:  # matplotlib takes a second to load
    from matplotlib.figure import Figure

_ARRAYS_BYTES = 100_000_000


def write_json(path: Path, table: dict[str, Any]) -> None:
    """Write a table as strict JSON, with a line feed at its end.

    Parameters
    ----------
    path : Path
        The file, replaced as a whole.
    table : dict
        Plain data; a number that does not exist is None, not NaN.

    Raises
    ------
    ValueError
        A number is NaN or infinite.
    OSError
        The file cannot be written.
    """
    write_text_atomic(path, json.dumps(table, indent=1, allow_nan=False) + "\n")


def write_arrays(path: Path, **arrays: NDArray[Any]) -> None:
    """Write an `.npz`, with its origin as one more array. Raises OSError."""
    file = io.BytesIO()
    origin = program.describe_origin(f"membrane-{path.stem}/1")
    np.savez(file, allow_pickle=False, origin=np.array(origin), **arrays)
    write_bytes_atomic(path, file.getvalue())


def read_arrays(path: Path, names: tuple[str, ...], most: int) -> list[FloatArray]:
    """Read arrays from an untrusted `.npz`; nothing larger than allowed is allocated.

    Parameters
    ----------
    path : Path
        The file.
    names : tuple of str
        The arrays to read.
    most : int
        Largest number of values of each.

    Returns
    -------
    list of arrays
        64-bit floats, in the order of `names`.

    Raises
    ------
    OSError, ValueError
        It cannot be read, or is not such a file.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(path, _ARRAYS_BYTES))) as archive:
            return [_read_array(archive, name, most) for name in names]
    except (
        zipfile.BadZipFile,
        zlib.error,
        KeyError,
        NotImplementedError,
        RuntimeError,
        EOFError,
    ) as error:
        raise ValueError(f"{path.name} is damaged or lacks an array ({error})") from None


def _read_array(archive: zipfile.ZipFile, name: str, most: int) -> FloatArray:
    with archive.open(f"{name}.npy") as packed:
        data = io.BytesIO(packed.read(8 * most + 1024))  # whatever size the archive claims
    version = np.lib.format.read_magic(data)
    read_header = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, by_columns, kind = read_header(data)
    left = data.getbuffer().nbytes - data.tell()
    if kind != np.dtype("<f8") or math.prod(shape) * kind.itemsize != left:
        raise ValueError(f"{name} is not an array of at most {most} 64-bit floats")
    return np.frombuffer(data.read(), np.float64).reshape(shape, order="F" if by_columns else "C")


def write_picture(path: Path, figure: Figure, dpi: int = 110) -> Path:
    """Write a figure as PNG.

    Parameters
    ----------
    path : Path
        The file, replaced as a whole.
    figure : Figure
        Of any backend.
    dpi : int
        Pixels per inch.

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    picture = io.BytesIO()
    FigureCanvasAgg(figure).print_figure(
        picture, format="png", dpi=dpi, pil_kwargs={"compress_level": 3}
    )
    write_bytes_atomic(path, picture.getvalue())
    return path


def number_or_null(value: float) -> float | None:
    """The number, or None (null in JSON) if it is NaN or infinite."""
    if math.isfinite(value):
        return value
    return None
