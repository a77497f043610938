"""Files in untrusted folders: regular files only, no link followed, every read bounded.

A run folder or a capture set may come by mail or in an archive. Its files are opened through a
handle of the folder, without following links. A write leaves either the old or the complete new
file, even after a power cut.

The folder itself is trusted (a command resolves the path that the user named); its subfolders and
files are not.
"""

import contextlib
import errno
import io
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, TextIO

# A summary or a configuration is a few kilobytes; parsed JSON and TOML take fifty times the memory
# of their text.
SMALL_BYTES = 4_000_000
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
# non-blocking: opening a pipe without a writer would block
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_APPEND = (
    os.O_WRONLY
    | os.O_CREAT
    | os.O_APPEND
    | os.O_NOFOLLOW
    | os.O_NONBLOCK
    | os.O_NOCTTY
    | os.O_CLOEXEC
)


@contextlib.contextmanager
def folder_handle(folder: Path) -> Iterator[int]:
    """A folder's descriptor, for `dir_fd`. Raises OSError for a link in its place."""
    try:
        descriptor = os.open(folder, _FOLDER)
    except OSError as error:
        raise _clarify_error(error, folder) from None
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def open_plain(path: Path, follow: bool = False) -> BinaryIO:
    """Open a plain file for reading.

    Parameters
    ----------
    path : Path
        The file.
    follow : bool
        Follow links; only for a path that the user named.

    Returns
    -------
    BinaryIO

    Raises
    ------
    OSError
        It is missing, a link, in a linked folder, or no plain file; `strerror` states which.
    """
    with contextlib.ExitStack() as stack:
        if follow:
            descriptor = os.open(path, _READ & ~os.O_NOFOLLOW)
        else:
            folder = stack.enter_context(folder_handle(path.parent))
            descriptor = _open_checked(path, _READ, folder)
    return os.fdopen(_require_regular(descriptor, path), "rb")


def read_bytes(path: Path, most_bytes: int, follow: bool = False) -> bytes:
    """Read a plain file.

    Parameters
    ----------
    path : Path
        The file.
    most_bytes : int
        Largest size.
    follow : bool
        As in `open_plain`.

    Returns
    -------
    bytes
        Its content.

    Raises
    ------
    OSError
        As `open_plain`, and for a larger file.
    """
    with open_plain(path, follow) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(size) if size <= most_bytes else b""  # of a growing file, the part so far
    if size > most_bytes:
        raise OSError(
            errno.EFBIG,
            f"{size / 1e6:.0f} MB, above the limit of {most_bytes / 1e6:.0f} MB",
            str(path),
        )
    return data


def read_text(
    path: Path, most_bytes: int = SMALL_BYTES, errors: str = "strict", follow: bool = False
) -> str:
    """Read a plain file as UTF-8.

    Parameters
    ----------
    path, most_bytes, follow
        As for `read_bytes`.
    errors : str
        As of `bytes.decode`.

    Returns
    -------
    str
        Its content.

    Raises
    ------
    OSError
        As `read_bytes`.
    UnicodeDecodeError
        It is not UTF-8, depending on `errors`.
    """
    return read_bytes(path, most_bytes, follow).decode("utf-8", errors)


def resolve_user_path(path: Path) -> Path:
    """A path named by the user, with its folder's links resolved; writing replaces the file itself,
    link or not.
    """
    return path.parent.resolve() / path.name


def write_text_atomic(path: Path, text: str) -> None:
    """Write UTF-8 text beside a file, sync it, and move it into place atomically.

    Parameters
    ----------
    path : Path
        The file.
    text : str
        A lone surrogate, allowed in JSON but not in UTF-8, is written as its JSON escape.

    Raises
    ------
    OSError
        It cannot be written; the former file stays.
    """
    write_bytes_atomic(path, text.encode("utf-8", "backslashreplace"))


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Write bytes beside a file, sync them, and move them into place atomically.

    Parameters
    ----------
    path : Path
        The file; a link of this name is replaced, not its target.
    data : bytes
        The whole content.

    Raises
    ------
    OSError
        It cannot be written; the former file stays.
    """
    with folder_handle(path.parent) as folder:
        part = f".{path.name}.part"
        try:
            with _open_fresh(part, folder, path) as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path.name, src_dir_fd=folder, dst_dir_fd=folder)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.unlink(part, dir_fd=folder)
            raise type(error)(error.errno, error.strerror, str(path)) from None


def fresh_file(path: Path) -> BinaryIO:
    """Open a new file for piecewise writing, replacing an old one. Raises OSError."""
    with folder_handle(path.parent) as folder:
        return _open_fresh(path.name, folder, path)


def fresh_text(path: Path) -> TextIO:
    """As `fresh_file`, for text, with line ends as given."""
    return io.TextIOWrapper(fresh_file(path), encoding="utf-8", newline="")


def append_text(path: Path, text: str) -> None:
    """Append text to a plain file without hard links; make it if it is missing.

    Parameters
    ----------
    path : Path
        The file.
    text : str
        UTF-8.

    Raises
    ------
    OSError
        It cannot be written, or has a second name elsewhere.
    """
    with folder_handle(path.parent) as folder:
        descriptor = _require_regular(_open_checked(path, _APPEND, folder), path)
        with os.fdopen(descriptor, "ab") as file:
            # a second name may belong to a file elsewhere
            if os.fstat(file.fileno()).st_nlink > 1:
                raise OSError(
                    errno.EMLINK, "has a hard link elsewhere, and is not written", str(path)
                )
            file.write(text.encode("utf-8", "backslashreplace"))


def move_file(source: Path, target: Path) -> None:
    """Replace a file by another file, atomically.

    Parameters
    ----------
    source : Path
        The file to move, on the same file system.
    target : Path
        Its new name; a link of this name is replaced, not its target.

    Raises
    ------
    OSError
        It cannot be moved; both files stay.
    """
    with folder_handle(source.parent) as from_folder, folder_handle(target.parent) as folder:
        try:
            os.replace(source.name, target.name, src_dir_fd=from_folder, dst_dir_fd=folder)
        except OSError as error:  # the error has only the file's name
            raise type(error)(error.errno, error.strerror, str(target)) from None


def remove_file(path: Path) -> None:
    """Remove a file or a link, if it is there. Raises OSError."""
    with folder_handle(path.parent) as folder, contextlib.suppress(FileNotFoundError):
        os.unlink(path.name, dir_fd=folder)


def make_folder(path: Path) -> Path:
    """Make a folder and its parents, if missing. Raises OSError for a link in its place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        path.mkdir()
    with folder_handle(path):
        return path


@contextlib.contextmanager
def scratch_folder(folder: Path, prefix: str) -> Iterator[Path]:
    """Make a private temporary folder within a folder, for programs that write by name.

    Parameters
    ----------
    folder : Path
        Existing folder, so that `move_file` from there stays on one file system.
    prefix : str
        With which the temporary folder's name begins.

    Yields
    ------
    Path
        The temporary folder, which is deleted with its content at the end of the block.

    Raises
    ------
    OSError
        It cannot be made.
    """
    with folder_handle(folder), tempfile.TemporaryDirectory(prefix=prefix, dir=folder) as scratch:
        yield Path(scratch)


def sync_data(path: Path) -> None:
    """Sync a file's content to disk, whatever process wrote it. Raises OSError."""
    with open_plain(path) as file:
        os.fdatasync(file.fileno())


def _open_checked(path: Path, flags: int, folder: int) -> int:
    try:
        return os.open(path.name, flags, 0o644, dir_fd=folder)
    except OSError as error:
        raise _clarify_error(error, path) from None


def _open_fresh(name: str, folder: int, path: Path) -> BinaryIO:
    with contextlib.suppress(FileNotFoundError):
        os.unlink(name, dir_fd=folder)
    return os.fdopen(_open_checked(path.with_name(name), _NEW, folder), "wb")


def _require_regular(descriptor: int, path: Path) -> int:
    """The descriptor of a regular file; closes any other. Raises OSError."""
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return descriptor
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "is a folder, not a file", str(path))
    raise OSError(errno.EINVAL, "not a plain file (a pipe or a device)", str(path))


def _clarify_error(error: OSError, path: Path) -> OSError:
    """A clearer error: Linux reports a refused link in two ways, without naming folder or link."""
    if path.is_symlink():
        return OSError(errno.ELOOP, "is a link, and links are not followed here", str(path))
    if error.errno == errno.ENXIO:  # a pipe without a reader, a socket
        return OSError(errno.EINVAL, "not a plain file (a pipe or a device)", str(path))
    return type(error)(error.errno, error.strerror, str(path))
