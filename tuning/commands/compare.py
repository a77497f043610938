"""`tune compare`: the gains of two sessions on the plant and weather of each."""

from membrane_ctrl.config import schema
from membrane_ctrl.sessions.folder import SessionFolder
from tuning import gains_file
from tuning.identification.closed_loop import Gains
from tuning.proposal import candidate, gain_search
from tuning.steps import identify, observe

_WEATHER_KEYS = ("barometer_gain_um_per_pa", "temperature_gain_um_per_k")


def compare_sessions(a: SessionFolder, b: SessionFolder) -> str:
    """Compare two sessions.

    Parameters
    ----------
    a, b : SessionFolder
        Both with a design.

    Returns
    -------
    str
        Markdown: the plants, the gains, and the prediction for each set of gains on each plant.

    Raises
    ------
    InputError
        If one of the sessions has no design yet.
    """
    for each in (a, b):
        each.require_done("design")
    files = [gains_file.load_gains(each.file_path("gains.toml")) for each in (a, b)]
    return "\n".join(
        [
            *_tabulate_plants(a, b, files),
            "",
            *_tabulate_gains(files),
            "",
            *_tabulate_crossed(a, b, files),
        ]
    )


def _tabulate_plants(
    a: SessionFolder, b: SessionFolder, files: list[gains_file.GainsFile]
) -> list[str]:
    """Table of the fitted plants, with noise and lower bound."""
    head = (
        "| plant | k | +- | dead time s | lag s | delay +- s | leak µm/s | laser µm | least std "
        "µm |"
    )
    lines = [head, "|---" + "|---:" * 8 + "|"]
    for each, gains in zip((a, b), files, strict=True):
        plant = gains.plant
        lines.append(
            f"| {each.path.name} | {plant.gain:.3f} | {plant.gain_sigma:.3f} | "
            f"{plant.dead_time_s:.3f} | {plant.lag_s:.3f} | {plant.delay_sigma_s:.3f} | "
            f"{plant.leak_um_per_s:.2f} | {observe.load_disturbance(each).laser_um:.2f} | "
            f"{gains.least_std_um:.3f} |"
        )
    return lines


def _tabulate_gains(files: list[gains_file.GainsFile]) -> list[str]:
    """Table of the loop settings that differ."""
    left, right = (gains.loop.model_dump() for gains in files)
    lines = ["| setting | A | B |", "|---|---:|---:|"]
    lines += [
        f"| {name} | {left[name]} | {right[name]} |" for name in left if left[name] != right[name]
    ]
    return lines


def _tabulate_crossed(
    a: SessionFolder, b: SessionFolder, files: list[gains_file.GainsFile]
) -> list[str]:
    """Table of the prediction for the gains of each session on the plant of each."""
    head = "| gains of | on plant and weather of | std µm | / least | Ms | load peak µm |"
    lines = [head, "|---|---" + "|---:" * 4 + "|"]
    for place, each, own in (("A", a, files[0]), ("B", b, files[1])):
        model = identify.load_identified(each).identified.model
        weather = observe.load_disturbance(each)
        for name, gains in zip("AB", files, strict=True):
            # The weather gains belong to the bench, not to the design.
            of_bench = {key: getattr(own.loop, key) for key in _WEATHER_KEYS}
            loop = schema.LoopConfig.model_validate(gains.loop.model_dump() | of_bench)
            row = candidate.evaluate_candidate(
                name, Gains.from_config(loop), model, weather, loop, gain_search.Demands()
            )
            std = "unstable | "
            if row.predicted is not None:
                std = f"{row.predicted.std_um:.3f} | {row.ratio:.2f}"
            lines.append(
                f"| {name} | {place} | {std} | {row.margins.ms:.2f} | {row.load_peak_um:.2f} |"
            )
    return lines
