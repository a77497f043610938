"""Checks a service file before it is used: users, certificate, heartbeat."""

from __future__ import annotations

from pathlib import Path

from membrane_ctrl.config.service import ServiceConfig
from membrane_ctrl.model import errors, files
from membrane_ctrl.service.accounts import KnownUser, known_users
from membrane_ctrl.service.heartbeat import make_heartbeat
from membrane_ctrl.service.listening import require_certificate
from membrane_ctrl.service.public_address import public_address


def read_users(page: ServiceConfig) -> dict[str, KnownUser]:
    """Return who may log in; nobody without a users file. Raises InputError for a wrong file."""
    if page.users_file is None:
        return {}
    try:
        users = known_users(files.read_text(Path(page.users_file)), page.users_file)
    except (OSError, ValueError) as error:
        raise errors.InputError(f"{page.users_file}: {error}") from None
    if not users:
        raise errors.InputError(
            f"{page.users_file}: no users; add one with `membrane-ctrl serve add-user`"
        )
    return users


def require_usable_files(page: ServiceConfig) -> None:
    """Raise InputError for files of certificate or heartbeat that cannot be used, DeviceError if
    the heartbeat's client is not installed.
    """
    make_heartbeat(page.heartbeat)
    if page.certificate_file is not None and page.key_file is not None:
        require_certificate(Path(page.certificate_file), Path(page.key_file))


def check_service(page: ServiceConfig, send: bool) -> list[str]:
    """Check a service file.

    Parameters
    ----------
    page : ServiceConfig
        As read from the file; nothing of it has been started.
    send : bool
        Send one heartbeat to each configured place, and wait for the answers.

    Returns
    -------
    list of str
        What the service would do, a line each.

    Raises
    ------
    InputError, DeviceError
        It could not be used; a heartbeat was not accepted.
    """
    users = read_users(page)
    require_usable_files(page)
    lines = [
        f"page: {public_address(page).base_url}",
        f"users: {', '.join(sorted(users)) or 'everybody who has the link'}",
        f"heartbeat: {_describe_heartbeat(page)}",
    ]
    if send and page.heartbeat.is_wanted:
        problems = make_heartbeat(page.heartbeat).send_once("only a test of the heartbeat")
        if problems:
            texts = "; ".join(f"heartbeat.{name}: {text}" for name, text in problems.items())
            raise errors.DeviceError(texts)
        lines.append("heartbeat sent; check that it has arrived")
    return lines


def _describe_heartbeat(page: ServiceConfig) -> str:
    heartbeat = page.heartbeat
    places = []
    if heartbeat.url_file is not None:
        places.append(f"the address in {heartbeat.url_file}")
    if heartbeat.mqtt is not None:
        places.append(f"{heartbeat.mqtt.topic} at {heartbeat.mqtt.host}:{heartbeat.mqtt.port}")
    if not places:
        return "none: nothing reports that this machine is dead"
    return f"every {heartbeat.every_s:g} s to {' and '.join(places)}"
