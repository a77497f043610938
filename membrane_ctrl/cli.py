"""The command line: one thin function a command; errors end in one line and an exit code (INTERFACES section 4)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl import __version__
from membrane_ctrl.config import Config
from membrane_ctrl.config_file import load
from membrane_ctrl.durations import parse_duration_s
from membrane_ctrl.errors import CommandError, Exit, InputError
from membrane_ctrl.review.cli import add_commands as add_review_commands
from membrane_ctrl.tune.cli import app as tune_app

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

FlatOption = Annotated[
    bool, typer.Option("--from-flat", help="The simulated mirror starts flat: a fill takes two hours.")
]
alarm_app = typer.Typer(no_args_is_help=True)
app.add_typer(alarm_app, name="alarm")
app.add_typer(tune_app, name="tune")

ConfigOption = Annotated[Path | None, typer.Option("--config", help="Configuration, one TOML file.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; every expected failure is one line on stderr."""
    try:
        result = app(list(arguments), prog_name="membrane-ctrl", standalone_mode=False)
    except CommandError as error:
        print(f"membrane-ctrl: {error}", file=sys.stderr)
        return error.exit
    except typer.TyperException as error:
        print(f"membrane-ctrl: {error.format_message()} (see --help)", file=sys.stderr)
        return Exit.BAD_INPUT
    except (KeyboardInterrupt, typer.Abort):
        print("membrane-ctrl: interrupted", file=sys.stderr)
        return Exit.INTERRUPTED
    return int(result or 0)


@app.callback(invoke_without_command=True)
def top(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    """Hold a pneumatic membrane mirror to the micrometre and measure its figure while it is held."""
    if version:
        print(__version__)
        raise typer.Exit


@app.command()
def hold(
    config: ConfigOption = None,
    twin: Annotated[bool, typer.Option("--twin", help="Hold the simulated bench instead of devices.")] = False,
    devices: Annotated[
        Path | None,
        typer.Option(help="With --twin: emulate the instruments of this configuration's [devices], in bytes."),
    ] = None,
    duration: Annotated[str | None, typer.Option(help="Stop after this long, e.g. 90s, 3m, 2h30m.")] = None,
    name: Annotated[str, typer.Option(help="Name of the run folder.")] = "hold",
    logs: Annotated[Path | None, typer.Option(help="Where run folders go.")] = None,
    clear_faults: Annotated[
        bool,
        typer.Option("--clear-faults", help="Clear what board or an earlier run has latched, once you know why."),
    ] = False,
    standby: Annotated[bool, typer.Option("--standby", help="Wait for `ctl hold`.")] = False,
    from_flat: FlatOption = False,
    json: JsonOption = False,
) -> int:
    """Hold the mirror until told to stop: the main job."""
    from membrane_ctrl.hold import HoldOptions, hold_mirror

    options = HoldOptions(
        config=_started(_with_devices(config, devices, twin), from_flat),
        source=str(config or devices or "the defaults"),
        twin=twin,
        duration_s=None if duration is None else parse_duration_s(duration),
        name=name,
        logs_dir=logs,
        clear_faults=clear_faults,
        json=json,
        standby=standby,
        lab=devices is not None,
    )
    return hold_mirror(options)


@app.command()
def twin(
    config: ConfigOption = None,
    speed: Annotated[float, typer.Option(min=0.01, max=1000.0, help="Simulated seconds a second.")] = 1.0,
    from_flat: FlatOption = False,
) -> int:
    """Serve the simulated bench on its real protocol, for any client, until interrupted."""
    from membrane_ctrl.serve_twin import serve_twin

    return serve_twin(_started(_config(config), from_flat), speed)


@app.command()
def check(
    config: Annotated[Path, typer.Argument(help="Configuration, one TOML file.", metavar="CONFIG")],
    json: JsonOption = False,
) -> int:
    """Validate a configuration, probe the devices it names, and say what would happen."""
    from membrane_ctrl.check import check_config

    return check_config(_config(config), str(config), json)


@app.command()
def safe(config: Annotated[Path, typer.Argument(help="Configuration, one TOML file.", metavar="CONFIG")]) -> int:
    """Stop the pump of the devices that a configuration names, whatever runs or ran; the vent stays as it is."""
    from membrane_ctrl.safe_state import make_safe

    return make_safe(_config(config), str(config))


@app.command()
def devices(json: JsonOption = False) -> int:
    """List serial ports, cameras and displays, with the text to paste into a configuration."""
    from membrane_ctrl.devices import list_devices

    return list_devices(json)


@app.command()
def conformance(
    url: Annotated[str, typer.Argument(help="The board: tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200.")],
    unit_id: Annotated[int, typer.Option(min=1, max=247, help="Modbus unit.")] = 1,
    json: JsonOption = False,
) -> int:
    """Test whether a board does what a pump board must do. The pump runs at a few per cent: vent the mirror first."""
    from membrane_ctrl.conformance import run_conformance

    return run_conformance(url, unit_id, json)


@app.command(context_settings={"ignore_unknown_options": True})  # a negative setpoint is no option
def ctl(
    action: Annotated[
        str,
        typer.Argument(
            metavar="ACTION",
            help="status, watch, setpoint UM, hold, pause, resume, manual FLOW, gains FILE, keep, shape on|off, "
            'mark "text", ack, lower, vent, stop, release, quiet.',
        ),
    ],
    argument: Annotated[str | None, typer.Argument(metavar="[VALUE]")] = None,
    why: Annotated[str, typer.Option(help="Recorded with the command.")] = "",
    take_over: Annotated[bool, typer.Option("--take-over", help="Take the command from who has it.")] = False,
    every: Annotated[str, typer.Option(help="watch: a line this often.")] = "1s",
    trial: Annotated[str, typer.Option(help="gains: back to the old ones after this, unless `keep` comes.")] = "",
    run: Annotated[Path | None, typer.Option(help="The run's folder.")] = None,
    socket: Annotated[Path | None, typer.Option(help="The hold's socket; logs/control.sock by default.")] = None,
    tls: Annotated[str, typer.Option(metavar="HOST:PORT", help="By TCP, with the certificate below.")] = "",
    certificate: Annotated[Path | None, typer.Option(help="With --tls: the own certificate.")] = None,
    key: Annotated[Path | None, typer.Option(help="With --tls: its key.")] = None,
    authority: Annotated[Path | None, typer.Option(help="With --tls: who signed the hold's certificate.")] = None,
    json: JsonOption = False,
) -> int:
    """Talk to a running hold: ask how it is, or tell it what to do."""
    from membrane_ctrl.ctl import CtlOptions, Where
    from membrane_ctrl.ctl import ctl as ask

    where = Where(socket, run, tls, certificate, key, authority)
    return ask(CtlOptions(action, argument, why, take_over, every, trial, json, where))


@alarm_app.callback()
def alarm() -> None:
    """Who is told when nobody looks."""


@alarm_app.command("test")
def alarm_test(
    config: ConfigOption = None,
    escalated: Annotated[bool, typer.Option("--escalated", help="Also to those of the escalation.")] = False,
    json: JsonOption = False,
) -> int:
    """Send a test notice to all whom an alarm would reach."""
    from membrane_ctrl.alarms.command import send_test_alarm

    return send_test_alarm(_config(config), str(config or "the defaults"), escalated, json)


@app.command()
def measure(
    capture_set: Annotated[Path, typer.Argument(metavar="SET", help="Folder with capture.toml and its images.")],
    geometry: Annotated[Path | None, typer.Option(help="Geometry to use instead of the set's own.")] = None,
    out: Annotated[Path | None, typer.Option(help="Where the result goes; SET/result by default.")] = None,
    pictures: Annotated[bool, typer.Option(help="Draw pictures beside the result.")] = True,
    rerun: Annotated[bool, typer.Option("--rerun", help="Write measurement.rrd beside the result.")] = False,
    json: JsonOption = False,
) -> int:
    """Measure one capture set: height, Zernike coefficients, quality."""
    from membrane_ctrl.measure import measure_command

    return measure_command(capture_set, geometry, out, json, pictures, rerun)


@app.command()
def uncertainty(
    capture_set: Annotated[Path, typer.Argument(metavar="SET", help="Folder with capture.toml and its images.")],
    against: Annotated[
        Path | None, typer.Option(metavar="SET", help="Of the change since this set, instead of the height.")
    ] = None,
    trials: Annotated[int, typer.Option(min=2, help="Monte Carlo trials.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of all that is random.")] = 1,
    geometry: Annotated[
        Path | None, typer.Option(help="Geometry to use instead of the set's own, with its covariance.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; by default as many as the trials are worth.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Run on this Dask scheduler, e.g. tcp://host:8786.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Where the result goes; SET/uncertainty by default.")] = None,
    json: JsonOption = False,
) -> int:
    """Monte Carlo over geometry and pixel noise: RMSE of the height, or of the change between two sets."""
    from membrane_ctrl.uncertainty_command import UncertaintyOptions, uncertainty_command

    options = UncertaintyOptions(
        folder=capture_set,
        against=against,
        geometry=geometry,
        trials=trials,
        seed=seed,
        workers=workers,
        scheduler=scheduler,
        out=out,
        as_json=json,
    )
    return uncertainty_command(options)


@app.command()
def stability(
    run_of_sets: Annotated[Path, typer.Argument(metavar="RUN_OF_SETS", help="Folder of capture sets.")],
    out: Annotated[Path | None, typer.Option(help="Where the result goes; RUN_OF_SETS/stability by default.")] = None,
    point: Annotated[
        list[str] | None, typer.Option(help="NAME=X,Y in mm: a point to follow, instead of A, B and C; repeatable.")
    ] = None,
    trials: Annotated[int, typer.Option(min=2, help="Monte Carlo trials, for every set.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of all that is random.")] = 1,
    json: JsonOption = False,
) -> int:
    """Stability of a run of sets: standard deviation, points in time, pairs with their uncertainty."""
    from membrane_ctrl.stability_command import StabilityOptions, stability_command

    options = StabilityOptions(run_of_sets, out, tuple(point or ()), trials, seed, json)
    return stability_command(options)


@app.command()
def simulate(
    set_dir: Annotated[Path, typer.Argument(metavar="SET_DIR", help="New folder for the set, or for the run.")],
    config: ConfigOption = None,
    sag_mm: Annotated[float, typer.Option(help="Depth of the bowl.")] = 37.1,
    figure: Annotated[bool, typer.Option(help="The astigmatism, coma and so on of a mounted film.")] = True,
    steps: Annotated[int | None, typer.Option(min=3, max=64, help="Phase steps.")] = None,
    bits: Annotated[int | None, typer.Option(min=8, max=16, help="Depth of the frames.")] = None,
    noise_adu: Annotated[float | None, typer.Option(min=0.0, help="Noise of a pixel.")] = None,
    shrink: Annotated[int, typer.Option(min=1, max=16, help="Larger pixels, fewer of them.")] = 1,
    gamma: Annotated[float, typer.Option(help="Of the display.")] = 1.0,
    motion_um: Annotated[float, typer.Option(help="Amplitude of the film's motion.")] = 0.0,
    motion_hz: Annotated[float, typer.Option(help="Its frequency.")] = 0.3,
    drift_um_per_s: Annotated[float, typer.Option(help="Drift of the film.")] = 0.0,
    laser_noise_um: Annotated[float, typer.Option(min=0.0, help="Noise of the laser's readings.")] = 0.0,
    exact: Annotated[bool, typer.Option("--exact", help="Trace every pixel: slow, true to the last bit.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of all that is random.")] = 1,
    fault: Annotated[
        list[str] | None, typer.Option(help="kind:frame[:amount], as stale:x_sin_2; repeatable.")
    ] = None,
    sets: Annotated[int, typer.Option(min=1, help="More than one: a run, 0000 full, the others fringes.")] = 1,
    interval_s: Annotated[float, typer.Option(min=0.0, help="From set to set of a run.")] = 4.0,
) -> int:
    """Write a capture set, or a run of sets, with its truth beside it."""
    from membrane_ctrl.simulate_command import SimulateOptions, simulate_command
    from membrane_ctrl.twin.simulation_spec import Motion

    options = SimulateOptions(
        folder=set_dir,
        config=_config(config),
        sag_mm=sag_mm,
        figure=figure,
        steps=steps,
        bits=bits,
        noise_adu=noise_adu,
        shrink=shrink,
        gamma=gamma,
        motion=Motion(drift_um_per_s=drift_um_per_s, amplitude_um=motion_um, frequency_hz=motion_hz),
        laser_noise_um=laser_noise_um,
        exact=exact,
        seed=seed,
        faults=tuple(fault or ()),
        sets=sets,
        interval_s=interval_s,
    )
    return simulate_command(options)


@app.command()
def replay(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    start: Annotated[
        str | None, typer.Option("--from", help="Compare from this time of the run on, e.g. 3m.")
    ] = None,
    end: Annotated[str | None, typer.Option("--to", help="End at this time of the run.")] = None,
    to_test: Annotated[str | None, typer.Option(help="Make a regression test of it, tests/incidents/NAME.")] = None,
    json: JsonOption = False,
) -> int:
    """Run a run's recorded inputs through today's control code and say what is not the same (exit 3)."""
    import math

    from membrane_ctrl.replay_command import replay_command

    from_s = 0.0 if start is None else parse_duration_s(start)
    to_s = math.inf if end is None else parse_duration_s(end)
    return replay_command(run_dir, from_s, to_s, to_test, json)


@app.command()
def repair(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    in_place: Annotated[
        bool, typer.Option("--in-place", help="Put what was repaired in place of the torn files.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Mend what a crash left of a run: torn segments, a torn event log, a missing summary."""
    from membrane_ctrl.repair import repair_command

    return repair_command(run_dir, in_place, json)


@app.command()
def calibrate(
    sets: Annotated[list[Path], typer.Argument(metavar="SET...", help="Capture sets at different pressures.")],
    out: Annotated[Path, typer.Option(help="The new geometry.")] = Path("geometry.toml"),
    geometry: Annotated[Path | None, typer.Option(help="Measured by hand, instead of the sets'.")] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[=SIGMA]", help="Also calibrate this, as bow_mm; sigma 0 holds it; repeatable."),
    ] = None,
    laser_sigma_um: Annotated[float, typer.Option(min=0.001, help="Of a set's mean reading.")] = 1.0,
    pictures: Annotated[bool, typer.Option(help="Draw the residuals beside the geometry.")] = True,
    json: JsonOption = False,
) -> int:
    """Calibrate the optics: one geometry with its covariance, from sets at several pressures."""
    from membrane_ctrl.calibrate_command import CalibrateOptions, calibrate_command

    options = CalibrateOptions(sets, geometry, out, tuple(free or ()), laser_sigma_um, json, pictures)
    return calibrate_command(options)


def _with_devices(config: Path | None, devices: Path | None, twin: bool) -> Config:
    """The configuration, its [devices] from the file of `--devices`; that file alone is a configuration, too."""
    if devices is None:
        return _config(config)
    lab = _config(devices)
    if not twin:
        raise InputError("--devices: only with --twin; without it --config names the devices")
    if lab.devices is None:
        raise InputError(f"{devices}: devices: missing; there is nothing to emulate")
    return lab if config is None else _config(config).model_copy(update={"devices": lab.devices})


def _started(config: Config, from_flat: bool) -> Config:
    if not from_flat:
        return config
    return config.model_copy(update={"twin": config.twin.model_copy(update={"from_flat": True})})


def _config(path: Path | None) -> Config:
    return Config() if path is None else load(path, Config)


add_review_commands(app)
