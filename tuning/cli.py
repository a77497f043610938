"""The subcommands of `membrane-ctrl tune`: thin, and quick to import."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from membrane_ctrl.config.schema import Config, LoopConfig
from membrane_ctrl.config.toml_file import load
from membrane_ctrl.model.clock import parse_duration_s
from membrane_ctrl.sessions.folder import SessionFolder
from tuning.gains_file import GainsFile, load_gains
from tuning.identification.loop_model import Gains
from tuning.proposal import candidates, design
from tuning.session import disturbance_of, found_of

if TYPE_CHECKING:
    from tuning.command import TuneOptions


app = typer.Typer(no_args_is_help=True, help="Tune the loops in sessions on a running hold, or on the twin.")

TwinOption = Annotated[bool, typer.Option("--twin", help="Work on the twin, in virtual time.")]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="With --twin: its configuration.")]
RunOption = Annotated[Path | None, typer.Option("--run", help="Run folder of the hold.")]
SocketOption = Annotated[Path | None, typer.Option("--socket", help="Control port of the hold.")]
LogsOption = Annotated[Path, typer.Option("--logs", help="Sessions are in LOGS/tuning.")]
SessionOption = Annotated[Path | None, typer.Option("--session", help="Continue this session.")]
NameOption = Annotated[str, typer.Option("--name", help="Name of a new session.")]
AuthorOption = Annotated[str | None, typer.Option("--author", help="Name of who tunes; your login by default.")]
ReasonOption = Annotated[str, typer.Option("--reason", help="Reason, for the gains file and the journal.")]
LimitOption = Annotated[
    float, typer.Option(min=3, max=30, help="Largest excursion of the centre in an experiment, um.")
]
ObserveOption = Annotated[str, typer.Option(help="Duration of the quiet hold, 5m to 15m.")]
VerifyOption = Annotated[str, typer.Option(help="Duration of the verification.")]
TakeOverOption = Annotated[bool, typer.Option("--take-over", help="Take the command from whoever has it.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]

_STEPS = {
    "characterise": "Excite the loop with relay and doublets about the mean flow; begins a session.",
    "identify": "Identify gain, dead time and lag with their errors; judge whether the data carry a proposal.",
    "observe": "Observe a quiet hold: laser noise and weather.",
    "design": "Compare candidates side by side and propose gains.",
    "preview": "Preview present and proposed gains on the fitted twin.",
    "apply": "Apply the proposed gains on trial: without `verify` they revert.",
    "verify": "Verify the new gains in ten minutes of hold: keep them, or revert (exit 3).",
    "run": "Run all steps that are not done yet.",
    "pump": "Map the pump (start, stall, gain, leak); later steps of the session use it.",
    "outer": "Measure sag sensitivity, noise and drift of the figure; propose the shape loop's time constant.",
    "watch": "Watch a hold without touching it; say whether a session is due (exit 3).",
    "rollback": "Roll back to the gains before the last ones kept.",
}


def _step(name: str) -> None:
    """Make the command of a step: all take the same options."""

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
        json: JsonOption = False,
    ) -> int:
        from membrane_ctrl.control_port.ctl import Where
        from membrane_ctrl.control_port.sockets import SOCKET_NAME
        from tuning import command as tune

        if socket is None and run is None:
            socket = logs / SOCKET_NAME
        options = tune.TuneOptions(
            config=Config() if config is None else load(config, Config),
            twin=twin,
            where=Where(socket=socket, run=run),
            logs=logs,
            session=session,
            name=session_name,
            author=author or tune.author_name(),
            reason=reason,
            limit_um=limit_um,
            observe_s=parse_duration_s(observe),
            verify_s=parse_duration_s(verify),
            take_over=take_over,
            json=json,
        )
        return _run(name, options)

    app.command(name=name, help=_STEPS[name])(command)


def _run(name: str, options: TuneOptions) -> int:
    from tuning import command as tune

    whole = {
        "run": tune.run_session,
        "pump": tune.map_pump,
        "outer": tune.outer,
        "watch": tune.watch,
        "rollback": tune.rollback,
    }
    return whole[name](options) if name in whole else tune.one_step(name, options)


for _name in _STEPS:
    _step(_name)


@app.command()
def history(logs: LogsOption = Path("logs"), json: JsonOption = False) -> int:
    """List which gains were kept, reverted or rolled back, when, by whom and why."""
    import json as json_module

    from membrane_ctrl.sessions.folder import plain
    from tuning.gains_file import entries, history_table

    found = entries(logs)
    print(json_module.dumps(plain(found)) if json else history_table(found))
    return 0


@app.command()
def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="Session folder.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Session folder.")],
) -> int:
    """Compare two sessions: each one's gains on each one's plant and weather."""
    from membrane_ctrl.sessions.folder import open_session

    print(compared(open_session(a), open_session(b)))
    return 0


# Two sessions side by side: each one's gains on each one's plant and weather.

_WEATHER_KEYS = ("barometer_gain_um_per_pa", "temperature_gain_um_per_k")


def compared(a: SessionFolder, b: SessionFolder) -> str:
    """Markdown: the plants, the gains, and what each gains would do on each plant.

    Raises InputError if one of the sessions has no design yet.
    """
    for session in (a, b):
        session.require("design")
    files = [load_gains(session.file("gains.toml")) for session in (a, b)]
    return "\n".join([*_plants(a, b, files), "", *_gains(files), "", *_crossed(a, b, files)])


def _plants(a: SessionFolder, b: SessionFolder, files: list[GainsFile]) -> list[str]:
    head = "| plant | k | +- | dead time s | lag s | delay +- s | leak um/s | laser um | least std um |"
    lines = [head, "|---" + "|---:" * 8 + "|"]
    for session, gains in zip((a, b), files, strict=True):
        plant = gains.plant
        lines.append(
            f"| {session.path.name} | {plant.gain:.3f} | {plant.gain_sigma:.3f} | {plant.dead_time_s:.3f} "
            f"| {plant.lag_s:.3f} | {plant.delay_sigma_s:.3f} | {plant.leak_um_per_s:.2f} "
            f"| {disturbance_of(session).laser_um:.2f} | {gains.least_std_um:.3f} |"
        )
    return lines


def _gains(files: list[GainsFile]) -> list[str]:
    """The loop settings that differ."""
    left, right = (gains.loop.model_dump() for gains in files)
    lines = ["| setting | A | B |", "|---|---:|---:|"]
    lines += [f"| {name} | {left[name]} | {right[name]} |" for name in left if left[name] != right[name]]
    return lines


def _crossed(a: SessionFolder, b: SessionFolder, files: list[GainsFile]) -> list[str]:
    head = "| gains of | on plant and weather of | std um | / least | Ms | load peak um |"
    lines = [head, "|---|---" + "|---:" * 4 + "|"]
    for place, session in (("A", a), ("B", b)):
        found, weather = found_of(session), disturbance_of(session)
        own = files[0 if place == "A" else 1].loop
        for name, gains in zip("AB", files, strict=True):
            # the weather's gains belong to the bench, not to the design
            loop = LoopConfig.model_validate(
                gains.loop.model_dump() | {key: getattr(own, key) for key in _WEATHER_KEYS}
            )
            row = design.candidate(name, Gains.of(loop), found.identified.model, weather, loop, candidates.Demands())
            std = f"{row.predicted.std_um:.3f} | {row.ratio:.2f}" if row.predicted is not None else "unstable | "
            lines.append(f"| {name} | {place} | {std} | {row.margins.ms:.2f} | {row.load_peak_um:.2f} |")
    return lines
