"""A result's own Rerun recording: opened, and closed with a look at whether it reached the disk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from membrane_ctrl.recording.atomic import move, scratch_folder


@contextmanager
def result_recording(
    path: Path, application: str, blueprint: rrb.Blueprint | None = None
) -> Iterator[rr.RecordingStream]:
    """A recording in a file `path` (.rrd), overwritten. Raises OSError if it cannot be written."""
    recording = rr.RecordingStream(application)
    with scratch_folder(path.parent, ".recording-") as folder:
        try:
            recording.save(folder / path.name, default_blueprint=blueprint)
            yield recording
            recording.flush()  # logging never says that a disk is full, this does
        except RuntimeError as error:
            raise OSError(f"{path.name}: {error}") from None
        finally:
            recording.disconnect()
        try:
            move(folder / path.name, path)
        except OSError as error:
            raise OSError(f"{path.name}: {error.strerror}") from None


def log_pictures(recording: rr.RecordingStream, entity: str, pictures: Sequence[Path]) -> None:
    """Every picture below an entity, by its file's name."""
    for picture in pictures:
        recording.log(f"{entity}/{picture.stem}", rr.EncodedImage(path=picture), static=True)
