"""Guesses are limited for each source and account, and no guess of a
stranger keeps the owner out.
"""

from __future__ import annotations

import threading

import pytest

from membrane_ctrl.service import accounts as account_store
from membrane_ctrl.service import login_throttle
from membrane_ctrl.service.accounts import Accounts, KnownUser
from membrane_ctrl.service.login_throttle import Guess, LoginThrottle
from tests.worlds.password_guesses import guess_password

RIGHT, WRONG = "correct horse", "wrong wrong"


class Clock:
    """Time that the test moves."""

    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr("time.monotonic", made)
    return made


@pytest.fixture
def evaluated(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The passwords that were hashed, by a function that takes no time."""
    found: list[str] = []

    def verify(digest: str, password: str) -> bool:
        found.append(password)
        return digest == f"hash of {password}"

    monkeypatch.setattr(account_store, "_verify_password", verify)
    return found


def accounts() -> Accounts:
    return Accounts(
        {name: KnownUser(name, "operate", f"hash of {RIGHT}") for name in ("anna", "bob")}
    )


def device_of(found: Accounts, name: str) -> str:
    """The cookie of a device that has logged in."""
    user = guess_password(found, name, RIGHT, source=f"home of {name}")
    assert user is not None
    device = found.device_cookie(user, "")
    assert device is not None
    return device.partition("=")[2].partition(";")[0]


def test_one_wrong_password_a_minute_keeps_no_user_out(clock: Clock, evaluated: list[str]) -> None:
    found = accounts()
    for _ in range(5):
        guess_password(found, "anna", WRONG)
    for _ in range(60):
        clock.now_s += 61.0
        assert guess_password(found, "anna", WRONG) is None
        clock.now_s += 1.0
        assert guess_password(found, "anna", RIGHT) is not None


def test_guesses_from_one_address_are_limited_over_time(clock: Clock, evaluated: list[str]) -> None:
    found = accounts()
    for _ in range(3600):
        guess_password(found, "anna", WRONG, "198.51.100.7")
        clock.now_s += 1.0
    assert 290 <= len(evaluated) <= 310, "5 at once, then one every 12 s"


def test_an_attack_from_one_address_leaves_other_addresses_alone(
    clock: Clock, evaluated: list[str]
) -> None:
    found = accounts()
    for number in range(2000):
        guess_password(found, "anna", f"guess {number}", "198.51.100.7")
        clock.now_s += 0.1
        if number % 100 == 0:
            assert guess_password(found, "anna", RIGHT, f"10.0.0.{number // 100}") is not None


def test_an_attack_from_many_addresses_is_limited_and_leaves_a_new_address_its_first_tries(
    clock: Clock, evaluated: list[str]
) -> None:
    found = accounts()
    for number in range(20_000):
        guess_password(found, "anna", WRONG, f"198.51.100.{number % 200}")
        clock.now_s += 0.01
    assert len(evaluated) <= 2 * 200 + 60 + 200, (
        "first tries of each address, then the budget of the account"
    )
    assert guess_password(found, "anna", RIGHT, "10.0.0.1") is not None
    assert guess_password(found, "anna", WRONG, "10.0.0.2") is None
    assert guess_password(found, "anna", RIGHT, "10.0.0.2") is not None, "one may mistype once"


def test_a_device_that_has_logged_in_has_its_own_budget(clock: Clock, evaluated: list[str]) -> None:
    found = accounts()
    device = device_of(found, "anna")
    for number in range(1000):
        guess_password(found, "anna", WRONG, "127.0.0.1")
        clock.now_s += 0.01
        if number % 100 == 0:
            assert guess_password(found, "anna", RIGHT, "127.0.0.1", device) is not None
    evaluated.clear()
    for _ in range(100):
        assert guess_password(found, "anna", WRONG, "127.0.0.1", device) is None
    assert len(evaluated) == 5, "a stolen device is limited, too"


@pytest.mark.parametrize("made", ["other", "forged", "cut", "empty"])
def test_a_device_counts_for_its_own_account_only(
    made: str, clock: Clock, evaluated: list[str]
) -> None:
    found = accounts()
    own = device_of(found, "anna")
    devices = {
        "other": device_of(found, "bob"),
        "forged": own[:-1] + ("0" if own[-1] != "0" else "1"),
        "cut": "x.",
        "empty": "",
    }
    evaluated.clear()
    for _ in range(50):
        guess_password(found, "anna", WRONG, "198.51.100.7", devices[made])
    assert len(evaluated) == 5


def test_a_device_ends_with_the_password_and_survives_a_restart(
    clock: Clock, evaluated: list[str]
) -> None:
    device = device_of(accounts(), "anna")
    assert accounts().guess_of("anna", "a", device).device == device
    changed = Accounts({"anna": KnownUser("anna", "operate", "hash of another")})
    assert changed.guess_of("anna", "a", device).device == ""


def test_parallel_guesses_are_all_counted(evaluated: list[str]) -> None:
    found = accounts()
    begin = threading.Barrier(40)

    def guess() -> None:
        begin.wait()
        guess_password(found, "anna", WRONG)

    threads = [threading.Thread(target=guess) for _ in range(40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(evaluated) == 5


def test_an_unknown_name_costs_and_waits_as_a_known_one(clock: Clock, evaluated: list[str]) -> None:
    found = accounts()
    for _ in range(50):
        assert guess_password(found, "nobody", RIGHT, "198.51.100.7") is None
    assert len(evaluated) == 5


def test_many_names_from_one_address_share_its_budget(clock: Clock, evaluated: list[str]) -> None:
    found = accounts()
    for number in range(1000):
        guess_password(found, f"name {number}", WRONG, "198.51.100.7")
    assert len(evaluated) == 20


def test_a_guess_that_was_not_evaluated_is_not_counted(clock: Clock) -> None:
    throttle = LoginThrottle()
    guess = Guess("anna", "198.51.100.7")
    for _ in range(500):
        admission = throttle.admit(guess)
        assert admission.granted
        throttle.withdraw(admission)
    granted = [throttle.admit(guess).granted for _ in range(20)]
    assert granted.count(True) == 5, "withdrawing gives no more than was taken"


def test_the_wait_is_as_long_as_stated(clock: Clock) -> None:
    throttle = LoginThrottle()
    guess = Guess("anna", "198.51.100.7")
    while throttle.admit(guess).granted:
        pass
    wait_s = throttle.admit(guess).wait_s
    assert 0.0 < wait_s <= 12.0
    clock.now_s += 0.99 * wait_s
    assert not throttle.admit(guess).granted
    clock.now_s += 0.02 * wait_s
    assert throttle.admit(guess).granted


def test_memory_of_the_throttle_is_bounded(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(login_throttle, "_KEYS_MAX", 100)
    throttle = LoginThrottle()
    for number in range(1000):
        throttle.admit(Guess(f"name {number}", f"source {number}"))
    assert (
        max(len(budgets._tokens) for budgets in (throttle._source, throttle._source_and_account))
        <= 100
    )
