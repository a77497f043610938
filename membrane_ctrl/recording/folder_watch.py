"""Whether the run's folder is still the one that was begun, and another in its place if it is not."""

from __future__ import annotations

import os
from pathlib import Path

from membrane_ctrl.config import Config
from membrane_ctrl.recording.run_folder import CONFIG, write_config


class FolderWatch:
    """Holds the folder open: as long as that is so its number is nobody else's, and it cannot be mistaken.

    Parameters
    ----------
    run_dir : Path
        Folder of the run.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._descriptor = _opened(run_dir)
        # an `rm -r` that met a file just written leaves the folder, without what was in it
        self._has_config = (run_dir / CONFIG).exists()

    def gone(self) -> bool:
        """Whether the folder, or what was in it, was removed or moved. Raises OSError (not if it is missing)."""
        if self._descriptor is None or (self._has_config and not (self._run_dir / CONFIG).exists()):
            return True
        try:
            found = self._run_dir.stat()
        except FileNotFoundError:
            return True
        return not os.path.samestat(found, os.fstat(self._descriptor))

    def begin_anew(self, config: Config) -> None:
        """Make the folder again, with the configuration in it. Raises OSError; then it is still `gone`."""
        self._run_dir.mkdir(parents=True, exist_ok=True)
        write_config(self._run_dir, config)
        self.close()
        self._descriptor = _opened(self._run_dir)
        self._has_config = True

    def close(self) -> None:
        """Let go of the folder."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _opened(folder: Path) -> int | None:
    try:
        return os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None
