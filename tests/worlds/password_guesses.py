"""A person who types a password."""

from __future__ import annotations

from membrane_ctrl.service.accounts import Accounts
from membrane_ctrl.service.web_user import WebUser


def guess_password(
    accounts: Accounts, name: str, password: str, source: str = "", device: str = ""
) -> WebUser | None:
    """Who logs in from a network address; None if nobody, or after too many wrong passwords.

    `device` is the value of a device's cookie.
    """
    guess = accounts.guess_of(name, source, device)
    admission = accounts.throttle.admit(guess)
    return accounts.evaluate(guess, password, admission) if admission.granted else None
