"""Two tuning sessions side by side: the gains of each on the plant and weather of each."""

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.sessions.folder import SessionFolder
from tuning.gains_file import GainsFile, load_gains
from tuning.identification.loop_model import Gains
from tuning.proposal import candidates, design
from tuning.session import disturbance_of, found_of

_WEATHER_KEYS = ("barometer_gain_um_per_pa", "temperature_gain_um_per_k")


def compared(a: SessionFolder, b: SessionFolder) -> str:
    """Return Markdown: the plants, the gains, and the prediction for each set of gains on each plant.

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
    """Table of the loop settings that differ."""
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
            # the weather gains belong to the bench, not to the design
            loop = LoopConfig.model_validate(
                gains.loop.model_dump() | {key: getattr(own, key) for key in _WEATHER_KEYS}
            )
            row = design.candidate(name, Gains.of(loop), found.identified.model, weather, loop, candidates.Demands())
            std = f"{row.predicted.std_um:.3f} | {row.ratio:.2f}" if row.predicted is not None else "unstable | "
            lines.append(f"| {name} | {place} | {std} | {row.margins.ms:.2f} | {row.load_peak_um:.2f} |")
    return lines
