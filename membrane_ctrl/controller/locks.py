"""Decisions on locks: what `latch` adds, who may `unlock`, and what a lock forbids. No I/O, no
clock, no randomness.

Word, author and time of a lock are part of its command, so that a replay decides the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.commands import AT_START
from membrane_ctrl.model.lock import LOCKS_MOST, Lock, describe_locks
from membrane_ctrl.model.lock_words import distinct_word

# These let gas into the mirror; while a lock is set they are refused
LIFTING = frozenset({"hold", "manual", "tune", "resume"})

_DEFAULT_TEXT = "locked by hand"


class UnlockReason(StrEnum):
    """Why a lock may be removed."""

    AUTHOR = "author"  # by the login that set it
    WORD = "word"  # by a person who typed its word


@dataclass(frozen=True, slots=True)
class Unlocking:
    """The decision on an `unlock`: the lock that it removes, or why it is refused."""

    lock: Lock | None = None
    reason: UnlockReason = UnlockReason.WORD
    refused: str = ""


def make_lock(command: Command, locks: Sequence[Lock]) -> Lock | None:
    """Return the lock that a `latch` adds.

    Parameters
    ----------
    command : Command
        The `latch`; its `lock` is used if it has one.
    locks : sequence of Lock
        Those already set.

    Returns
    -------
    Lock or None
        None for a program that repeats itself: one lock of its text is enough. People's locks are
        never merged.
    """
    lock = command.lock or Lock("", command.text, command.who, command.account)
    text = lock.text or _DEFAULT_TEXT
    if not command.from_person and any(
        (each.author, each.text) == (lock.author, text) for each in locks
    ):
        return None
    taken = {each.word for each in locks}
    return replace(lock, text=text, word=distinct_word(lock.word, taken))


def refuse_while_locked(command: Command, locks: Sequence[Lock]) -> str:
    """Return why a command is refused because of the locks; empty if it is not.

    Parameters
    ----------
    command : Command
        Refused may be those that lift the mirror (`LIFTING`), an `unlock`, and a `latch` beyond the
        most locks; all others never are.
    locks : sequence of Lock
        Those set.

    Returns
    -------
    str
        With the locks in words, and how to continue.
    """
    if command.kind == "unlock":
        return decide_unlock(command, locks).refused
    if command.kind == "latch" and command.who != AT_START and len(locks) >= LOCKS_MOST:
        return f"the mirror is locked by {LOCKS_MOST} locks already, the most there may be"
    if command.kind in LIFTING and locks:
        return f"locked: {describe_locks(locks)}; ask its author, then `unlock`"
    return ""


def decide_unlock(command: Command, locks: Sequence[Lock]) -> Unlocking:
    """Decide on an `unlock`.

    Without a word it removes the sender's own lock, if there is exactly one. With a word it removes
    the lock of that word, of any author. A bridge removes none: no person has read the
    word.

    Parameters
    ----------
    command : Command
        Its `text` is the typed word.
    locks : sequence of Lock
        Those set.

    Returns
    -------
    Unlocking
        The lock to remove and by which right, or why none is.
    """
    if not command.from_person:
        return Unlocking(
            refused="only a person removes a lock: use the page, or `membrane-ctrl ctl unlock`"
        )
    if not locks:
        return Unlocking(refused="no lock is set")
    # Without a word: the sender's own lock, if there is no doubt which.
    own = [lock for lock in locks if is_author(command, lock)]
    word = command.text.strip().lower()
    if not word:
        if len(own) == 1:
            return Unlocking(own[0], UnlockReason.AUTHOR)
        whose = (
            "you have several locks"
            if own
            else f"none of the locks is set by the login of {command.who}"
        )
        return Unlocking(refused=f"{whose}: give the word of one: {describe_locks(locks)}")
    # With a word: that lock.
    found = next((lock for lock in locks if lock.word == word), None)
    if found is None:
        return Unlocking(refused=f"no lock has the word {word!r}: {describe_locks(locks)}")
    return Unlocking(found, UnlockReason.AUTHOR if found in own else UnlockReason.WORD)


def is_author(command: Command, lock: Lock) -> bool:
    """Return whether the sender of a command has set a lock. Without a login the answer is no.

    Parameters
    ----------
    command : Command
        Its `account` is the sender's login, as the port has verified it.
    lock : Lock
        Its `account` is the login of the one who has set it; empty without a login.

    Returns
    -------
    bool
    """
    return lock.account != "" and lock.account == command.account
