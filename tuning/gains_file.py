"""Gains and their origin: the loop's settings, the plant they are for, data, author, date, reason.

A hand-edited file is read like any other: its gains are checked on its plant, and gains that are
unstable or have too little margin are refused by name.
"""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Final, Literal

import tomli_w
from pydantic import Field

from firmware_iface.settings import Section
from membrane_ctrl.config import toml_file as config_file
from membrane_ctrl.config.control import KEYS_BESIDE_GAINS
from membrane_ctrl.config.origin import OriginSection
from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.model import errors, files, program
from tuning.identification import closed_loop, margins, plant_fit, plant_model

# A little above the design's limit (1.4), to allow for the search grid and a re-identified plant.
MS_MAX = 1.6
Positive = Annotated[float, Field(gt=0)]
SCHEMA: Final = "membrane-gains/1"
_NO_GAINS = {"setpoint_um", "bleed_fraction", "flow_max_um_per_s"}


class PlantSection(Section):
    """The plant the gains were designed for (`plant_model.PlantModel`), with standard errors."""

    gain: Positive
    dead_time_s: Annotated[float, Field(ge=0, le=10)]
    lag_s: Annotated[float, Field(ge=0, le=10)]
    leak_um_per_s: float
    gain_sigma: Annotated[float, Field(ge=0)]
    delay_sigma_s: Annotated[float, Field(ge=0)]

    @classmethod
    def from_fit(cls, identified: plant_fit.Identified) -> "PlantSection":
        """The section for a fit."""
        sigma = identified.sigma
        return cls(**asdict(identified.model), gain_sigma=sigma.gain, delay_sigma_s=sigma.delay_s)

    @property
    def model(self) -> plant_model.PlantModel:
        """The plant."""
        return plant_model.PlantModel(self.gain, self.dead_time_s, self.lag_s, self.leak_um_per_s)


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
    """Write a gains file atomically, without what belongs to the hold: setpoint and held scalar.

    Parameters
    ----------
    path : path
        The file, TOML; replaced as a whole.
    gains : GainsFile
        With the plant and the data that they are for.
    """
    origin = program.file_origin(SCHEMA)
    excluded = {"loop": set(KEYS_BESIDE_GAINS)}
    table = gains.model_dump(mode="json", by_alias=True, exclude=excluded)
    files.write_text_atomic(files.resolve_user_path(path), tomli_w.dumps({**table, **origin}))


def load_gains(path: Path) -> GainsFile:
    """Read a gains file. Raises InputError (one line: file, field, remedy)."""
    return config_file.load_toml(path, GainsFile)


def require_sound(gains: GainsFile, where: str, running: LoopConfig) -> None:
    """Refuse gains that must not be applied.

    Parameters
    ----------
    gains : GainsFile
        With the plant that they were designed for.
    where : str
        Name of the file, for the message.
    running : LoopConfig
        The settings of the hold.

    Raises
    ------
    InputError
        If the loop is unstable or has too little margin on the file's own plant, or its tick rate
        differs from that of the hold.
    """
    dt_s = 1 / gains.loop.rate_hz
    found = margins.compute_margins(
        closed_loop.Gains.from_config(gains.loop), gains.plant.model, dt_s
    )
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


def adapt_to_hold(gains: LoopConfig, running: LoopConfig) -> LoopConfig:
    """Return the gains for a hold.

    Parameters
    ----------
    gains : LoopConfig
        The gains to apply.
    running : LoopConfig
        The settings of the hold, whose setpoint, bleed and limit of the flow stay.
    """
    return LoopConfig.model_validate(gains.model_dump() | running.model_dump(include=_NO_GAINS))
