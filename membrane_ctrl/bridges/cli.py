"""`membrane-ctrl bridges`: one process that follows a hold and serves
it to the lab's other systems.
"""

from __future__ import annotations

import importlib
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from membrane_ctrl.cli.ctl import AuthorityOption, HostOption, TokenOption
from membrane_ctrl.model import errors

if TYPE_CHECKING:
    from membrane_ctrl.bridges.bridge import Bridge

_BRIDGES = ("opcua", "epics", "mqtt")  # tables of the configuration, and modules

app = typer.Typer(
    invoke_without_command=True,
    rich_markup_mode="markdown",
    help="Open the bridges of `[bridges]`: the hold's values by MQTT, OPC UA and EPICS, and "
    "commands by role.",
)


@app.callback()
def bridges(
    context: typer.Context,
    config: Annotated[
        Path | None, typer.Option("--config", help="Configuration with the table `[bridges]`.")
    ] = None,
    logs: Annotated[
        Path | None,
        typer.Option("--logs", help="Folder of the runs; recording.logs_dir by default."),
    ] = None,
    socket: Annotated[
        Path | None,
        typer.Option(
            "--socket", help="Control port of the hold; that of the configuration by default."
        ),
    ] = None,
    host: HostOption = "",
    token_file: TokenOption = None,
    authority: AuthorityOption = None,
    hold: Annotated[
        str, typer.Option(help="With --host: name of the hold there, if there are several.")
    ] = "",
) -> None:
    """Serve until interrupted."""
    if context.invoked_subcommand is not None:
        return
    import asyncio

    from membrane_ctrl.bridges.bridge import Bridge
    from membrane_ctrl.cli.options import load_configuration
    from membrane_ctrl.config.needed_packages import list_missing_packages
    from membrane_ctrl.control_port.ctl import Where
    from membrane_ctrl.control_port.service_client import ServiceAddress, read_token
    from membrane_ctrl.service.service_feed import make_feed

    settings = load_configuration(config)
    for needed in list_missing_packages(settings):
        raise errors.InputError(needed.missing_line)
    if not any(getattr(settings.bridges, name) for name in _BRIDGES):
        raise errors.InputError(
            "no bridge is configured: add [bridges.mqtt], [bridges.opcua] or [bridges.epics] "
            "(docs/how-to/bridges.md)"
        )
    if host:
        address = ServiceAddress(host, read_token(token_file), authority, hold)
        where = Where(service=address)
    else:
        folder = logs or Path(settings.recording.logs_dir)
        where = Where(socket or settings.port.socket_in(folder), logs=folder)
    asyncio.run(_serve(Bridge(make_feed(where, with_signals=True), settings)))


@app.command()
def names() -> None:
    """Print the published names with their units, as a Markdown table."""
    from membrane_ctrl.bridges.bridge import TABLE
    from membrane_ctrl.service.published_signals import table_lines

    print("\n".join(table_lines(TABLE)))


async def _serve(bridge: Bridge) -> None:
    import asyncio

    opened = _opened(bridge)
    main = asyncio.current_task()
    assert main is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, main.cancel)
    wrong: BaseExceptionGroup[errors.CommandError] | None = None
    bridge.feed.open()
    try:
        async with asyncio.TaskGroup() as all_bridges:
            for each in opened:
                all_bridges.create_task(each)
    except* errors.CommandError as group:
        wrong = group
    except* asyncio.CancelledError:
        print("bridges: closed", file=sys.stderr)
    finally:
        await bridge.close()
        await asyncio.to_thread(bridge.feed.close)
    if wrong is not None:
        raise _first_error(wrong)


def _first_error(group: BaseExceptionGroup[errors.CommandError]) -> errors.CommandError:
    """The first error of a group, also of groups in it."""
    first = group.exceptions[0]
    if not isinstance(first, BaseExceptionGroup):
        return first
    return _first_error(first)


def _opened(bridge: Bridge) -> list[Any]:
    """The bridges of the settings, to be awaited."""
    opened = []
    for name in _BRIDGES:
        settings = getattr(bridge.settings, name)
        if settings is None:
            continue
        opened.append(
            importlib.import_module(f"membrane_ctrl.bridges.{name}").serve(settings, bridge)
        )
    return opened
