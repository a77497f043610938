"""The commands that look at devices, hold a mirror with them, or talk to a hold."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from membrane_ctrl.cli.completion import complete_scenario
from membrane_ctrl.cli.ctl import ctl_app
from membrane_ctrl.cli.options import ConfigArgument, ConfigOption, JsonOption, load_configuration
from membrane_ctrl.model import durations, errors, terminal

if TYPE_CHECKING:
    from membrane_ctrl.config.schema import Config

twin_app = typer.Typer(invoke_without_command=True, rich_markup_mode="markdown")
devices_app = typer.Typer(invoke_without_command=True, rich_markup_mode="markdown")
locks_app = typer.Typer(invoke_without_command=True, rich_markup_mode="markdown")
alarm_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode="markdown", help="Test the alarm messages."
)

FlatOption = Annotated[
    bool,
    typer.Option(
        "--from-flat", help="Start with a flat simulated mirror; filling it takes two hours."
    ),
]


def add_commands(app: typer.Typer) -> None:
    """Add `hold`, `twin`, `safe`, `check`, `commission`, `devices`, `conformance`, `ctl`, `alarm`,
    `locks`.
    """
    for command in (hold, safe, check, commission, conformance):
        app.command()(command)
    app.add_typer(devices_app, name="devices")
    app.add_typer(twin_app, name="twin")
    app.add_typer(ctl_app, name="ctl")
    app.add_typer(alarm_app, name="alarm")
    app.add_typer(locks_app, name="locks")


def hold(
    config: ConfigOption = None,
    twin: Annotated[
        bool, typer.Option("--twin", help="Hold the simulated bench instead of devices.")
    ] = False,
    devices: Annotated[
        Path | None,
        typer.Option(
            help="With --twin: emulate the [devices] of this configuration, each with its own "
            "protocol."
        ),
    ] = None,
    duration: Annotated[
        str | None, typer.Option(help="Stop after this long, e.g. 90s, 3m, 2h30m.")
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the run folder.")] = "hold",
    logs: Annotated[
        Path | None, typer.Option(help="Folder of the runs; recording.logs_dir by default.")
    ] = None,
    clear_faults: Annotated[
        bool,
        typer.Option(
            "--clear-faults",
            help="Clear faults latched by the board or an earlier run. Find their cause first.",
        ),
    ] = False,
    standby: Annotated[
        bool, typer.Option("--standby", help="Start in standby and wait for `ctl hold`.")
    ] = False,
    from_flat: FlatOption = False,
    autotune: Annotated[
        bool,
        typer.Option(
            "--autotune",
            help="Tune the loop on trial once the mirror is held: ten minutes; where the pump's "
            "curve must be measured first, 25 to 45. The run's autotune.log states which.",
        ),
    ] = False,
    observe: Annotated[
        bool,
        typer.Option(
            "--observe",
            help="Read, estimate, measure and record; never command pump or vent. For the first "
            "day on real hardware, or beside another controller.",
        ),
    ] = False,
    service: Annotated[
        bool,
        typer.Option(
            envvar="MEMBRANE_CTRL_SERVICE",
            help="Start a service with the page, unless one follows these runs.",
        ),
    ] = True,
    json: JsonOption = False,
) -> int:
    """Hold the mirror until stopped."""
    # Everything that can be refused is refused before the control program is loaded, which takes
    # seconds.
    settings = _start_from_flat(_with_devices(config, devices, twin), from_flat)
    if observe:
        settings = _make_observing(settings)
    if settings.states.observe and (autotune or clear_faults):
        raise errors.InputError(
            "a hold that observes writes nothing: start it without --autotune and --clear-faults"
        )
    duration_s = None
    if duration is not None:
        duration_s = durations.parse_duration_s(duration)
    terminal.print_progress("loading the control program")
    from membrane_ctrl.hold.hold_options import HoldOptions
    from membrane_ctrl.hold.start import hold_mirror

    options = HoldOptions(
        config=settings,
        source=str(config or devices or "the defaults"),
        twin=twin,
        duration_s=duration_s,
        name=name,
        logs_dir=logs,
        clear_faults=clear_faults,
        json=json,
        standby=standby or settings.states.observe,
        autotune=autotune,
        lab=devices is not None,
        configuration=devices or config,
        service=service,
    )
    with errors.name_source_in_errors(devices or config):
        return hold_mirror(options)


def _make_observing(settings: "Config") -> "Config":
    """The configuration of a hold that commands nothing."""
    states = settings.states.model_copy(update={"observe": True})
    return settings.model_copy(update={"states": states})


@twin_app.callback()
def twin(
    context: typer.Context,
    config: ConfigOption = None,
    speed: Annotated[
        float, typer.Option(min=0.01, max=1000.0, help="Simulated seconds per second.")
    ] = 1.0,
    from_flat: FlatOption = False,
) -> int:
    """Serve the simulated bench over Modbus TCP, for any client, until interrupted; or `play` a
    scenario on it.
    """
    if context.invoked_subcommand is not None:
        return errors.Exit.DONE
    from membrane_ctrl.sim.twin_command import serve_twin

    return serve_twin(_start_from_flat(load_configuration(config), from_flat), speed)


@twin_app.command()
def play(
    scenario: Annotated[
        str | None,
        typer.Argument(
            metavar="SCENARIO",
            help="Name or file; without it, the names are listed.",
            autocompletion=complete_scenario,
        ),
    ] = None,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Play in real time, with the console.")
    ] = False,
    name: Annotated[
        str | None, typer.Option(help="Name of the run folder; that of the scenario by default.")
    ] = None,
    logs: Annotated[Path, typer.Option(help="Folder of the runs.")] = Path("logs"),
) -> int:
    """Play a scenario with its faults on the simulated bench, and record it as a run."""
    if scenario is None:
        from membrane_ctrl.hold.scenarios import list_scenarios

        return list_scenarios()
    terminal.print_progress("loading the simulated bench")
    from membrane_ctrl.hold.play import play_scenario

    return play_scenario(scenario, logs, name, real_time)


def safe(
    config: ConfigArgument,
    logs: Annotated[
        Path | None, typer.Option(help="Folder of the runs; recording.logs_dir by default.")
    ] = None,
    latch: Annotated[
        bool,
        typer.Option(
            help="Lock the devices until a person unlocks them; --no-latch spares a running "
            "program."
        ),
    ] = True,
) -> int:
    """Stop a configuration's pump, whichever program controls it; leave the vent as it is."""
    from membrane_ctrl.commissioning.safe import make_safe

    with errors.name_source_in_errors(config):
        return make_safe(load_configuration(config), str(config), logs, latch)


def check(config: ConfigArgument, json: JsonOption = False) -> int:
    """Validate a configuration, probe its devices, and show what a hold would do."""
    loaded = load_configuration(config)  # first: a mistake shows at once
    from membrane_ctrl.commissioning.check import check_config

    with errors.name_source_in_errors(config):
        return check_config(loaded, str(config), json)


def commission(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Folder of the session; an existing one is resumed."),
    ] = Path("commissioning"),
    twin: Annotated[
        bool, typer.Option("--twin", help="Practise on the emulated bench, in virtual time.")
    ] = False,
    messages: Annotated[bool, typer.Option("--messages", hidden=True)] = False,
    named_by_input: Annotated[bool, typer.Option("--named-by-input", hidden=True)] = False,
) -> int:
    """Take a bench from a box of parts to an accepted hold, step by step; leave a configuration and
    a report.
    """
    from membrane_ctrl.commissioning.guide.command import commission_bench, commission_named

    if named_by_input:
        return commission_named(folder)
    if not twin:
        return commission_bench(folder, as_messages=messages)
    from membrane_ctrl.hold.virtual_hold import VirtualHold

    return commission_bench(folder, VirtualHold, messages)


@devices_app.callback()
def devices(context: typer.Context, json: JsonOption = False) -> int:
    """List serial ports, cameras, displays and installed drivers, with the text to paste into a
    configuration.
    """
    if context.invoked_subcommand is not None:
        return errors.Exit.DONE
    from membrane_ctrl.commissioning.devices import list_devices

    return list_devices(json)


@devices_app.command()
def new(
    name: Annotated[
        str,
        typer.Argument(help="Name of the driver, such as acme_gauge: small letters, digits, _."),
    ],
    role: Annotated[str, typer.Option(help="Role that the instrument fills.")] = "gauge_pressure",
    to: Annotated[Path, typer.Option(help="Folder in which NAME-driver is made.")] = Path(),
) -> int:
    """Write a driver for an instrument of your own, with its emulator and tests, as a package to
    install.
    """
    from membrane_ctrl.commissioning.new_driver import write_package

    return write_package(name, role, to)


def conformance(
    url: Annotated[
        str,
        typer.Argument(
            metavar="URL", help="Pump board: tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200."
        ),
    ],
    unit_id: Annotated[int, typer.Option(min=1, max=247, help="Modbus unit identifier.")] = 1,
    json: JsonOption = False,
) -> int:
    """Test a pump board against its specification. The pump runs at a few per cent: vent the mirror
    first.
    """
    from membrane_ctrl.commissioning.check import run_conformance

    return run_conformance(url, unit_id, json)


@locks_app.callback()
def locks(context: typer.Context, json: JsonOption = False) -> int:
    """List the locks on this machine's devices; with `remove`, remove one while no hold runs."""
    if context.invoked_subcommand is not None:
        return errors.Exit.DONE
    from membrane_ctrl.commissioning.locks import list_locks

    return list_locks(json)


@locks_app.command()
def remove(
    word: Annotated[
        str,
        typer.Argument(
            metavar="WORD", help="The lock's word, as displayed; without it, your own lock."
        ),
    ] = "",
) -> int:
    """Remove your lock, or another person's by typing its word. While a hold runs, use `ctl
    unlock`.
    """
    from membrane_ctrl.commissioning.locks import remove_lock

    return remove_lock(word)


@alarm_app.command("test")
def alarm_test(
    config: ConfigOption = None,
    escalated: Annotated[
        bool, typer.Option("--escalated", help="Include the escalation addresses.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Send a test message to every address of the alarms."""
    from membrane_ctrl.alarms.addresses import send_test_alarm

    return send_test_alarm(
        load_configuration(config), str(config or "the defaults"), escalated, json
    )


def _with_devices(config: Path | None, devices: Path | None, twin: bool) -> "Config":
    """Return the configuration with the [devices] of the `--devices` file; that file alone is the
    configuration if there is no other.
    """
    if devices is None:
        return load_configuration(config)
    lab = load_configuration(devices)
    if not twin:
        raise errors.InputError("--devices needs --twin; otherwise --config names the devices")
    if lab.devices is None:
        raise errors.InputError(f"{devices}: devices: missing; nothing to emulate")
    if config is None:
        return lab
    return load_configuration(config).model_copy(update={"devices": lab.devices})


def _start_from_flat(config: "Config", from_flat: bool) -> "Config":
    if not from_flat:
        return config
    return config.model_copy(update={"twin": config.twin.model_copy(update={"from_flat": True})})
