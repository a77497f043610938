"""`membrane-ctrl doors`: one process that follows a hold and serves
it to the lab's other systems.
"""

from __future__ import annotations

import importlib
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from membrane_ctrl.model import errors

if TYPE_CHECKING:
    from membrane_ctrl.doors.names import Door

_BRIDGES = ("opcua", "epics", "mqtt")  # tables of the configuration, and modules

app = typer.Typer(
    invoke_without_command=True,
    rich_markup_mode="markdown",
    help="Open the doors of `[doors]`: the hold's values by MQTT, OPC UA and EPICS, and commands "
    "by role.",
)


@app.callback()
def doors(
    context: typer.Context,
    config: Annotated[
        Path | None, typer.Option("--config", help="Configuration with the table `[doors]`.")
    ] = None,
    logs: Annotated[Path | None, typer.Option("--logs", help="Folder of the runs.")] = None,
    socket: Annotated[
        Path | None, typer.Option("--socket", help="Control port of the hold.")
    ] = None,
) -> None:
    """Serve until interrupted."""
    if context.invoked_subcommand is not None:
        return
    import asyncio

    from membrane_ctrl.cli.options import load_configuration
    from membrane_ctrl.config.needed_packages import missing_packages
    from membrane_ctrl.doors.names import Door

    settings = load_configuration(config)
    for needed in missing_packages(settings):
        raise errors.InputError(needed.missing_line)
    if not any(getattr(settings.doors, name) for name in _BRIDGES):
        raise errors.InputError(
            "no bridge is configured: add [doors.mqtt], [doors.opcua] or [doors.epics] "
            "(docs/how-to/bridges.md)"
        )
    asyncio.run(_serve(Door.to(settings, logs, socket)))


@app.command()
def names() -> None:
    """Print the published names with their units, as a Markdown table."""
    from membrane_ctrl.doors.names import TABLE, table_lines

    print("\n".join(table_lines(TABLE)))


async def _serve(door: Door) -> None:
    import asyncio

    opened = _opened(door)
    main = asyncio.current_task()
    assert main is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, main.cancel)
    wrong: BaseExceptionGroup[errors.CommandError] | None = None
    door.feed.open()
    try:
        async with asyncio.TaskGroup() as all_doors:
            for each in opened:
                all_doors.create_task(each)
    except* errors.CommandError as group:
        wrong = group
    except* asyncio.CancelledError:
        print("doors: closed", file=sys.stderr)
    finally:
        await door.close()
        await asyncio.to_thread(door.feed.close)
    if wrong is not None:
        raise _first_error(wrong)


def _first_error(group: BaseExceptionGroup[errors.CommandError]) -> errors.CommandError:
    """The first error of a group, also of groups in it."""
    first = group.exceptions[0]
    return _first_error(first) if isinstance(first, BaseExceptionGroup) else first


def _opened(door: Door) -> list[Any]:
    """The doors of the settings, to be awaited."""
    opened = []
    for name in _BRIDGES:
        settings = getattr(door.settings, name)
        if settings is None:
            continue
        opened.append(importlib.import_module(f"membrane_ctrl.doors.{name}").serve(settings, door))
    return opened
