"""The subcommands of `membrane-ctrl tune`: thin, and quick to import."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from membrane_ctrl.model import durations
from membrane_ctrl.model.optional import PAGE_LIBRARIES, require_installed

if TYPE_CHECKING:
    from tuning.options import TuneOptions


app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Tune the loops in sessions on a running hold, or on the twin.",
)

TwinOption = Annotated[bool, typer.Option("--twin", help="Work on the twin, in virtual time.")]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="With --twin: its configuration.")
]
RunOption = Annotated[Path | None, typer.Option("--run", help="Run folder of the hold.")]
SocketOption = Annotated[Path | None, typer.Option("--socket", help="Control port of the hold.")]
LogsOption = Annotated[Path, typer.Option("--logs", help="Keep sessions in LOGS/tuning.")]
SessionOption = Annotated[
    Path | None, typer.Option("--session", "--resume", help="Resume this session.")
]
NameOption = Annotated[str, typer.Option("--name", help="Name of a new session.")]
AuthorOption = Annotated[
    str | None, typer.Option("--author", help="Who is tuning; your login by default.")
]
ReasonOption = Annotated[
    str, typer.Option("--reason", help="Reason, for the gains file and the journal.")
]
LimitOption = Annotated[
    float, typer.Option(min=3, max=30, help="Largest excursion of the centre in an experiment, µm.")
]
ObserveOption = Annotated[str, typer.Option(help="Duration of the quiet hold, 5m to 15m.")]
VerifyOption = Annotated[str, typer.Option(help="Duration of the verification.")]
YesOption = Annotated[bool, typer.Option("--yes", help="Apply the proposal without asking.")]
ChooseOption = Annotated[
    str, typer.Option("--choose", help="Apply this candidate without asking.", metavar="NAME")
]
PageOption = Annotated[
    bool, typer.Option("--page", help="With `run`: print the link of the page that shows it.")
]
ShortOption = Annotated[
    bool,
    typer.Option("--short", help="Short form: five minutes of experiments, five of verification."),
]
WaitOption = Annotated[bool, typer.Option("--wait", help="Wait until the mirror is held.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
TakeOverOption = Annotated[
    bool, typer.Option("--take-over", help="Take command from the client that has it.")
]

_STEPS = {
    "characterise": "Excite the loop with a relay and doublets about the mean flow; starts a session.",  # noqa: E501
    "identify": "Identify gain, dead time and lag with their errors; judge whether the data support a "  # noqa: E501
    "proposal.",
    "observe": "Observe a quiet hold: laser noise and weather.",
    "design": "Compare candidates side by side and propose gains.",
    "preview": "Simulate present and proposed gains on the fitted twin.",
    "apply": "Apply the gains that you choose on trial; they revert unless `verify` keeps them.",
    "verify": "Verify the new gains over ten minutes of hold; keep them, or revert (exit 3).",
    "run": "Run all steps that are not done yet; shows the candidates and asks before any gains "
    "change.",
    "pump": "Measure the pump's curve (flow, start, stall, delay) and the leak, for [pump].",
    "outer": "Measure sag sensitivity, noise and drift of the figure; try a time constant for the "
    "shape loop.",
    "watch": "Watch a hold without touching it; report whether a session is due (exit 3).",
    "rollback": "Restore the gains from before the last kept session.",
}


def _step(name: str) -> None:
    """Make the command for a step; all steps take the same options."""

    def command(
        twin: TwinOption = False,
        config: ConfigOption = None,
        run: RunOption = None,
        socket: SocketOption = None,
        logs: LogsOption = Path("logs"),
        session: SessionOption = None,
        session_name: NameOption = "session",
        author: AuthorOption = None,
        reason: ReasonOption = "tuning session",
        limit_um: LimitOption = 10.0,
        observe: ObserveOption = "10m",
        verify: VerifyOption = "10m",
        take_over: TakeOverOption = False,
        yes: YesOption = False,
        choose: ChooseOption = "",
        json: JsonOption = False,
        page: PageOption = False,
        short: ShortOption = False,
        wait: WaitOption = False,
    ) -> int:
        from membrane_ctrl.config import schema, toml_file
        from membrane_ctrl.control_port.ctl import Where
        from membrane_ctrl.model.account import account_name
        from tuning.options import TuneOptions

        options = TuneOptions(
            config=schema.Config()
            if config is None
            else toml_file.load_toml(config, schema.Config),
            twin=twin,
            where=Where(socket, run, logs=logs),
            logs=logs,
            session=session,
            name=session_name,
            author=author or account_name(),
            reason=reason,
            limit_um=limit_um,
            observe_s=durations.parse_duration_s(observe),
            verify_s=min(durations.parse_duration_s(verify), 300.0 if short else math.inf),
            take_over=take_over,
            yes=yes,
            choose=choose,
            json=json,
            page=page,
            short=short,
            wait=wait,
        )
        return _run(name, options)

    app.command(name=name, help=_STEPS[name])(command)


def _run(name: str, options: TuneOptions) -> int:
    from tuning.commands import map_pump, roll_back, shape_loop, watch
    from tuning.commands.run import run_session, run_step

    whole = {
        "run": run_session,
        "pump": map_pump.run_map_pump,
        "outer": shape_loop.tune_shape_loop,
        "watch": watch.watch_hold,
        "rollback": roll_back.roll_back,
    }
    return whole[name](options) if name in whole else run_step(name, options)


for _name in _STEPS:
    _step(_name)


@app.command()
def history(logs: LogsOption = Path("logs"), json: JsonOption = False) -> int:
    """List which gains were kept, reverted or rolled back, when, by whom and why."""
    import json as json_module

    from membrane_ctrl.sessions.session_json import to_plain
    from tuning.journal import format_history, read_entries

    found = read_entries(logs)
    print(json_module.dumps(to_plain(found)) if json else format_history(found))
    return 0


@app.command()
def save(
    config: Annotated[
        Path, typer.Option("--config", help="Configuration to save them to, one TOML file.")
    ],
    session: Annotated[
        Path | None, typer.Argument(metavar="SESSION", help="By default the one kept last.")
    ] = None,
    logs: LogsOption = Path("logs"),
    author: AuthorOption = None,
    yes: Annotated[bool, typer.Option("--yes", help="Save without asking.")] = False,
) -> int:
    """Save the kept gains of a session into a configuration, so that the next hold starts with
    them.
    """
    from membrane_ctrl.model.account import account_name
    from tuning.commands import save

    return save.save_to_configuration(config, session, logs, author or account_name(), yes)


@app.command()
def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="Session folder.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Session folder.")],
) -> int:
    """Compare two sessions: the gains of each on the plant and weather of each."""
    from membrane_ctrl.sessions.folder import open_session
    from tuning.commands.compare import compare_sessions

    print(compare_sessions(open_session(a), open_session(b)))
    return 0


@app.command()
def explore(
    folder: Annotated[Path, typer.Argument(metavar="RUN|SESSION", help="Run or session folder.")],
) -> int:
    """Explore gains by hand: open the page with its sliders, on the fitted plant in the recorded
    weather; a session live.
    """
    for library in PAGE_LIBRARIES:
        require_installed(library, "web", "`tune explore`")
    from tuning.commands.open_page import explore

    return explore(folder)
