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
    """Write a Rerun recording to a file `path` (.rrd), overwriting it. Raises OSError if that
    fails.
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
    """Log every picture below an entity, by file name."""
    import rerun as rr

    for picture in pictures:
        recording.log(f"{entity}/{picture.stem}", rr.EncodedImage(path=picture), static=True)


def log_measurement(path: Path, measurement: Measurement, pictures: Sequence[Path]) -> None:
    """Write maps, coefficients, verdict and pictures as a recording `path` (.rrd).
    Raises OSError.
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
