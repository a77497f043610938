"""Detects that the run's folder was replaced or removed while it is recorded."""

import os
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.run_files import run_folder


class FolderWatch:
    """Holds the folder open, so that its inode number cannot be reused and identifies it."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._descriptor = _open_folder(run_dir)
        # an `rm -r` that meets a newly written file leaves the folder, but without its content
        self._has_config = (run_dir / run_folder.CONFIG).exists()

    def is_gone(self) -> bool:
        """Whether the folder or its content was removed or moved. Raises OSError (not if it is
        missing).
        """
        if self._descriptor is None or (
            self._has_config and not (self._run_dir / run_folder.CONFIG).exists()
        ):
            return True
        try:
            found = self._run_dir.stat()
        except FileNotFoundError:
            return True
        return not os.path.samestat(found, os.fstat(self._descriptor))

    def restart(self, config: Config) -> None:
        """Make the folder again, with its configuration. Raises OSError; the folder is then still
        `is_gone`.
        """
        self._run_dir.mkdir(parents=True, exist_ok=True)
        run_folder.write_heads(self._run_dir, config)
        self.close()
        self._descriptor = _open_folder(self._run_dir)
        self._has_config = True

    def close(self) -> None:
        """Release the folder."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _open_folder(folder: Path) -> int | None:
    try:
        return os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None
