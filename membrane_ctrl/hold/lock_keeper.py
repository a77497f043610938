"""Keeps the locks on disk in step with the controller. No tick waits for the disk; the answer to
`lock` does.

Another program may store a lock meanwhile (`safe` that does not find the hold): it becomes a
command of a tick.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from membrane_ctrl.controller import tick
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.commands import AT_START
from membrane_ctrl.instruments.lock_store import LockStore, StoredLock
from membrane_ctrl.model import events, run_events
from membrane_ctrl.model.errors import os_reason
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.lock_words import distinct_word

_CHECK_S = 1.0  # for locks that other programs store
_RETRY_S = 10.0  # of a write that failed
_OUTCOMES_MOST = 256  # remembered for the port, which asks at once


@dataclass(frozen=True, slots=True)
class LockStorage:
    """Where a hold keeps its locks: the store, the keys of its devices,
    and the locks at the start.
    """

    store: LockStore
    devices: frozenset[str]
    locks: tuple[StoredLock, ...] = ()


class LockKeeper:
    """Stores each new lock, removes the file of each removed one, and looks for locks that others
    store.

    Parameters
    ----------
    storage : LockStorage or None
        None: locks end with the run (the twin's default).
    report : callable
        Records that storing failed, or works again.
    send_command : callable
        Hands a command to the next tick.
    """

    def __init__(
        self,
        storage: LockStorage | None,
        report: Callable[[events.Event], None],
        send_command: Callable[[Command], None] = lambda command: None,
    ) -> None:
        self._storage = storage
        self._report = report
        self._send_command = send_command
        # one thread, so that a lock and its removal stay in order
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="locks")
        self._files: dict[str, Path | None] = {}  # by word; of the disk thread after the start
        if storage is not None:
            self._files = {each.lock.word: each.file for each in storage.locks}
        # by word: what to try again; of the disk thread
        self._failed: dict[str, Callable[[], None]] = {}
        self._pending: deque[events.Event] = deque()  # from the disk thread, as the next one
        self._asked: deque[Command] = deque()
        self._looking: Future[None] | None = None
        self._outcomes: dict[int, Future[str]] = {}  # by number of the request
        self._retry_at_s = time.monotonic() + _RETRY_S
        self._check_at_s = time.monotonic() + _CHECK_S

    @property
    def at_start(self) -> tuple[Lock, ...]:
        """Locks that are set when the run starts."""
        if self._storage is None:
            return ()
        return tuple(each.lock for each in self._storage.locks)

    def __enter__(self) -> LockKeeper:
        return self

    def __exit__(self, *_: object) -> None:
        self._disk.submit(self._retry_write)
        self._disk.shutdown()
        self._report_failure()

    def handle_tick(self, outputs: tick.TickOutputs) -> None:
        """After a tick: store the locks that it set, and remove those that it removed.

        Parameters
        ----------
        outputs : TickOutputs
            Its events name the locks; called in the tick's thread, which must not wait for the
            disk.
        """
        if self._storage is None:
            return
        # 1. What the disk thread has found since the last tick becomes events and commands here:
        #    only this thread may record them
        self._report_failure()
        # 2. New locks and removals, in the order of the events. A lock without a number is of
        #    the start, or of another program: it is stored already if its word is known
        for event in outputs.events:
            match event:
                case events.LockSet() if event.number or event.word not in self._files:
                    act = partial(self._store_lock, self._storage, _lock_of(event))
                    self._start_write(event.number, event.word, act)
                case events.LockRemoved():
                    act = partial(self._remove_file, self._storage, event.word)
                    self._start_write(event.number, event.word, act)
        # 3. Now and then: what has failed, and what other programs have stored
        if time.monotonic() >= self._retry_at_s:
            self._retry_at_s = time.monotonic() + _RETRY_S
            self._disk.submit(self._retry_write)
        if time.monotonic() >= self._check_at_s and (self._looking is None or self._looking.done()):
            self._check_at_s = time.monotonic() + _CHECK_S
            self._looking = self._disk.submit(self._find_new, self._storage)

    def find_outcome(self, number: int) -> Future[str] | None:
        """Return the outcome of a request that set or removed a lock.

        Parameters
        ----------
        number : int
            Of the request.

        Returns
        -------
        Future of str, or None
            Why it is not on the disk; empty: it is. None if the request changed no lock, or locks
            are not stored.
        """
        return self._outcomes.pop(number, None)

    def _start_write(self, number: int, word: str, act: Callable[[], None]) -> None:
        future = self._disk.submit(self._try_write, word, act)
        if number:
            self._outcomes[number] = future
            while len(self._outcomes) > _OUTCOMES_MOST:
                del self._outcomes[next(iter(self._outcomes))]

    def _store_lock(self, storage: LockStorage, lock: Lock) -> None:
        self._files[lock.word] = storage.store.write_lock(lock, storage.devices)

    def _remove_file(self, storage: LockStorage, word: str) -> None:
        file = self._files.get(word)
        if file is not None:
            storage.store.remove_lock(file)
        self._files.pop(word, None)

    def _try_write(self, word: str, act: Callable[[], None]) -> str:
        """Run an action of the disk thread; returns why it failed, or an empty text.

        Of several actions on one lock only the newest is tried again: after a removal the lock must
        not be stored.
        """
        try:
            act()
        except Exception as error:  # nothing else would see an exception of this thread
            if isinstance(error, OSError):
                reason = f"{error.filename}: {os_reason(error)}"
            else:
                reason = str(error)
            if word not in self._failed:
                self._pending.append(run_events.LockNotStored(word, reason))
            self._failed[word] = act
            return reason
        if self._failed.pop(word, None) is not None:
            self._pending.append(run_events.LockStored(word))
        return ""

    def _find_new(self, storage: LockStorage) -> None:
        """Ask for each lock on our devices that another program has stored.

        What cannot be read is no lock here, as it is at the start: a disk that fails must not end a
        hold of weeks.
        """
        known = set(self._files.values())
        for each in storage.store.find_locks(storage.devices):
            if not each.devices or each.file in known:
                continue
            lock = replace(each.lock, word=distinct_word(each.lock.word, self._files))
            self._files[lock.word] = each.file
            self._asked.append(Command("latch", AT_START, text=lock.text, lock=lock))

    def _retry_write(self) -> None:
        for word, act in list(self._failed.items()):
            self._try_write(word, act)

    def _report_failure(self) -> None:
        while self._pending:
            self._report(self._pending.popleft())
        while self._asked:
            self._send_command(self._asked.popleft())


def _lock_of(event: events.LockSet) -> Lock:
    return Lock(event.word, event.text, event.author, event.account, event.session, event.set_utc)
