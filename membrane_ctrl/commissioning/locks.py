"""`locks`: lists the locks on this machine's devices, and removes one while no program runs the
devices.
"""

import contextlib
import json
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.locks import decide_unlock
from membrane_ctrl.instruments import device_claim, lock_store
from membrane_ctrl.model import files
from membrane_ctrl.model.account import account_name
from membrane_ctrl.model.errors import DeviceError, Exit, InputError, os_reason
from membrane_ctrl.model.lock import describe_lock


def list_locks(as_json: bool) -> int:
    """Print the locks on this machine's devices.

    Parameters
    ----------
    as_json : bool
        Print JSON instead of a line for each lock.

    Returns
    -------
    int
        Exit code.
    """
    found = lock_store.LockStore.of_machine().find_locks()
    if as_json:
        listed = [
            {
                **asdict(each.lock),
                "devices": sorted(each.devices),
                "file": each.file and str(each.file),
            }
            for each in found
        ]
        print(json.dumps({"schema": "membrane-locks/1", "locks": listed}))
        return Exit.DONE
    for each in found:
        devices = ", ".join(sorted(each.devices)) or "all devices"
        print(f"{describe_lock(each.lock)}; on {devices}")
    if not found:
        print("no locks", file=sys.stderr)
    return Exit.DONE


def remove_lock(word: str) -> int:
    """Remove a lock: one's own, or another person's by its word.

    Parameters
    ----------
    word : str
        Empty: one's own, if there is exactly one.

    Returns
    -------
    int
        Exit code.

    Raises
    ------
    InputError
        If it is not allowed.
    DeviceError
        If a program has the devices, or the file cannot be removed.
    """
    # Which lock is meant, and whether this person may remove it.
    store = lock_store.LockStore.of_machine()
    found = {each.lock: each for each in store.find_locks()}
    remover = f"unix:{account_name()}"
    unlocking = decide_unlock(Command("unlock", remover, text=word, account=remover), tuple(found))
    if unlocking.lock is None:
        raise InputError(f"refused: {unlocking.refused}")
    stored = found[unlocking.lock]
    if stored.file is None:
        raise DeviceError(f"{stored.lock.text}; repair the folder by hand")
    # Only while no hold has the devices, and with a record of who did it.
    with contextlib.ExitStack() as stack:
        _require_no_hold(stored, stack)
        try:
            _log_removal(stored, remover, unlocking.reason.value)
            store.remove_lock(stored.file)
        except OSError as error:
            raise DeviceError(f"{stored.file}: cannot be removed ({os_reason(error)})") from None
    print(
        f"removed: {describe_lock(stored.lock)}, by its {unlocking.reason.value}", file=sys.stderr
    )
    return Exit.DONE


def _require_no_hold(stored: lock_store.StoredLock, stack: contextlib.ExitStack) -> None:
    """Claim the devices of a lock: a running hold has it in memory, and removes it with `ctl
    unlock`.
    """
    try:
        stack.enter_context(device_claim.claim_devices(stored.devices))
    except DeviceError as error:
        raise DeviceError(
            f"{error}; or remove the lock there: `membrane-ctrl ctl unlock`"
        ) from None


def _log_removal(stored: lock_store.StoredLock, remover: str, how: str) -> None:
    """Append who removed which lock, and how, to the log beside the locks."""
    assert stored.file is not None
    log: Path = stored.file.parent / lock_store.LOG_NAME
    now_utc = datetime.now(UTC).isoformat(timespec="seconds")
    entry = {"removed_utc": now_utc, "remover": remover, "how": how, **asdict(stored.lock)}
    files.append_text(log, json.dumps(entry) + "\n")
