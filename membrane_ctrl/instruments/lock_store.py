"""The locks of this machine's devices on disk: one file a lock, in a folder that belongs to no run.

A lock counts for every program that uses one of its devices, whatever its configuration or folder
of runs. A file is complete and synced before the lock is confirmed. Doubt locks: a file or folder
that cannot be read is a lock on all devices.

The folder is `$MEMBRANE_CTRL_LOCKS`, else `/var/lib/membrane-ctrl/locks`, and for a user who may
not write there also `$XDG_STATE_HOME/membrane-ctrl/locks`. It is no key of the configuration:
another configuration must not hide a lock.
"""

import contextlib
import json
import os
import secrets
import stat
import zlib
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl.model import files
from membrane_ctrl.model.errors import DeviceError, os_reason
from membrane_ctrl.model.lock import Lock, describe_locks
from membrane_ctrl.model.lock_words import WORDS, distinct_word, make_word
from membrane_ctrl.model.program import file_origin
from membrane_ctrl.model.state_folder import find_state_folder

VARIABLE = "MEMBRANE_CTRL_LOCKS"
MACHINE_FOLDER = Path("/var/lib/membrane-ctrl/locks")
SCHEMA = "membrane-lock/1"
LOG_NAME = "removed.log"  # what `membrane-ctrl locks remove` removed, one JSON object a line
_SUFFIX = ".json"
_FILE_BYTES_MOST = 16_384
_FOLDER_MODE = 0o755
_FILE_MODE = 0o644
_TEXTS = frozenset(field.name for field in fields(Lock))
_UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class StoredLock:
    """A lock on disk."""

    lock: Lock
    file: Path | None  # None: the folder itself is in doubt; mend it by hand
    devices: frozenset[str] = frozenset()  # empty: unknown, so it counts for all


class LockStore:
    """The locks in the folders of this machine: read from all of them, written to the first that
    allows it.

    Parameters
    ----------
    folders : sequence of Path
        In order of preference.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = tuple(folders)

    @classmethod
    def of_machine(cls) -> "LockStore":
        """Return the store of this machine, for this user.

        Returns
        -------
        LockStore
        """
        named = os.environ.get(VARIABLE, "")
        if named:
            return cls((Path(named).absolute(),))
        own = _find_own_folder()
        return cls((MACHINE_FOLDER,) if own is None else (MACHINE_FOLDER, own))

    def find_locks(self, devices: Collection[str] | None = None) -> list[StoredLock]:
        """Return the locks on any of these devices, oldest first; never raises.

        Parameters
        ----------
        devices : collection of str, optional
            Keys of `list_device_keys` or `modbus_keys`; None: locks on any device.

        Returns
        -------
        list of StoredLock
            Their words differ.
        """
        found: list[StoredLock] = []
        taken: set[str] = set()
        for each in self._read_all():
            if devices is not None and each.devices and each.devices.isdisjoint(devices):
                continue
            word = distinct_word(each.lock.word, taken)
            taken.add(word)
            found.append(replace(each, lock=replace(each.lock, word=word)))
        return found

    def write_lock(self, lock: Lock, devices: Collection[str]) -> Path:
        """Store a lock; on return it survives a power cut.

        Parameters
        ----------
        lock : Lock
            With its word, author and time.
        devices : collection of str
            Keys of its devices.

        Returns
        -------
        Path
            Its file.

        Raises
        ------
        OSError
            If no folder can be written; it names the first.
        """
        # A name of its own for each lock: two programs never write the same file. The first folder
        # that can be written has it; all are read
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%f")
        name = f"{stamp}-{lock.word}-{secrets.token_hex(4)}{_SUFFIX}"
        table = {**file_origin(SCHEMA), "devices": sorted(devices), **asdict(lock)}
        data = (json.dumps(table, indent=1) + "\n").encode()
        first_error: OSError | None = None
        for folder in self._folders:
            try:
                return _write_file(folder, name, data)
            except OSError as error:
                first_error = first_error or error
        assert first_error is not None
        raise first_error

    def remove_lock(self, file: Path) -> None:
        """Remove a lock's file; on return the removal survives a power cut.

        Parameters
        ----------
        file : Path
            As `write_lock` or `find_locks` states it; one that is gone is no error.

        Raises
        ------
        OSError
            The folder cannot be written: the lock stays.
        """
        with files.folder_handle(file.parent) as folder:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(file.name, dir_fd=folder)
            os.fsync(folder)

    def _read_all(self) -> Iterable[StoredLock]:
        for folder in self._folders:
            try:
                _check_folder(folder)
                paths = sorted(path for path in folder.iterdir() if _is_lock_name(path.name))
            except FileNotFoundError:  # nothing was ever stored there
                continue
            except OSError as error:
                yield StoredLock(_doubtful_lock(folder, os_reason(error)), None)
                continue
            for path in paths:
                with contextlib.suppress(FileNotFoundError):  # removed meanwhile
                    yield _read_file(path)


def require_unlocked(store: LockStore, devices: Collection[str], remedy: str = "") -> None:
    """Refuse to continue if a device is locked. Every command that can move gas calls this after it
    has the devices.

    Parameters
    ----------
    store : LockStore
        Of this machine.
    devices : collection of str
        Keys of the devices.
    remedy : str
        How to remove a lock; empty: with `membrane-ctrl locks`.

    Raises
    ------
    DeviceError
        With text, author, time and word of each lock, and how to remove it.
    """
    found = store.find_locks(devices)
    if found:
        raise DeviceError(format_locked_line([each.lock for each in found], remedy))


def format_locked_line(locks: Sequence[Lock], remedy: str = "") -> str:
    """Return the line with which a command refuses locked devices.

    Parameters
    ----------
    locks : sequence of Lock
        Those on the devices; the text, author, time and word of each are shown.
    remedy : str
        As for `require_unlocked`.

    Returns
    -------
    str
    """
    how = remedy or "`membrane-ctrl locks remove WORD`"
    return (
        f"locked: {describe_locks(locks)}; ask its author whether the mirror may move, then "
        f"remove it: {how}"
    )


def draw_word(taken: Collection[str]) -> str:
    """Return a random word that is not taken.

    Parameters
    ----------
    taken : collection of str
        Words of the locks that are set.

    Returns
    -------
    str
    """
    return distinct_word(make_word(secrets.randbelow(WORDS)), taken)


def _find_own_folder() -> Path | None:
    """Return the user's own folder of locks; None without a home."""
    folder = find_state_folder()
    if folder is None:
        return None
    return folder / "locks"


def _is_lock_name(name: str) -> bool:
    """Return whether a file is a lock's, not one that is being written."""
    return name.endswith(_SUFFIX) and not name.startswith(".")


def _check_folder(folder: Path) -> None:
    """Raise OSError for a folder from which strangers could take locks away."""
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise OSError(0, "is a link or no folder; replace it by a folder")
    if found.st_mode & stat.S_IWOTH and not found.st_mode & stat.S_ISVTX:
        raise OSError(0, f"everybody may remove locks from it; chmod o-w {folder}")
    trusted = {0, os.geteuid(), folder.parent.stat().st_uid}
    if found.st_uid not in trusted:
        raise OSError(
            0, f"belongs to user {found.st_uid}; chown it to root or to its users' service"
        )


def _write_file(folder: Path, name: str, data: bytes) -> Path:
    """Write a file atomically, synced with its folder; make the folder if it is missing."""
    folder.mkdir(mode=_FOLDER_MODE, parents=True, exist_ok=True)
    _check_folder(folder)
    file = folder / name
    files.write_bytes_atomic(file, data)
    try:
        file.chmod(_FILE_MODE)  # other users' programs read it, whatever the umask
        with files.folder_handle(folder) as descriptor:
            os.fsync(descriptor)
    except OSError:
        with contextlib.suppress(OSError):
            file.unlink()
        raise
    return file


def _read_file(file: Path) -> StoredLock:
    """Return a file's lock; a damaged one is a lock on all devices. Raises FileNotFoundError if it
    is gone.
    """
    try:
        # Whatever is wrong with the file, it remains a lock.
        table = json.loads(files.read_text(file, _FILE_BYTES_MOST))
        if table["schema"] != SCHEMA:
            raise ValueError("another schema")
        devices = frozenset(table["devices"])
        texts = {name: table[name] for name in _TEXTS}
        if not devices or not all(isinstance(each, str) for each in (*devices, *texts.values())):
            raise ValueError("not the lock of a device")
        if not texts["word"]:
            raise ValueError("no word")
    except FileNotFoundError:
        raise
    except OSError as error:
        return StoredLock(_doubtful_lock(file, os_reason(error)), file)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        return StoredLock(_doubtful_lock(file, f"{type(error).__name__}: {error}"), file)
    return StoredLock(Lock(**texts), file, devices)


def _doubtful_lock(path: Path, why: str) -> Lock:
    """Return the lock for a file or folder that cannot be read; its word follows from the path."""
    word = make_word(zlib.crc32(os.fsencode(path)))
    return Lock(word, f"{path} cannot be read ({why[:100]})", _UNKNOWN, set_utc="unknown time")
