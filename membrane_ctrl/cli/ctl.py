"""The commands of `ctl`: one for each command of a running hold, with its own arguments and the
common options.
"""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from membrane_ctrl.cli.action_first import ActionFirst
from membrane_ctrl.cli.options import JsonOption, parse_number_argument
from membrane_ctrl.model import durations

WhyOption = Annotated[str, typer.Option(help="Reason, recorded with the command.")]
TakeOverOption = Annotated[
    bool, typer.Option("--take-over", help="Take command from the client that has it.")
]
RunOption = Annotated[Path | None, typer.Option(help="The run's folder.")]
SocketOption = Annotated[
    Path | None, typer.Option(help="The hold's socket; logs/control.sock by default.")
]
HostOption = Annotated[
    str,
    typer.Option(metavar="URL", help="Ask a service, such as https://bench2.lab:7480/."),
]
TokenOption = Annotated[
    Path | None,
    typer.Option(help="With --host: file with a token; else the variable MEMBRANE_CTRL_TOKEN."),
]
AuthorityOption = Annotated[
    Path | None, typer.Option(help="With --host: the CA of the service's certificate.")
]
OnArgument = Annotated[
    bool,
    typer.Argument(
        metavar="on|off",
        help="on: hold the figure as it is from now on; off: the trim keeps its value.",
    ),
]
TextArgument = Annotated[str, typer.Argument(metavar="TEXT", help="The remark.")]
ReasonArgument = Annotated[str, typer.Argument(metavar="TEXT", help="Why the mirror is locked.")]
WordArgument = Annotated[
    str,
    typer.Argument(
        metavar="WORD", help="The lock's word, as displayed; without it, your own lock."
    ),
]
GainsArgument = Annotated[
    str,
    typer.Argument(
        metavar="FILE", help="TOML or JSON file with loop keys, or just the keys: 'kp_per_s = 0.5'."
    ),
]
TurnedOption = Annotated[
    float | None,
    typer.Option(
        metavar="DEGREES",
        help="Turn of the mirror about its axis, counter-clockwise for the camera.",
    ),
]
TrialOption = Annotated[
    str,
    typer.Option(
        help="Trial time, e.g. 2m; the old gains return afterwards unless kept by `ctl keep`."
    ),
]
EveryOption = Annotated[str, typer.Option(help="Interval between lines, e.g. 0.5s.")]


SetpointArgument = Annotated[
    float, typer.Argument(metavar="UM", help="Setpoint, µm.", parser=parse_number_argument)
]
FlowArgument = Annotated[
    float,
    typer.Argument(metavar="FLOW", help="Flow, µm/s of the centre.", parser=parse_number_argument),
]


ctl_app = typer.Typer(
    cls=ActionFirst,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Control a running hold: show its status, or send a command.",
)


def _make_common_fields(
    why: WhyOption = "",
    take_over: TakeOverOption = False,
    run: RunOption = None,
    socket: SocketOption = None,
    host: HostOption = "",
    token_file: TokenOption = None,
    authority: AuthorityOption = None,
    json: JsonOption = False,
) -> tuple[dict[str, Any], Any, bool]:
    """Return the common request fields, the target hold,
    and whether to print the answer as JSON.
    """
    from membrane_ctrl.control_port.ctl import Where
    from membrane_ctrl.control_port.service_client import ServiceAddress, read_token

    service = None
    if host:
        service = ServiceAddress(host, read_token(token_file), authority)
    return {"why": why, "take_over": take_over}, Where(socket, run, service=service), json


def _add_command(action: str, does: str, own: Callable[..., dict[str, Any]]) -> None:
    """Add a command with the common options and the parameters of `own`, which makes its part of
    the request.
    """
    parameters = inspect.signature(own).parameters

    # Typer reads options from a signature: the command takes whatever is given, and gets the joined
    # signature of its own arguments and the common options.
    def command(**given: Any) -> int:
        from membrane_ctrl.control_port.ctl import ctl

        part = own(**{name: given.pop(name) for name in parameters})
        fields, where, as_json = _make_common_fields(**given)
        return ctl({"do": action, **fields, **part}, where, as_json)

    command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for parameter in (
                *parameters.values(),
                *inspect.signature(_make_common_fields).parameters.values(),
            )
        ]
    )
    # a negative setpoint or a text that begins with a dash is not an option
    settings = {"ignore_unknown_options": bool(parameters)}
    ctl_app.command(action, help=does, context_settings=settings)(command)


def _plain() -> dict[str, Any]:
    return {}


def _setpoint(um: SetpointArgument) -> dict[str, Any]:
    return {"value": um}


def _manual(flow: FlowArgument) -> dict[str, Any]:
    return {"value": flow}


def _gains(loop: GainsArgument, trial: TrialOption = "") -> dict[str, Any]:
    from membrane_ctrl.control_port.ctl import loop_keys

    return {"loop": loop_keys(loop)} | (
        {"value": durations.parse_duration_s(trial)} if trial else {}
    )


def _capture(turned_deg: TurnedOption = None) -> dict[str, Any]:
    if turned_deg is None:
        return {}
    return {"value": turned_deg}


def _mark(text: TextArgument) -> dict[str, Any]:
    return {"text": text}


def _latch(text: ReasonArgument = "") -> dict[str, Any]:
    return {"text": text}


def _unlock(word: WordArgument = "") -> dict[str, Any]:
    return {"text": word}


def _shape(on: OnArgument) -> dict[str, Any]:
    return {"do": "shape_on" if on else "shape_off"}


def _watch(every: EveryOption = "1s") -> dict[str, Any]:
    return {"period_s": durations.parse_duration_s(every)}


def _fleet(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="TOML file with a table [[holds]] for each.")
    ],
    json: JsonOption = False,
) -> int:
    """Show the status of several holds, a line each."""
    from membrane_ctrl.control_port.ctl import fleet_status

    return fleet_status(file, json)


def add_actions() -> None:
    """Add the commands of `ctl`. Other commands need not wait for the controller's table."""
    from membrane_ctrl.controller.commands import SAME_AS, TABLE

    if ctl_app.registered_commands:
        return
    own_arguments: dict[str, Callable[..., dict[str, Any]]] = {
        "setpoint": _setpoint,
        "manual": _manual,
        "gains": _gains,
        "capture": _capture,
        "mark": _mark,
        "latch": _latch,
        "unlock": _unlock,
    }
    _add_command("status", "Show the status once.", _plain)
    ctl_app.command("fleet")(_fleet)
    _add_command("watch", "Print a status line repeatedly until the run ends.", _watch)
    for kind, rule in TABLE.items():
        # `tune` is a separate command
        if kind in own_arguments or not (rule.needs or kind.startswith("shape_")):
            _add_command(kind, rule.does, own_arguments.get(kind, _plain))
    for name, kind in SAME_AS.items():
        _add_command(name, TABLE[kind].does, own_arguments.get(kind, _plain))
    _add_command("shape", "Switch the shape loop on or off.", _shape)
    _add_command("quiet", "Acknowledge the alarms: no reminders, no escalation.", _plain)
    _add_command("release", "Release command, so that someone else may take it.", _plain)
