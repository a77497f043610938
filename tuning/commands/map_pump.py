"""`tune pump`: measure the pump's curve and apply it."""

from membrane_ctrl.control.leak_estimate import TOO_TIGHT_UM_PER_S
from membrane_ctrl.sessions.folder import SessionFolder
from membrane_ctrl.sessions.progress import Progress
from tuning import connection
from tuning.commands.conclusion import conclude
from tuning.identification import pump_survey
from tuning.identification.pump_map import PumpMap
from tuning.options import TuneOptions
from tuning.rigs.hold_rig import HoldRig
from tuning.sentences import TOO_TIGHT, describe_gains
from tuning.steps import map_pump
from tuning.steps.identify import describe_gaps


def run_map_pump(options: TuneOptions) -> int:
    """Measure the pump's curve and apply it; the session restarts on it."""
    with connection.open_on_hold(options) as (folder, rig, progress):
        folder = measure_pump(folder, rig, options.limit_um, progress)
    return conclude(folder, options)


def measure_pump(
    folder: SessionFolder, rig: HoldRig, limit_um: float, progress: Progress, after_s: float = 0.0
) -> SessionFolder:
    """Measure the curve, apply it and print it.

    Parameters
    ----------
    folder : SessionFolder
        It restarts on the measured curve.
    rig : HoldRig
        Holds the mirror.
    limit_um : float
        How far the mirror may move from its setpoint.
    progress : Progress
        Shows the step and its results.
    after_s : float
        What the session takes after it, to announce it.

    Returns
    -------
    SessionFolder
        The session, which restarts on the curve.
    """
    progress.begin_step("pump", pump_survey.TYPICAL_S, after_s, pump_survey.LONGEST_S)
    gaps_before = len(rig.gaps_s)
    held_before_s = rig.held_s
    mapped, folder = map_pump.map_pump(folder, rig, limit_um)
    progress.print_line(f"pump: {_describe_curve(mapped.found)}")
    progress.print_line(
        f"pump: steps of the flow on this curve give k {mapped.gain:.2f} +- "
        f"{mapped.gain_sigma:.2f}; curve and gains ({describe_gains(rig.loop)}) stay until the "
        f"hold ends; `membrane-ctrl tune save {folder.path} --config FILE` saves them for the "
        "next one"
    )
    held_s = rig.held_s - held_before_s
    lossy = describe_gaps(rig.gaps_s[gaps_before:], held_s, folder.config.by_optics)
    if lossy:
        progress.print_line(f"pump: {lossy}")
    if mapped.found.leak_um_per_s < TOO_TIGHT_UM_PER_S:
        progress.print_line(TOO_TIGHT)
    return folder


def _describe_curve(found: PumpMap) -> str:
    """The measured curve in one line."""
    pump = found.pump
    over = "" if found.known else " (the time is over)"
    hysteresis = ", with hysteresis" if pump.curve_falling_um_per_s else ""
    return (
        f"{len(pump.curve_fraction)} points from {pump.curve_um_per_s[0]:.2f} µm/s at "
        f"{pump.curve_fraction[0]:.3f} to {pump.flow_full_um_per_s:.2f} µm/s at "
        f"{pump.curve_fraction[-1]:.3f}, known to {max(found.sigma_um_per_s[1:]):.2f} µm/s{over}; "
        f"starts at {pump.start_fraction:.3f}, stalls at {pump.stall_fraction:.3f}{hysteresis}; "
        f"answers after {found.delay_s:.2f} s with a lag of {found.lag_s:.2f} s; leak "
        f"{found.leak_um_per_s:.2f} µm/s"
    )
