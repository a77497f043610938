"""`membrane-ctrl serve`: the service that follows, starts and ends holds, and its page."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from membrane_ctrl.model import durations, errors, files
from membrane_ctrl.model.optional import PAGE_LIBRARIES, require_installed
from membrane_ctrl.web import token_commands

app = typer.Typer(
    invoke_without_command=True,
    rich_markup_mode="markdown",
    help="Serve the page and the interface for programs, before, during and after holds.",
)
_FILES = frozenset(
    {
        "logs",
        "configurations",
        "commissioning",
        "users_file",
        "certificate_file",
        "key_file",
        "url_file",
        "password_file",
        "ca_file",
    }
)
app.add_typer(token_commands.app, name="token")


@app.callback()
def serve(
    context: typer.Context,
    config: Annotated[
        Path | None, typer.Option("--config", help="Service file; other options go before it.")
    ] = None,
    logs: Annotated[Path | None, typer.Option(help="Folder of the runs; logs by default.")] = None,
    configurations: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the configurations to start holds with; by default, this one."
        ),
    ] = None,
    commissioning: Annotated[
        Path | None, typer.Option(help="Folder of the guided sessions; commissioning by default.")
    ] = None,
    fleet: Annotated[
        Path | None, typer.Option("--fleet", help="File with several holds; see `ctl fleet`.")
    ] = None,
    host: Annotated[str | None, typer.Option("--host", help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option("--port", min=1, max=65535, help="TCP port.")] = None,
    name: Annotated[
        list[str] | None, typer.Option("--name", help="Host name of the page; repeatable.")
    ] = None,
    public_url: Annotated[
        str | None,
        typer.Option(
            "--public-url",
            metavar="URL",
            help="Address that browsers open, behind a reverse proxy.",
        ),
    ] = None,
    trusted_proxy: Annotated[
        list[str] | None,
        typer.Option(metavar="ADDRESS", help="Proxy whose X-Forwarded-For counts; repeatable."),
    ] = None,
    users: Annotated[
        Path | None, typer.Option("--users", help="Names and passwords; see `serve add-user`.")
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--certificate", help="TLS certificate of the service.")
    ] = None,
    key: Annotated[Path | None, typer.Option("--key", help="Key of that certificate.")] = None,
    idle_end: Annotated[
        str | None,
        typer.Option(help="End after this long without viewers and holds, e.g. 1h.", hidden=True),
    ] = None,
    with_hold: Annotated[bool, typer.Option("--with-hold", hidden=True)] = False,
) -> None:
    """Serve until interrupted; without users, print a link that lets its holder in."""
    if context.invoked_subcommand is not None:
        return
    from membrane_ctrl.config.service import ServiceConfig
    from membrane_ctrl.config.toml_file import parse_tables
    from membrane_ctrl.control_port import ctl
    from membrane_ctrl.processes.command_process import end_with_parent

    # Imported here: other commands need no web libraries.
    for library in PAGE_LIBRARIES:
        require_installed(library, "web", "`serve`")
    from membrane_ctrl.web.server import serve

    # An option that was given replaces the entry of the service's file.
    given: dict[str, Any] = {
        "logs": logs,
        "configurations": configurations,
        "commissioning": commissioning,
        "host": host,
        "port": port,
        "names": name,
        "public_url": public_url,
        "trusted_proxies": trusted_proxy,
        "users_file": users,
        "certificate_file": certificate,
        "key_file": key,
    }
    tables = {} if config is None else _read_service_file(config)
    tables |= {
        option: str(value) if isinstance(value, Path) else value
        for option, value in given.items()
        if value is not None
    }
    page = parse_tables(tables, ServiceConfig, str(config or "serve"))
    if with_hold:
        end_with_parent()
    idle_s = math.inf if idle_end is None else durations.parse_duration_s(idle_end)
    # Without a fleet, the one hold that runs in the folder of the runs.
    holds = {"": ctl.Where(logs=Path(page.logs))} if fleet is None else ctl.fleet(fleet)
    serve(holds, page, idle_s)


def _read_service_file(file: Path) -> dict[str, Any]:
    """Return the tables of a service file. Raises InputError."""
    from membrane_ctrl.config.toml_file import read_toml

    return _resolve_files(read_toml(file), file.resolve().parent)


def _resolve_files(tables: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the tables of a service file with its files relative to its folder."""
    resolved: dict[str, Any] = {}
    for name, value in tables.items():
        if isinstance(value, dict):
            resolved[name] = _resolve_files(value, folder)
        elif name in _FILES and isinstance(value, str):
            resolved[name] = str(folder / Path(value).expanduser())
        else:
            resolved[name] = value
    return resolved


@app.command("check")
def check(
    config: Annotated[Path, typer.Argument(metavar="FILE", help="Service file.")],
    send: Annotated[
        bool, typer.Option("--send", help="Also send one heartbeat to each configured place.")
    ] = False,
) -> None:
    """Check a service file, its users, certificate and heartbeat, without serving."""
    from membrane_ctrl.config.service import ServiceConfig
    from membrane_ctrl.config.toml_file import parse_tables
    from membrane_ctrl.service.service_check import check_service

    page = parse_tables(_read_service_file(config), ServiceConfig, str(config))
    for line in check_service(page, send):
        print(line)


@app.command("add-user")
def add_user(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Users file; created if absent.")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name to log in with.")],
    role: Annotated[str, typer.Argument(metavar="ROLE", help="read, operate or tune.")],
) -> None:
    """Add a user to a users file, or change one; asks for the password."""
    from membrane_ctrl.service.accounts import known_user, known_users

    text = files.read_text(file) if file.exists() else ""
    found = known_users(text, str(file))
    password = typer.prompt("Password", hide_input=True, confirmation_prompt=sys.stdin.isatty())
    found[name] = known_user(name, role, password)
    with errors.convert_write_errors(file, errors.DeviceError):
        files.write_text_atomic(file, "".join(f"{each.line()}\n" for each in found.values()))
        file.chmod(0o600)
    print(f"{file}: {len(found)} users", file=sys.stderr)
