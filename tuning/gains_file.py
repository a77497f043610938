"""Gains and their origin: the loop's settings, the plant they are for, data, author, date, reason.

A hand-edited file is read like any other: its gains are checked on its plant, and gains that are
unstable or have too little margin are refused by name.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, astuple, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final, Literal

import tomli_w
from pydantic import Field

from firmware_iface.settings import Section
from membrane_ctrl.config import toml_file as config_file
from membrane_ctrl.config.origin import OriginSection
from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.model import errors, files, plain_json, program
from membrane_ctrl.sessions import folder as plain
from tuning.identification import identify, loop_model

# A little above the design's limit (1.4), to allow for the search grid and a re-identified plant.
MS_MAX = 1.6

Positive = Annotated[float, Field(gt=0)]


class PlantSection(Section):
    """The plant the gains were designed for (`loop_model.PlantModel`), with standard errors."""

    gain: Positive
    dead_time_s: Annotated[float, Field(ge=0, le=10)]
    lag_s: Annotated[float, Field(ge=0, le=10)]
    leak_um_per_s: float
    gain_sigma: Annotated[float, Field(ge=0)]
    delay_sigma_s: Annotated[float, Field(ge=0)]

    @classmethod
    def of(cls, identified: identify.Identified) -> "PlantSection":
        """The section for a fit."""
        sigma = identified.sigma
        return cls(**asdict(identified.model), gain_sigma=sigma.gain, delay_sigma_s=sigma.delay_s)

    @property
    def model(self) -> loop_model.PlantModel:
        """The plant."""
        return loop_model.PlantModel(self.gain, self.dead_time_s, self.lag_s, self.leak_um_per_s)


SCHEMA: Final = "membrane-gains/1"


class GainsFile(OriginSection):
    """`gains.toml`."""

    schema_: Annotated[Literal["membrane-gains/1"], Field(alias="schema")] = SCHEMA
    author: str
    date_utc: str
    reason: str
    source: str  # run folder or twin, and session
    data_sha256: str
    candidate: str = ""  # its name, if a person chose it
    predicted_std_um: Positive
    least_std_um: Positive
    plant: PlantSection
    loop: LoopConfig


def save_gains(path: Path, gains: GainsFile) -> None:
    """Write a gains file atomically, without the setpoint, which belongs to the hold."""
    origin = program.file_origin(SCHEMA)
    table = gains.model_dump(mode="json", by_alias=True, exclude={"loop": {"setpoint_um"}})
    files.write_text_atomic(files.users(path), tomli_w.dumps({**table, **origin}))


def load_gains(path: Path) -> GainsFile:
    """Read a gains file. Raises InputError (one line: file, field, remedy)."""
    return config_file.load(path, GainsFile)


def require_sound(gains: GainsFile, where: str, running: LoopConfig) -> None:
    """Refuse gains that must not be applied.

    Raises InputError if the loop is unstable or has too little margin on the file's own plant, or
    its tick rate differs from that of the hold (`running`); `where` names the file.
    """
    dt_s = 1 / gains.loop.rate_hz
    found = loop_model.margins(loop_model.Gains.of(gains.loop), gains.plant.model, dt_s)
    if not found.stable:
        raise errors.InputError(
            f"{where}: loop: unstable on this file's plant; was the file edited by hand?"
        )
    if not found.ms <= MS_MAX or math.isnan(found.ms):
        raise errors.InputError(
            f"{where}: loop: sensitivity {found.ms:.2f} on this file's plant, the limit is "
            f"{MS_MAX:g}; was it edited by hand?"
        )
    if gains.loop.rate_hz != running.rate_hz:
        raise errors.InputError(
            f"{where}: loop.rate_hz: {gains.loop.rate_hz:g} Hz, the hold ticks at "
            f"{running.rate_hz:g} Hz"
        )


_NO_GAINS = {"setpoint_um", "bleed_fraction", "flow_max_um_per_s"}


def for_hold(gains: LoopConfig, running: LoopConfig) -> LoopConfig:
    """The gains for a hold, which keeps its own setpoint, bleed and limit of the flow: those are
    not gains.
    """
    return LoopConfig.model_validate(gains.model_dump() | running.model_dump(include=_NO_GAINS))


# `<logs>/tuning/journal.jsonl`: which gains were kept, taken back or rolled back, when, by whom and
# why.

_FILE = "journal.jsonl"
What = Literal["kept", "taken_back", "rolled_back", "saved"]


@dataclass(frozen=True, slots=True)
class Traded:
    """The name of a candidate, and the figures before and with it."""

    candidate: str
    before: loop_model.LoopFigures
    after: loop_model.LoopFigures

    @property
    def words(self) -> tuple[str, ...]:
        """Standard deviation in µm, load peak in µm, recovery in s, Ms: each before and after."""
        pairs = zip(astuple(self.before), astuple(self.after), (3, 2, 1, 2), strict=True)
        return tuple(
            f"{before:.{digits}f} -> {after:.{digits}f}" for before, after, digits in pairs
        )

    def __str__(self) -> str:
        std, peak, recovery, ms = self.words
        return f"std {std} µm, load peak {peak} µm, recovery {recovery} s, Ms {ms}"


@dataclass(frozen=True, slots=True)
class GainsEntry:
    """One line of the journal."""

    time_utc: str
    # "kept": verified; "taken_back": the verification failed; "rolled_back", "saved": by a person
    what: What
    session: str
    author: str
    reason: str
    before: LoopConfig  # gains before and with it; after "taken_back" the former are in force again
    after: LoopConfig
    traded: Traded | None = None
    # time constant of the shape loop before and after, if that was tried
    shape_s: tuple[float, float] | None = None


def entry(
    what: What,
    session: str,
    author: str,
    reason: str,
    before: LoopConfig,
    after: LoopConfig,
    traded: Traded | None = None,
    shape_s: tuple[float, float] | None = None,
) -> GainsEntry:
    """Return an entry stamped with the present time."""
    now_utc = datetime.now(UTC).isoformat(timespec="seconds")
    return GainsEntry(now_utc, what, session, author, reason, before, after, traded, shape_s)


def note(logs: Path, what: GainsEntry) -> None:
    """Append an entry. Raises InputError if it cannot be written;
    symbolic links are not followed.
    """
    path = logs / "tuning" / _FILE
    with errors.writing(path):
        files.make_folder(path.parent)
        files.append_text(path, json.dumps(plain.plain(what), allow_nan=False) + "\n")
        files.sync_data(path)


def entries(logs: Path) -> list[GainsEntry]:
    """All entries, oldest first, without truncated lines. Raises InputError if it is not a regular
    file.
    """
    path = logs / "tuning" / _FILE
    try:
        text = files.read_text(path, errors="replace")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise errors.InputError(f"{path}: {errors.os_reason(error)}") from None
    found: list[GainsEntry] = []
    for line in text.splitlines():
        try:
            found.append(plain.built(GainsEntry, plain_json.loads(line)))
        except (ValueError, TypeError, KeyError):
            continue
    return found


def to_roll_back(logs: Path, gains_only: bool = False) -> GainsEntry:
    """The newest gains kept and not rolled back since. Raises InputError if there are none.

    A time constant of the shape loop counts too, unless `gains_only`.
    """
    for found in _in_force(logs):
        if found.shape_s is None or not gains_only:
            return found
    raise errors.InputError(f"{logs / 'tuning' / _FILE}: no kept gains")


def kept_shape_s(logs: Path, session: str = "") -> float | None:
    """The shape loop's time constant kept last, by any or this session,
    and not rolled back since.
    """
    of_it = (line.shape_s for line in _in_force(logs) if session in ("", line.session))
    return next((shape_s[1] for shape_s in of_it if shape_s is not None), None)


def _in_force(logs: Path) -> Iterator[GainsEntry]:
    """What was kept and not rolled back since, newest first."""
    undone: set[tuple[str, bool]] = set()
    for found in reversed(entries(logs)):
        of = (found.session, found.shape_s is None)
        if found.what == "rolled_back":
            undone.add(of)
        elif found.what == "kept" and of not in undone:
            yield found


def history_table(found: list[GainsEntry]) -> str:
    """The journal as a Markdown table."""
    lines = [
        "| time | what | session | author | K 1/s | Ti s | filter s | candidate | std µm | "
        "load peak µm | recovery s "
        "| Ms | reason |",
        "|---|---|---|---|---:|---:|---:|---|---:|---:|---:|---:|---|",
    ]
    for line in found:
        loop = line.before if line.what == "rolled_back" else line.after
        traded = (
            (line.traded.candidate, *line.traded.words) if line.traded is not None else [""] * 5
        )
        reason = line.reason
        if line.shape_s is not None:
            before_s, after_s = (
                reversed(line.shape_s) if line.what == "rolled_back" else line.shape_s
            )
            reason = f"shape loop {before_s:.0f} -> {after_s:.0f} s: {reason}"
        lines.append(
            f"| {line.time_utc} | {line.what} | {line.session} | {line.author} | "
            f"{loop.kp_per_s:.3f} "
            f"| {loop.ti_s:.2f} | {loop.measurement_filter_s:.2f} | {' | '.join(traded)} | "
            f"{reason} |"
        )
    return "\n".join(lines)
