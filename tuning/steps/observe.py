"""Third step of a session: observe a quiet hold, for the laser's noise and the weather."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import welch

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.model import errors
from membrane_ctrl.report_pages.blocks import PageSection, PageText
from membrane_ctrl.sessions import folder, session_json
from tuning.identification import plant_model, record_file
from tuning.identification.disturbance import DisturbanceModel, observe_disturbance
from tuning.identification.record import Record, Series
from tuning.report.pictures import (
    SPECTRUM_SEGMENT_S,
    embed_picture,
    is_outdated,
    save_figure,
)
from tuning.rigs.hold_rig import HoldRig
from tuning.steps.characterise import HELD_RECORD
from tuning.steps.identify import load_identified

OBSERVE_S = 600.0
_PICTURE = "weather.png"


def run_observe(
    session: folder.SessionFolder, rig: HoldRig, duration_s: float = OBSERVE_S
) -> DisturbanceModel:
    """Observe a quiet hold for laser noise and weather, in a short session the one before its
    experiments.

    Parameters
    ----------
    session : SessionFolder
        With an identified plant.
    rig : HoldRig
        Holds the mirror.
    duration_s : float
        Of the hold, unless it was recorded before the experiments.

    Raises
    ------
    RejectedError
        If the record does not show them.
    """
    model = load_identified(session).identified.model
    session.begin_step("observe")
    held = session.file_path(HELD_RECORD)
    record = record_file.load_record(held) if held.exists() else rig.hold(duration_s)
    try:
        disturbance = observe_disturbance(record, model, rig.loop)
    except ValueError as error:
        raise errors.RejectedError(f"observe: {error}") from None
    record_file.save_record(session.file_path("quiet.npz"), record)
    session_json.write_session_file(session.file_path("disturbance.json"), disturbance)
    return disturbance


def load_disturbance(session: folder.SessionFolder) -> DisturbanceModel:
    """The observed disturbance."""
    return session.read_result("observe", "disturbance.json", DisturbanceModel)


def load_quiet_record(session: folder.SessionFolder) -> Record:
    """The record of the quiet hold."""
    return record_file.load_record(session.file_path("quiet.npz"))


def describe_result(session: folder.SessionFolder) -> str:
    """Noise and weather in one line."""
    weather = load_disturbance(session)
    sensor = "figure" if session.config.by_optics else "laser"
    return (
        f"{sensor} noise {weather.laser_um:.2f} µm per reading; in weather like this the std of "
        f"ten minutes scatters by {weather.unsteady:.0%}"
    )


def make_report_part(session: folder.SessionFolder) -> PageSection | None:
    """The weather, for the report; None before the step is done."""
    if not session.is_done("observe"):
        return None
    weather = load_disturbance(session)
    text = (
        f"Noise of a reading {weather.laser_um:.3f} µm. Every predicted std rests on this record: "
        f"ten other minutes of weather like it change it by {weather.unsteady:.0%} (1 sigma), and "
        "its fit has an error."
    )
    return PageSection("Weather", [PageText(text), *embed_picture(session, _PICTURE)])


def draw_picture(session: folder.SessionFolder) -> None:
    """Draw the spectrum of the quiet hold, unless it is up to date."""
    if session.is_done("observe") and is_outdated(session, _PICTURE, "identify", "observe"):
        model = load_identified(session).identified.model
        quiet = load_quiet_record(session)
        _draw_weather(session.file_path(_PICTURE), quiet, model, load_disturbance(session))


def _draw_weather(
    path: Path, record: Record, model: plant_model.PlantModel, weather: DisturbanceModel
) -> None:
    """Draw the spectrum of a quiet hold's readings less the pump's response,
    and the fitted parts.
    """
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    x = plant_model.compute_driven_um(
        record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s
    )
    rest = record.filled_displacement_um() - model.gain * x
    frequency_hz, power = welch(
        np.diff(rest), 1 / record.dt_s, nperseg=round(SPECTRUM_SEGMENT_S / record.dt_s)
    )
    w: Series = 2 * np.pi * frequency_hz[1:]
    back = 1 / np.abs(1 - np.exp(-1j * w * record.dt_s)) ** 2  # from increments to readings
    axes.loglog(
        frequency_hz[1:],
        power[1:] * back,
        linewidth=0.7,
        color="tab:gray",
        label="readings less pump",
    )
    blind = LoopConfig(feedforward_barometer=False, feedforward_temperature=False)
    # one-sided
    axes.loglog(frequency_hz[1:], 2 * weather.psd(w, model, blind), label="fitted motion")
    axes.loglog(
        frequency_hz[1:],
        2 * weather.rest.moving_psd(w),
        label="motion not explained by weather sensors",
    )
    axes.axhline(
        2 * weather.rest.white_psd, color="tab:red", linestyle="--", label="noise of a reading"
    )
    axes.set(xlabel="frequency (Hz)", ylabel="um^2/Hz", ylim=(1e-4 * weather.rest.white_psd, None))
    axes.legend(loc="best")
    save_figure(path, figure)
