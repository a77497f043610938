"""Limits on password guesses that never lock a name for its owner.

A guess is counted before it is evaluated, under one lock, so that parallel guesses cannot pass the
limit together. The budgets refill with time; nothing is ever locked for a fixed time after the last
guess, because then a stranger could keep the owner out with one guess a minute.

- A device that has logged in as this account before has a budget of its own.
- All others share the budget of their network address, for this account and for all accounts
  together.
- Guesses at one account from many addresses also share the budget of the account. The first tries
  of each address are
  exempt: an owner at a new address competes with nobody.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from dataclasses import dataclass, field

# remembered keys of each budget; beyond, the one that was used longest ago is forgotten
_KEYS_MAX = 20_000


@dataclass(slots=True)
class Budgets:
    """A token bucket for each key: `burst` tokens, one more every `refill_s` seconds. Not
    thread-safe.
    """

    burst: int
    refill_s: float
    _tokens: OrderedDict[tuple[str, ...], tuple[float, float]] = field(default_factory=OrderedDict)

    def wait_s(self, key: tuple[str, ...], now_s: float) -> float:
        """Return the time until a key has a token.

        Parameters
        ----------
        key : tuple of str
            What the budget is of.
        now_s : float
            Monotonic time.

        Returns
        -------
        float
            Seconds; 0 if it has one.
        """
        return max(0.0, 1.0 - self._filled(key, now_s)) * self.refill_s

    def take(self, key: tuple[str, ...], now_s: float) -> None:
        """Take a token; a bucket may owe one, because the caller decides.

        Parameters
        ----------
        key : tuple of str
            What the budget is of, such as address and account.
        now_s : float
            Monotonic time.
        """
        self._set(key, self._filled(key, now_s) - 1.0, now_s)

    def give_back(self, key: tuple[str, ...], now_s: float) -> None:
        """Return a token that was taken; never beyond the full budget.

        Parameters
        ----------
        key : tuple of str
            What the budget is of, such as address and account.
        now_s : float
            Monotonic time.
        """
        self._set(key, min(self._filled(key, now_s) + 1.0, self.burst), now_s)

    def forget(self, key: tuple[str, ...]) -> None:
        """Give the key its full budget."""
        self._tokens.pop(key, None)

    def _filled(self, key: tuple[str, ...], now_s: float) -> float:
        tokens, at_s = self._tokens.get(key, (float(self.burst), now_s))
        return min(tokens + (now_s - at_s) / self.refill_s, float(self.burst))

    def _set(self, key: tuple[str, ...], tokens: float, now_s: float) -> None:
        self._tokens[key] = tokens, now_s
        self._tokens.move_to_end(key)
        if len(self._tokens) > _KEYS_MAX:
            self._tokens.popitem(last=False)


@dataclass(frozen=True, slots=True)
class Guess:
    """Who tries a password for which account.

    `source` is the network address, `device` the identifier of a device that has logged in as this
    account before, empty for all others.
    """

    account: str
    source: str
    device: str = ""


@dataclass(frozen=True, slots=True)
class Admission:
    """Whether a guess may be evaluated now."""

    wait_s: float  # 0: yes; else the seconds until the next try
    taken: tuple[tuple[Budgets, tuple[str, ...]], ...] = ()  # the budgets that it was counted in

    @property
    def granted(self) -> bool:
        """Whether the password may be evaluated."""
        return self.wait_s == 0.0


class LoginThrottle:
    """Counts guesses and refuses those beyond the budgets. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._device = Budgets(burst=5, refill_s=12.0)
        self._source_and_account = Budgets(burst=5, refill_s=12.0)
        self._source = Budgets(burst=20, refill_s=3.0)
        self._account = Budgets(burst=60, refill_s=1.0)
        self._first_tries = Budgets(burst=2, refill_s=1800.0)

    def admit(self, guess: Guess) -> Admission:
        """Count a guess before its password is evaluated; a refused guess is not counted."""
        with self._lock:
            now_s = time.monotonic()
            needed = self._needed(guess, now_s)
            wait_s = max(budget.wait_s(key, now_s) for budget, key in needed)
            if wait_s > 0.0:
                return Admission(wait_s)
            for budget, key in needed:
                budget.take(key, now_s)
            return Admission(0.0, needed)

    def withdraw(self, admission: Admission) -> None:
        """Return what an admitted guess took, because its password was not evaluated."""
        with self._lock:
            now_s = time.monotonic()
            for budget, key in admission.taken:
                budget.give_back(key, now_s)

    def note_success(self, guess: Guess, admission: Admission) -> None:
        """Restore the budget of a client that gave the right password.

        Parameters
        ----------
        guess : Guess
            The right one. Its device, and its address for this account, have the full budget again.
        admission : Admission
            What the guess took, also from the budgets that it shares with others; it is returned.
        """
        self.withdraw(admission)
        with self._lock:
            self._device.forget((guess.device,))
            self._source_and_account.forget((guess.source, guess.account))
            self._first_tries.forget((guess.source, guess.account))

    def _needed(self, guess: Guess, now_s: float) -> tuple[tuple[Budgets, tuple[str, ...]], ...]:
        """Return the budgets in which a guess counts."""
        # A device of the owner has a budget that no stranger can use up
        if guess.device:
            return ((self._device, (guess.device,)),)
        # The others: a few guesses an address at one account, some more at all accounts together.
        # An attack from many addresses meets the account's budget, from which the first two tries
        # of an address are exempt
        both = (guess.source, guess.account)
        exempt = self._first_tries.wait_s(both, now_s) == 0.0
        shared = (self._first_tries, both) if exempt else (self._account, (guess.account,))
        return (self._source_and_account, both), (self._source, (guess.source,)), shared
