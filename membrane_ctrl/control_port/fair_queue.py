"""A bounded queue that serves its kinds of items in turn, so that a flood of one kind delays no
other kind.
"""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class FairQueue(Generic[T]):
    """Items by kind, at most `most_each` of a kind; `take` serves the kinds in turn.

    With k kinds waiting, the oldest item of each kind is served after at most k - 1 others.
    """

    def __init__(self, most_each: int) -> None:
        self._most_each = most_each
        self._waiting: dict[str, deque[T]] = {}  # in the order of the next turns

    def __len__(self) -> int:
        return sum(len(items) for items in self._waiting.values())

    def put(self, kind: str, item: T) -> bool:
        """Add an item.

        Parameters
        ----------
        kind : str
            Of the item.
        item : T
            The item.

        Returns
        -------
        bool
            Whether there was room for one more of its kind.
        """
        items = self._waiting.setdefault(kind, deque())
        if len(items) >= self._most_each:
            return False
        items.append(item)
        return True

    def waiting_of(self, kind: str) -> tuple[T, ...]:
        """Return the items of a kind, oldest first."""
        return tuple(self._waiting.get(kind, ()))

    def take(self) -> T | None:
        """Remove and return the oldest item of the kind whose turn it is; None if nothing waits."""
        for kind, items in self._waiting.items():
            item = items.popleft()
            # The kind goes to the end of the turns, or leaves them until it has items again.
            del self._waiting[kind]
            if items:
                self._waiting[kind] = items
            return item
        return None
