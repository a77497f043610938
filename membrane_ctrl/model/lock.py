"""A lock: a person's order that the mirror must not be moved (lock-out, tag-out). Plain data.

Locks are separate from faults. Each has its author and a word. The author removes it, or a person
who types the displayed word: that is a deliberate act, which a click or a program's routine is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

LOCKS_MOST = 100  # at once: status messages and memory are bounded


@dataclass(frozen=True, slots=True)
class Lock:
    """One lock on a bench."""

    word: str  # names the lock; typing it removes another person's lock
    text: str  # why the mirror must not move
    author: str  # who set it, for people
    # login of its author; empty: set without a login, so that it has no author
    account: str = ""
    session: str = ""  # connection of its author
    set_utc: str = ""  # when, ISO 8601


def describe_lock(lock: Lock) -> str:
    """Return a lock in one line: text, author, time, word.

    Parameters
    ----------
    lock : Lock

    Returns
    -------
    str
    """
    session = f" ({lock.session})" if lock.session else ""
    since = f", {lock.set_utc}" if lock.set_utc else ""
    return f'"{lock.text}" by {lock.author}{session}{since}, word {lock.word}'


def describe_locks(locks: Sequence[Lock], most: int = LOCKS_MOST) -> str:
    """Return locks in one line, at most so many of them in full.

    Parameters
    ----------
    locks : sequence of Lock
    most : int
        The others are counted only.

    Returns
    -------
    str
        Empty without a lock.
    """
    lines = [describe_lock(lock) for lock in locks[:most]]
    if len(locks) > most:
        lines.append(f"and {len(locks) - most} more")
    return "; ".join(lines)
