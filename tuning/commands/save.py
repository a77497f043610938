"""`tune save`: the kept gains into the configuration, so that the next hold starts with them."""

import contextlib
from pathlib import Path

from firmware_iface.settings import Section
from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.controller.cross_check import require_sound
from membrane_ctrl.model import errors, files
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sessions.folder import SessionFolder, find_newest_session, open_session
from tuning import estimator_levels, journal
from tuning.configuration_edit import confirm_and_replace, edit_text, list_changes
from tuning.same_bench import GAIN_KEYS, require_same_bench, require_same_devices
from tuning.steps import map_pump, verify


def save_to_configuration(path: Path, name: Path | None, logs: Path, author: str, yes: bool) -> int:
    """Save what a session kept into a configuration file: gains, curve of the pump, time constant
    of the shape loop.

    It shows the difference and asks; comments of the file stay.

    Parameters
    ----------
    path : Path
        The configuration, one TOML file.
    name : Path or None
        Folder of a session. None: the gains and the time constant that were kept last, which may be
        of two sessions.
    logs : Path
        Folder of the runs; its `tuning` holds sessions and journal.
    author : str
        Who saves, for the journal.
    yes : bool
        Write without asking; without a terminal nothing is written otherwise.

    Returns
    -------
    int
        The exit code.

    Raises
    ------
    InputError
        The gains were not kept, or are not for this configuration.
    """
    config = toml_file.load_toml(path, schema.Config)
    # A hold without PI loop has tuned only its estimator.
    if not config.has_pi:
        return _save_estimator(
            path, find_newest_session(logs) if name is None else open_session(name), config, yes
        )
    # Which kinds of results the session has kept: gains, curve of the pump, time constant.
    folder, shape_s = _find_session(name, logs)
    keys: tuple[str, ...] = GAIN_KEYS
    gains, pump = config.loop, config.pump
    # Gains hold for the bench that they were found on; a time constant only for the same devices.
    if shape_s is None or folder.is_done("verify") or map_pump.has_pump_map(folder):
        gains, pump = _load_kept_gains(folder), folder.config.pump
        same = config
        if map_pump.has_pump_map(folder) and config.pump == map_pump.load_pump_map(folder).before:
            keys = (*keys, "flow_max_um_per_s")  # comes with the curve
            loop = config.loop.model_copy(update={"flow_max_um_per_s": gains.flow_max_um_per_s})
            same = config.model_copy(update={"pump": pump, "loop": loop})
        require_same_bench(path, same, folder)
    else:
        require_same_devices(path, config, folder)
    # Only the entries that differ are edited, so the comments of the file stay.
    before = files.read_text(path, follow=True)
    shape = config.shape.model_copy(
        update={"time_constant_s": shape_s or config.shape.time_constant_s}
    )
    changed = {
        "loop": list_changes(config.loop, gains, keys),
        "pump": list_changes(config.pump, pump),
        "shape": list_changes(config.shape, shape),
    }
    if folder.config.estimator.process_value == "auto" and folder.is_done("observe"):
        measured = _find_estimator(folder, config)
        changed["estimator"] = list_changes(config.estimator, measured)
    after = edit_text(before, changed, path)
    # The whole configuration that would result is checked before anyone is asked.
    loop = schema.LoopConfig.model_validate(config.loop.model_dump() | changed["loop"])
    require_sound(config.model_copy(update={"loop": loop, "pump": pump, "shape": shape}), str(path))
    if not any(changed.values()):
        print(f"{path} already has the gains of {folder.path.name}")
        return errors.Exit.DONE
    if not confirm_and_replace(path, before, after, folder, yes):
        return errors.Exit.DONE
    # The journal of the sessions keeps who saved which gains where.
    entry = journal.make_entry(
        "saved", folder.path.name, author, str(path.resolve()), folder.head.before, gains
    )
    journal.append_entry(folder.path.resolve().parents[1], entry)
    return errors.Exit.DONE


def _save_estimator(path: Path, folder: SessionFolder, config: schema.Config, yes: bool) -> int:
    """Save the pump and the noise levels that a session measured: the loop of an estimate has no
    other gains.

    With the pump's curve, if it measured one, come the gains that suit it, for a hold that begins
    on the laser.
    """
    require_same_devices(path, config, folder)
    tables: dict[str, Section] = {}
    if map_pump.has_pump_map(folder):
        pump = folder.config.pump
        if config.pump not in (pump, map_pump.load_pump_map(folder).before):
            raise InputError(
                f"{path}: has another [pump] than the session began with: tune with this "
                "configuration"
            )
        keys = {*GAIN_KEYS, "flow_max_um_per_s"}
        loop = config.loop.model_copy(update=folder.head.before.model_dump(include=keys))
        tables = {"pump": pump, "loop": loop}
    tables["estimator"] = _find_estimator(folder, config)
    require_sound(config.model_copy(update=tables), str(path))
    changed = {name: list_changes(getattr(config, name), table) for name, table in tables.items()}
    if not any(changed.values()):
        print(f"{path} already has what {folder.path.name} measured")
        return errors.Exit.DONE
    before = files.read_text(path, follow=True)
    confirm_and_replace(path, before, edit_text(before, changed, path), folder, yes)
    return errors.Exit.DONE


def _find_estimator(folder: SessionFolder, config: schema.Config) -> schema.EstimatorConfig:
    """The estimator's settings with the pump and the noise levels that a session measured."""
    levels = estimator_levels.derive_estimator_levels(folder)
    known = config.estimator.model_dump() | levels | {"pump_response": "stated"}
    return toml_file.parse_tables(known, schema.EstimatorConfig, str(folder.path))


def _find_session(name: Path | None, logs: Path) -> tuple[SessionFolder, float | None]:
    """A session, by default the one whose gains were kept last; and the time constant of the shape
    loop it kept.

    By default that is the one kept last. Raises InputError if nothing was kept.
    """
    if name is not None:
        folder = open_session(name)
        return folder, journal.find_kept_shape_s(folder.path.resolve().parents[1], folder.path.name)
    shape_s = journal.find_kept_shape_s(logs)
    newest = journal.find_roll_back(logs)
    with contextlib.suppress(InputError):
        newest = journal.find_roll_back(logs, gains_only=True)
    return open_session(logs / "tuning" / newest.session), shape_s


def _load_kept_gains(folder: SessionFolder) -> schema.LoopConfig:
    """The gains that the session kept: verified, or with a curve of the pump.

    Raises InputError if there are none, or they were rolled back.
    """
    if map_pump.has_pump_map(folder) and not (
        folder.is_done("verify") and verify.load_verified(folder).kept
    ):
        return folder.head.before
    done = verify.load_verified(folder)
    if not done.kept:
        raise InputError(f"{folder.path}: its gains were not kept: {done.reason}")
    noted = journal.read_entries(folder.path.resolve().parents[1])
    last = [line for line in noted if line.session == folder.path.name and line.shape_s is None]
    if last and last[-1].what == "rolled_back":
        raise InputError(
            f"{folder.path}: its gains were rolled back on {last[-1].time_utc} ({last[-1].reason})"
        )
    return done.after
