"""`membrane-ctrl web`: serves the page."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl.model import errors, files
from membrane_ctrl.model.optional import require_installed

app = typer.Typer(
    invoke_without_command=True,
    rich_markup_mode="markdown",
    help="Serve a page that shows the hold and sends commands to it.",
)


@app.callback()
def web(
    context: typer.Context,
    logs: Annotated[Path, typer.Option("--logs", help="Folder of the runs.")] = Path("logs"),
    socket: Annotated[
        Path | None, typer.Option("--socket", help="Control port of the hold.")
    ] = None,
    run: Annotated[Path | None, typer.Option("--run", help="Run folder of the hold.")] = None,
    fleet: Annotated[
        Path | None, typer.Option("--fleet", help="File with several holds; see `ctl fleet`.")
    ] = None,
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=1, max=65535, help="TCP port.")] = 7480,
    name: Annotated[
        list[str] | None, typer.Option("--name", help="Host name of the page; repeatable.")
    ] = None,
    public_url: Annotated[
        str,
        typer.Option(
            "--public-url",
            metavar="URL",
            help="Address that browsers open, behind a reverse proxy.",
        ),
    ] = "",
    trusted_proxy: Annotated[
        list[str] | None,
        typer.Option(metavar="ADDRESS", help="Proxy whose X-Forwarded-For counts; repeatable."),
    ] = None,
    users: Annotated[
        Path | None, typer.Option("--users", help="Names and passwords; see `web add-user`.")
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--certificate", help="TLS certificate of the page.")
    ] = None,
    key: Annotated[Path | None, typer.Option("--key", help="Key of that certificate.")] = None,
    with_hold: Annotated[bool, typer.Option("--with-hold", hidden=True)] = False,
) -> None:
    """Serve the page until interrupted; without users, print a link that lets its holder in."""
    if context.invoked_subcommand is not None:
        return
    from membrane_ctrl.config.port import WebConfig
    from membrane_ctrl.config.toml_file import parse_tables
    from membrane_ctrl.control_port import ctl
    from membrane_ctrl.processes.command_process import end_with_parent

    require_installed("nicegui", "web", "`web`")
    from membrane_ctrl.web.server import serve

    given = {"host": host, "port": port, "names": tuple(name or ())}
    given |= {"public_url": public_url, "trusted_proxies": tuple(trusted_proxy or ())}
    kept = {"users_file": users, "certificate_file": certificate, "key_file": key}
    page = parse_tables(
        given | {key: file and str(file) for key, file in kept.items()}, WebConfig, "web"
    )
    if with_hold:
        end_with_parent()
    serve({"": ctl.Where(socket, run, logs=logs)} if fleet is None else ctl.fleet(fleet), page)


@app.command("add-user")
def add_user(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Users file; created if absent.")],
    name: Annotated[str, typer.Argument(metavar="NAME")],
    role: Annotated[str, typer.Argument(metavar="ROLE", help="read, operate or tune.")],
) -> None:
    """Add a user to a users file, or change one; asks for the password."""
    from membrane_ctrl.service.access import known_user, known_users

    text = files.read_text(file) if file.exists() else ""
    found = known_users(text, str(file))
    password = typer.prompt("Password", hide_input=True, confirmation_prompt=sys.stdin.isatty())
    found[name] = known_user(name, role, password)
    with errors.convert_write_errors(file, errors.DeviceError):
        files.write_text_atomic(file, "".join(f"{each.line()}\n" for each in found.values()))
        file.chmod(0o600)
    print(f"{file}: {len(found)} users", file=sys.stderr)
