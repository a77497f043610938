"""The commands that work on capture sets."""

from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl.cli.completion import complete_run
from membrane_ctrl.cli.options import (
    ConfigOption,
    JsonOption,
    SeedOption,
    SetArgument,
    TrialsOption,
    load_configuration,
)

StatedOption = Annotated[
    Path | None,
    typer.Option(help="Geometry to state in the set; the true one is the configuration's."),
]
FaultOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Fault to add, kind:frame or kind:frame:amount, e.g. stale:x_sin_2; repeatable."
    ),
]
CoarserOption = Annotated[
    list[float] | None,
    typer.Option(help="Also fringes of this longer period, instead of Gray codes; repeatable."),
]
ArtefactOption = Annotated[
    str,
    typer.Option(
        metavar="FORM",
        help="Show flat:RADIUS or sphere:CURVATURE_RADIUS:RADIUS in its place, or screen:DISTANCE "
        "itself, mm.",
    ),
]
ScreenMovedOption = Annotated[
    float, typer.Option(help="Put the screen this much nearer to the mirror, mm.")
]
TurnedOption = Annotated[
    float | None,
    typer.Option(help="Turn the mirror about its axis by this, counter-clockwise, degrees."),
]


def add_commands(app: typer.Typer) -> None:
    """Add `measure`, `track`, `modes`, `export-figure`, `film`, `uncertainty`, `paper`,
    `stability`, `simulate`.
    """
    app.command()(measure)
    app.command()(track)
    app.command()(modes)
    app.command()(climate)
    app.command()(export_figure)
    app.command()(film)
    app.command()(uncertainty)
    app.command()(paper)
    app.command()(stability)
    app.command()(simulate)


def measure(
    capture_set: SetArgument,
    geometry: Annotated[
        Path | None, typer.Option(help="Geometry to use instead of the set's own.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder; SET/result by default.")] = None,
    pictures: Annotated[bool, typer.Option(help="Draw pictures next to the result.")] = True,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Write measurement.rrd next to the result.")
    ] = False,
    nominal_radius_mm: Annotated[
        float | None,
        typer.Option(
            help="Nominal radius of curvature, mm; without it no deviation of the power is stated."
        ),
    ] = None,
    report: Annotated[
        bool, typer.Option("--report", help="Write report.html and report.pdf.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Measure one capture set: height, Zernike coefficients, quality."""
    from membrane_ctrl.measure.measure import MeasureOptions, measure_command

    return measure_command(
        MeasureOptions(capture_set, geometry, out, json, pictures, rerun, nominal_radius_mm, report)
    )


def track(
    capture_set: SetArgument,
    geometry: Annotated[
        Path | None, typer.Option(help="Geometry to use instead of the reference's own.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder; SET/result by default.")] = None,
    pictures: Annotated[
        bool, typer.Option(help="Draw track.png and write track.rrd next to the result.")
    ] = True,
    json: JsonOption = False,
) -> int:
    """Track the figure through the frames of one crossed pattern: a figure for every frame."""
    from membrane_ctrl.measure.track import track_command

    return track_command(capture_set, geometry, out, json, pictures)


def modes(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="SET...|RUN...", help="Tracked sets, or runs that tracked."),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Output folder; modes, in the last one, by default.")
    ] = None,
    pictures: Annotated[
        bool, typer.Option(help="Draw modes.png and write modes.rrd next to the result.")
    ] = True,
    json: JsonOption = False,
) -> int:
    """Find the mirror's vibrations in tracked figures: frequency, amplitude and shape; whether one
    moves.
    """
    from membrane_ctrl.review.statistics.modes_run import modes_command

    return modes_command(folders, out, json, pictures)


def climate(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN",
            help="A run of a night with figures: its folder, name, or `last`.",
            autocompletion=complete_run,
        ),
    ],
    json: JsonOption = False,
) -> int:
    """Learn how temperature and humidity strain film and ring, from the figures of a night."""
    from membrane_ctrl.review.statistics.climate_run import climate_command

    return climate_command(run, json)


def export_figure(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder of `measure`.")],
    form: Annotated[
        str, typer.Option("--format", help="zygo-dat, zygo-xyz, codev-int, h5 or fits.")
    ],
    remove: Annotated[
        str,
        typer.Option(
            metavar="LIST", help="Take off piston, tilt, power, sphere; separated by commas."
        ),
    ] = "",
    zernike: Annotated[
        str, typer.Option(help="Also write the terms of this set: noll, osa or fringe.")
    ] = "",
    out: Annotated[
        Path | None, typer.Option(help="File to write; RESULT/figure.* by default.")
    ] = None,
) -> int:
    """Write a measured height map in the format of another program."""
    from membrane_ctrl.measure.export_figure import export_command

    return export_command(result, form, remove, zernike, out)


def film(
    folders: Annotated[
        list[Path],
        typer.Argument(
            metavar="SET...|RUN...", help="Capture sets at different pressures, or runs."
        ),
    ],
    geometry: Annotated[
        Path | None, typer.Option(help="Geometry to use instead of the sets' own.")
    ] = None,
    prestrain: Annotated[
        float, typer.Option(help="RUN: pre-strain of the film, 1e-3 is 0.1 %.")
    ] = 0.0,
    poisson: Annotated[
        float, typer.Option(min=0.0, max=0.5, help="RUN: its Poisson ratio.")
    ] = 0.35,
    gauge_offset_pa: Annotated[
        float, typer.Option(min=0.0, help="Standard uncertainty of the gauge's zero, Pa.")
    ] = 1.0,
    gauge_scale: Annotated[
        float, typer.Option(min=0.0, help="Standard uncertainty of its scale, relative.")
    ] = 1e-3,
    gauge_noise_pa: Annotated[
        float, typer.Option(min=0.01, help="Noise of a set's mean reading, Pa.")
    ] = 0.3,
    out: Annotated[
        Path | None, typer.Option(help="Output folder; film, beside the first set, by default.")
    ] = None,
    pictures: Annotated[bool, typer.Option(help="Draw film.png next to the result.")] = True,
    json: JsonOption = False,
) -> int:
    """Determine the film's pre-strain, Poisson ratio and stiffness from sets; from runs,
    its creep.
    """
    from membrane_ctrl.run_files.run_lookup import is_run

    if all(is_run(folder) for folder in folders):
        from membrane_ctrl.review.statistics.film_run import film_run_command

        return film_run_command(folders, prestrain, poisson, out, pictures, json)
    from membrane_ctrl.measure.film import FilmOptions, film_command
    from membrane_ctrl.metrology.film.material_fit import Gauge

    gauge = Gauge(gauge_noise_pa, gauge_offset_pa, gauge_scale)
    return film_command(FilmOptions(tuple(folders), geometry, gauge, out, json, pictures))


def uncertainty(
    capture_set: SetArgument,
    against: Annotated[
        Path | None,
        typer.Option(
            metavar="SET", help="Estimate the change since this set instead of the height."
        ),
    ] = None,
    trials: TrialsOption = 100,
    seed: SeedOption = 1,
    geometry: Annotated[
        Path | None,
        typer.Option(help="Geometry to use instead of the set's own, with its covariance."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Worker processes; by default according to the number of trials."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Run on this Dask scheduler, e.g. tcp://host:8786."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder; SET/uncertainty by default.")
    ] = None,
    json: JsonOption = False,
) -> int:
    """Estimate the RMSE of the height, or of the change between two sets, by Monte Carlo."""
    from membrane_ctrl.measure.uncertainty import UncertaintyOptions, uncertainty_command

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


def paper(
    out: Annotated[Path, typer.Option(help="Folder of the document.")] = Path("paper"),
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer pixels, sets and trials: for a first look.")
    ] = False,
    full_size: Annotated[
        bool, typer.Option("--full-size", help="All pixels of the paper's camera, not a quarter.")
    ] = False,
    sets: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN_OF_SETS", help="Recorded sets, the first a full one, instead of simulated."
        ),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="PART", help="Compute this part only; repeatable.")
    ] = None,
    seed: SeedOption = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Run trials on this Dask scheduler."),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Compute each figure and table of the paper again, and write them beside the paper's.

    What is finished is kept in OUT/parts: the same command continues where an earlier one ended.
    """
    import shlex
    from dataclasses import replace

    from membrane_ctrl.model.errors import InputError
    from membrane_ctrl.paper.bench import PaperOptions
    from membrane_ctrl.paper.paper_command import QUICK, PaperCommand, paper_command

    if quick and full_size:
        raise InputError("--quick, --full-size: give one of them")
    if quick:
        options = QUICK
    elif full_size:
        options = PaperOptions(shrink=1)
    else:
        options = PaperOptions(shrink=2)
    options = replace(options, seed=seed, scheduler=scheduler)
    # The document states the command that makes it again.
    arguments = ""
    if quick:
        arguments += " --quick"
    if full_size:
        arguments += " --full-size"
    if sets is not None:
        arguments += f" --sets {shlex.quote(str(sets))}"
    if seed != 1:
        arguments += f" --seed {seed}"
    return paper_command(PaperCommand(out, options, sets, tuple(only or ()), json, arguments))


def stability(
    run_of_sets: Annotated[
        Path, typer.Argument(metavar="RUN_OF_SETS", help="Folder of capture sets.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Output folder; RUN_OF_SETS/stability by default.")
    ] = None,
    point: Annotated[
        list[str] | None,
        typer.Option(help="Point to follow instead of A, B and C, as NAME=X,Y in mm; repeatable."),
    ] = None,
    geometry: Annotated[
        Path | None,
        typer.Option(help="Geometry to use instead of the sets' own, with its covariance."),
    ] = None,
    trials: Annotated[int, typer.Option(min=2, help="Monte Carlo trials per set.")] = 100,
    seed: SeedOption = 1,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Write stability.rrd next to the result.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Evaluate the stability of a run of sets: standard deviation, points over time, pairs and
    their uncertainty.
    """
    from membrane_ctrl.measure.stability import StabilityOptions, stability_command

    options = StabilityOptions(
        run_of_sets, out, tuple(point or ()), geometry, trials, seed, json, rerun
    )
    return stability_command(options)


def simulate(
    set_dir: Annotated[
        Path, typer.Argument(metavar="SET_DIR", help="New folder for the set, or for the run.")
    ],
    config: ConfigOption = None,
    sag_mm: Annotated[float, typer.Option(help="Depth of the bowl, mm.")] = 37.1,
    figure: Annotated[
        bool, typer.Option(help="Add the aberrations of a mounted film, e.g. astigmatism.")
    ] = True,
    steps: Annotated[
        int | None,
        typer.Option(
            min=3, max=64, help="Phase steps of each axis; by default the configuration's."
        ),
    ] = None,
    bits: Annotated[
        int | None,
        typer.Option(min=8, max=16, help="Bits per pixel; by default the configuration's."),
    ] = None,
    noise_adu: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Standard deviation of each pixel, counts; by default the configuration's.",
        ),
    ] = None,
    shrink: Annotated[
        int, typer.Option(min=1, max=16, help="Use larger and fewer pixels, by this factor.")
    ] = 1,
    gamma: Annotated[float, typer.Option(help="Gamma of the display.")] = 1.0,
    motion_um: Annotated[float, typer.Option(help="Amplitude of the film's motion, µm.")] = 0.0,
    motion_hz: Annotated[float, typer.Option(help="Frequency of the motion, Hz.")] = 0.3,
    drift_um_per_s: Annotated[float, typer.Option(help="Drift of the film, µm/s.")] = 0.0,
    displacement_um: Annotated[
        float, typer.Option(help="Initial displacement from that depth, µm.")
    ] = 0.0,
    laser_noise_um: Annotated[
        float, typer.Option(min=0.0, help="Standard deviation of the laser readings, µm.")
    ] = 0.0,
    stated: StatedOption = None,
    exact: Annotated[
        bool, typer.Option("--exact", help="Trace every pixel exactly (slow).")
    ] = False,
    seed: SeedOption = 1,
    fault: FaultOption = None,
    sets: Annotated[
        int,
        typer.Option(
            min=1, help="Number of sets; several make a run: 0000 full, the others fringes."
        ),
    ] = 1,
    interval_s: Annotated[
        float, typer.Option(min=0.0, help="Interval between the sets of a run, s.")
    ] = 4.0,
    coarser_mm: CoarserOption = None,
    artefact: ArtefactOption = "",
    screen_moved_mm: ScreenMovedOption = 0.0,
    turned_deg: TurnedOption = None,
    front_film: Annotated[
        bool, typer.Option("--front-film", help="Add the paper's clear film in front.")
    ] = False,
    unstated_front_film: Annotated[
        bool,
        typer.Option("--unstated-front-film", help="The same, but the set does not mention it."),
    ] = False,
    track: Annotated[
        int,
        typer.Option(
            min=0, help="Frames of a tracking set, in SET_DIR/track; its reference is SET_DIR/full."
        ),
    ] = 0,
    rate_hz: Annotated[
        float, typer.Option(min=0.01, help="Frames of a tracking set per second.")
    ] = 20.0,
) -> int:
    """Simulate a capture set, or a run of sets, with known truth."""
    from membrane_ctrl.measure.simulate import SimulateOptions, simulate_command
    from membrane_ctrl.sim.optics.simulation_spec import Motion

    options = SimulateOptions(
        folder=set_dir,
        config=load_configuration(config),
        sag_mm=sag_mm,
        figure=figure,
        steps=steps,
        bits=bits,
        noise_adu=noise_adu,
        shrink=shrink,
        gamma=gamma,
        motion=Motion(displacement_um, drift_um_per_s, motion_um, motion_hz),
        laser_noise_um=laser_noise_um,
        stated=stated,
        exact=exact,
        seed=seed,
        faults=tuple(fault or ()),
        sets=sets,
        interval_s=interval_s,
        coarser_mm=tuple(coarser_mm or ()),
        artefact=artefact,
        screen_moved_mm=screen_moved_mm,
        turned_deg=turned_deg,
        front_film=front_film,
        unstated_front_film=unstated_front_film,
        track=track,
        rate_hz=rate_hz,
    )
    return simulate_command(options)
