"""The system calls of a table's writer, in one place: tests interrupt each of them, and fill the
disk.
"""

import os
from pathlib import Path

_CREATE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_APPEND = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC


class Disk:
    """The operating system's calls. Each raises OSError."""

    def make_folder(self, path: Path) -> None:
        """Make a folder and its parents, if missing."""
        path.mkdir(parents=True, exist_ok=True)

    def create(self, path: Path) -> int:
        """Open a file that does not exist yet."""
        return os.open(path, _CREATE, 0o644)

    def open_to_append(self, path: Path) -> int:
        """Open a file to append to, new or old."""
        return os.open(path, _APPEND, 0o644)

    def write(self, descriptor: int, data: bytes) -> None:
        """Write all of some bytes.

        Parameters
        ----------
        descriptor : int
            Of a file that `create` or `open_to_append` has opened.
        data : bytes
            On an error a part of them may be written: the caller cuts the file (`truncate`).
        """
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(descriptor, rest) :]

    def truncate(self, descriptor: int, size_bytes: int) -> None:
        """Cut a file to a size, and write from there on.

        Parameters
        ----------
        descriptor : int
            Of an open file.
        size_bytes : int
            Up to where its content is whole.
        """
        os.ftruncate(descriptor, size_bytes)
        os.lseek(descriptor, size_bytes, os.SEEK_SET)

    def sync(self, descriptor: int) -> None:
        """Wait until a file's content is on the disk."""
        os.fdatasync(descriptor)

    def close(self, descriptor: int) -> None:
        """Close a file."""
        os.close(descriptor)

    def rename(self, source: Path, target: Path) -> None:
        """Give a file another name, in place of the file that has it.

        After a crash there is one of the two, whole; `sync_folder` makes sure of the new one.

        Parameters
        ----------
        source, target : Path
            In the same folder.
        """
        source.replace(target)

    def remove(self, path: Path) -> None:
        """Remove a file, if it exists."""
        path.unlink(missing_ok=True)

    def sync_folder(self, path: Path) -> None:
        """Wait until a folder's names are on the disk."""
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
