"""One program at a time runs the session of a folder."""

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path

from membrane_ctrl.model import errors, files


@contextlib.contextmanager
def claim_folder(folder: Path) -> Iterator[None]:
    """Keep the session of a folder to this program. Raises DeviceError if another one has it."""
    with contextlib.ExitStack() as stack:
        with errors.convert_write_errors(folder, errors.DeviceError):
            # the folder itself is locked: a file in it could be another's
            lock = stack.enter_context(files.folder_handle(folder.resolve()))
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise errors.DeviceError(
                f"{folder}: this session runs already, in another terminal or in the page; end it "
                "there first"
            ) from None
        yield
