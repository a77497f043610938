"""Gains with where they come from: the loop's settings, the plant they are for, data, author, date, reason.

A file that was edited by hand is read like any other: its gains are checked on its plant, and what would be unstable
or has too little margin is refused by name.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import tomli_w
from pydantic import Field

from membrane_ctrl import config_file
from membrane_ctrl.config import LoopConfig, Section
from membrane_ctrl.errors import InputError
from membrane_ctrl.recording.atomic import users, write_text_atomic
from tuning.identify import Identified
from tuning.loop_model import Gains
from tuning.margins import margins
from tuning.plant_model import PlantModel

# A little above what the design demands (1.4): the grid of the search, and a plant that was identified again.
MS_MAX = 1.6

Positive = Annotated[float, Field(gt=0)]


class PlantSection(Section):
    """The plant the gains were made for (`plant_model.PlantModel`), with standard errors."""

    gain: Positive
    dead_time_s: Annotated[float, Field(ge=0, le=10)]
    lag_s: Annotated[float, Field(ge=0, le=10)]
    leak_um_per_s: float
    gain_sigma: Annotated[float, Field(ge=0)]
    delay_sigma_s: Annotated[float, Field(ge=0)]

    @classmethod
    def of(cls, identified: Identified) -> PlantSection:
        """The section for a fit."""
        sigma = identified.sigma
        return cls(**asdict(identified.model), gain_sigma=sigma.gain, delay_sigma_s=sigma.delay_s)

    @property
    def model(self) -> PlantModel:
        """The plant."""
        return PlantModel(self.gain, self.dead_time_s, self.lag_s, self.leak_um_per_s)


class GainsFile(Section):
    """`gains.toml`."""

    format: Literal["membrane-gains/1"] = "membrane-gains/1"
    author: str
    date_utc: str
    reason: str
    source: str  # run folder or twin, and session
    data_sha256: str
    predicted_std_um: Positive
    least_std_um: Positive
    plant: PlantSection
    loop: LoopConfig


def save_gains(path: Path, gains: GainsFile) -> None:
    """Write a gains file in one step; without the setpoint, which is the hold's own."""
    text = tomli_w.dumps(gains.model_dump(mode="json", exclude={"loop": {"setpoint_um"}}))
    write_text_atomic(users(path), text)


def load_gains(path: Path) -> GainsFile:
    """Read a gains file. Raises InputError (one line: file, field, remedy)."""
    return config_file.load(path, GainsFile)


def require_sound(gains: GainsFile, where: str, running: LoopConfig) -> None:
    """Refuse gains that must not be applied.

    Parameters
    ----------
    gains : GainsFile
    where : str
        For the message.
    running : LoopConfig
        Of the hold they are for.

    Raises
    ------
    InputError
        If the loop would be unstable on the file's own plant or has too little margin, or ticks differently.
    """
    dt_s = 1 / gains.loop.rate_hz
    found = margins(Gains.of(gains.loop), gains.plant.model, dt_s)
    if not found.stable:
        raise InputError(f"{where}: loop: unstable on the plant of this very file; was it edited by hand?")
    if not found.ms <= MS_MAX or math.isnan(found.ms):
        raise InputError(
            f"{where}: loop: sensitivity {found.ms:.2f} on the plant of this file, {MS_MAX:g} is the most that is "
            "applied; was it edited by hand?"
        )
    if gains.loop.rate_hz != running.rate_hz:
        raise InputError(
            f"{where}: loop.rate_hz: {gains.loop.rate_hz:g} Hz, the hold ticks at {running.rate_hz:g} Hz"
        )


def for_hold(gains: LoopConfig, running: LoopConfig) -> LoopConfig:
    """The gains for a hold whose setpoint and bleed are its own: those are no gains."""
    kept = {"setpoint_um": running.setpoint_um, "bleed_fraction": running.bleed_fraction}
    return LoopConfig.model_validate(gains.model_dump() | kept)
