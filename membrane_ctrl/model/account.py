"""Name of the account under which the program runs."""

import getpass
import os


def account_name() -> str:
    """The login name; for an account without one, as in a container, its number.

    The control port names accounts in the same way.
    """
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())
