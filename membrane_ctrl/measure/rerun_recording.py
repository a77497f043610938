"""A measurement as a Rerun recording: maps, coefficients, verdict and pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from membrane_ctrl.measure.measurement import Measurement
from membrane_ctrl.model.files import move_file, scratch_folder
from membrane_ctrl.model.zernike_terms import NOLL_INDICES

if TYPE_CHECKING:  # half a second to load, and most measurements make no recording
    import rerun as rr
    import rerun.blueprint as rrb


@contextmanager
def open_recording(
    path: Path, application: str, blueprint: rrb.Blueprint | None = None
) -> Iterator[rr.RecordingStream]:
    """Write a Rerun recording within a `with` block.

    The file appears whole at the end of the block, or not at all.

    Parameters
    ----------
    path : Path
        The file (.rrd), replaced if it exists.
    application : str
        Application id: recordings of one id share a blueprint in the viewer.
    blueprint : rrb.Blueprint or None
        Views with which the file opens; None: those that the viewer chooses.

    Yields
    ------
    rr.RecordingStream

    Raises
    ------
    OSError
        The file cannot be written, e.g. because the disk is full.
    """
    import rerun as rr

    recording = rr.RecordingStream(application)
    with scratch_folder(path.parent, ".recording-") as folder:
        try:
            recording.save(folder / path.name, default_blueprint=blueprint)
            yield recording
            recording.flush()  # logging never reports a full disk, this does
        except RuntimeError as error:
            raise OSError(f"{path.name}: {error}") from None
        finally:
            recording.disconnect()
        try:
            move_file(folder / path.name, path)
        except OSError as error:
            raise OSError(f"{path.name}: {error.strerror}") from None


def log_pictures(recording: rr.RecordingStream, entity: str, pictures: Sequence[Path]) -> None:
    """Log pictures as static images, each at `entity` and its file's name without ending.

    Parameters
    ----------
    recording : rr.RecordingStream
        An open recording.
    entity : str
        Path of the entity above the pictures.
    pictures : sequence of Path
        Image files, such as PNG.
    """
    import rerun as rr

    for picture in pictures:
        recording.log(f"{entity}/{picture.stem}", rr.EncodedImage(path=picture), static=True)


def log_measurement(path: Path, measurement: Measurement, pictures: Sequence[Path]) -> None:
    """Write maps, coefficients, verdict and pictures of a measurement as a Rerun recording.

    Parameters
    ----------
    path : Path
        The file (.rrd), replaced if it exists.
    measurement : Measurement
        Without a figure, only verdict and pictures are logged. Maps are shown with +y upwards.
    pictures : sequence of Path
        PNG files.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    import rerun as rr

    words = [f"verdict: {measurement.verdict} {measurement.reason}"]
    words += [f"{item['file']}: {item['reason']}" for item in measurement.flagged_files()]
    full = measurement.full
    with open_recording(path, "membrane_ctrl_measure") as recording:
        recording.log("measure/verdict", rr.TextDocument("\n".join(words)), static=True)
        if full is not None:
            coeffs_um = 1e3 * full.surface.coeffs_mm
            recording.log(
                "measure/zernike_um",
                rr.BarChart(coeffs_um[1:], abscissa=NOLL_INDICES[1:]),
                static=True,
            )
            # row 0 of a picture is at the top, i.e. at +y
            height = full.height_mm()[::-1].astype(np.float32)
            residual = (1e3 * full.residual_mm)[::-1].astype(np.float32)
            recording.log("measure/height_mm", rr.Tensor(height, dim_names=["y", "x"]), static=True)
            recording.log(
                "measure/residual_um", rr.Tensor(residual, dim_names=["y", "x"]), static=True
            )
        log_pictures(recording, "measure/pictures", pictures)
