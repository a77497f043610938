"""Checks that the gains of a session fit a hold or a configuration."""

from dataclasses import replace
from pathlib import Path

from membrane_ctrl.config import schema
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sessions.folder import SessionFolder
from membrane_ctrl.sessions.live_hold import HoldLink
from tuning import gains_file

GAIN_KEYS = (
    "kp_per_s",
    "ti_s",
    "td_s",
    "measurement_filter_s",
    "barometer_gain_um_per_pa",
    "temperature_gain_um_per_k",
)
# settings on which gains do not depend
INDEPENDENT_KEYS = ("setpoint_um", "bleed_fraction", "probe_um", "change_max")


def continue_on_hold(folder: SessionFolder, link: HoldLink) -> SessionFolder:
    """Return the session if it can continue with this hold, perhaps a later one than it began on.

    Parameters
    ----------
    folder : SessionFolder
        The session.
    link : HoldLink
        The hold.

    Returns
    -------
    SessionFolder

    Raises
    ------
    InputError
        Pump, loop or present gains are not those that its data are for.
    """
    where = f"the hold {link.name}"
    # The same twin has the devices of a configuration that is practised on it.
    if link.name != folder.head.source:
        require_same_devices(where, link.config, folder)
    _require_same_settings(where, link.config, folder)
    known = [folder.head.before]
    if folder.is_done("design"):  # its own gains may be on trial
        known.append(gains_file.load_gains(folder.file_path("gains.toml")).loop)
    running = link.config.loop
    for key in GAIN_KEYS:
        if all(getattr(running, key) != getattr(loop, key) for loop in known):
            raise InputError(
                f"{where}: loop.{key} = {getattr(running, key):g}, {folder.path.name} began with "
                f"{getattr(known[0], key):g}: set that with `ctl gains`, or start a new "
                "session with another --name"
            )
    bleed = {"bleed_fraction": running.bleed_fraction}  # perhaps opened since, as a refusal asked
    return replace(
        folder, head=replace(folder.head, before=folder.head.before.model_copy(update=bleed))
    )


def require_same_devices(path: Path | str, config: schema.Config, folder: SessionFolder) -> None:
    """Require that results of the twin are not used for devices.

    Parameters
    ----------
    path : Path or str
        The file or hold that shall get them, for the message.
    config : Config
        Its configuration.
    folder : SessionFolder
        The session.

    Raises
    ------
    InputError
        The session tuned the simulated bench, and the configuration has devices.
    """
    if config.devices is not None and (
        folder.config.devices is None or folder.head.source == "twin"
    ):
        raise InputError(f"{path}: has [devices], but the session tuned the simulated bench")


def require_same_bench(path: Path | str, config: schema.Config, folder: SessionFolder) -> None:
    """Require that the gains of a session are for this pump and this loop.

    Parameters
    ----------
    path : Path or str
        The file or hold, for the message.
    config : Config
        Its configuration.
    folder : SessionFolder
        The session.

    Raises
    ------
    InputError
        A key differs that is neither a gain nor independent of the gains.
    """
    require_same_devices(path, config, folder)
    _require_same_settings(path, config, folder)


def _require_same_settings(path: Path | str, config: schema.Config, folder: SessionFolder) -> None:
    tuned = folder.config
    for section in ("pump", "loop"):
        here, there = getattr(config, section), getattr(tuned, section)
        for key in type(here).model_fields:
            now, then = getattr(here, key), getattr(there, key)
            if now != then and key not in (*GAIN_KEYS, *INDEPENDENT_KEYS):
                raise InputError(
                    f"{path}: {section}.{key} = {now}, the session had {then}: its gains do not "
                    "fit; tune with this configuration"
                )
