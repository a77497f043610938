"""What a person decides: which candidate is applied, and whether kept gains become those of the
configuration.
"""

import contextlib
import difflib
import json
import sys
import tomllib
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from firmware_iface.settings import Section
from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.controller.cross_check import require_sound
from membrane_ctrl.model import errors, files, terminal
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sessions.folder import SessionFolder, newest_session, open_session
from membrane_ctrl.sessions.live_hold import HoldLink, Progress
from tuning import gains_file, pump_trial, session
from tuning.identification.loop_model import Gains
from tuning.proposal import candidates, design
from tuning.rig import HoldRig


def require_an_answer(yes: bool, name: str) -> None:
    """Raises InputError before anything moves if nobody could choose the gains, or the name is no
    candidate's.
    """
    if not (yes or name or sys.stdin.isatty()):
        raise InputError(
            "the gains to apply are chosen on a terminal; elsewhere add --yes (the proposal) "
            "or --choose NAME"
        )
    if name and name not in design.NAMES:
        raise InputError(f"--choose {name}: not a candidate; known: {', '.join(design.NAMES)}")


def chosen(folder: SessionFolder, rig: HoldRig, yes: bool, name: str, progress: Progress) -> bool:
    """Show what each candidate gives and costs, and ask; false if a person wants none of them."""
    rows, now = session.offered(folder)
    model = session.found_of(folder).identified.model
    screen = terminal.table_console(stderr=True, width=None if sys.stderr.isatty() else 170)
    screen.print(design.shown(rows, f"proposed: {now.name}", model.leak_um_per_s))
    if name:
        session.choose(folder, name)
    while not (name or yes):
        answer = progress.ask("apply which candidate? (Enter: none)", session.choices(folder))
        if not answer:
            return False
        try:
            session.choose(folder, answer)
            break
        except InputError as error:
            progress.say(str(error))
    rig.catch_up()
    return True


def for_hold(folder: SessionFolder, link: HoldLink) -> SessionFolder:
    """The session, if it can go on with this hold, perhaps a later one than it began on.

    Raises InputError if pump, loop or gains in force are not those that its data are for.
    """
    where = f"the hold {link.name}"
    _require_same_bench(where, link.config, folder)
    known = [folder.head.before]
    if folder.done("design"):  # its own gains may be on trial
        known.append(gains_file.load_gains(folder.file("gains.toml")).loop)
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


# Kept gains into the configuration, so that the next hold starts with them.

GAIN_KEYS = (
    "kp_per_s",
    "ti_s",
    "td_s",
    "measurement_filter_s",
    "barometer_gain_um_per_pa",
    "temperature_gain_um_per_k",
)
# settings on which gains do not depend
_ANY = ("setpoint_um", "bleed_fraction", "probe_um", "change_max")


def save(path: Path, name: Path | None, logs: Path, author: str, yes: bool) -> int:
    """Save what a session kept into a configuration file: gains, curve of the pump, time constant
    of the shape loop.

    By default the gains and the time constant that were kept last. Returns the exit code.

    Shows the difference and asks; without a terminal only `yes` writes. Comments stay.

    Raises InputError if the gains were not kept, or are not for this configuration.
    """
    config = toml_file.load(path, schema.Config)
    if config.estimator.process_value != "laser":
        return _save_estimator(
            path, newest_session(logs) if name is None else open_session(name), config, yes
        )
    folder, shape_s = _named(name, logs)
    keys: tuple[str, ...] = GAIN_KEYS
    gains, pump = config.loop, config.pump
    if shape_s is None or folder.done("verify") or pump_trial.mapped(folder):
        gains, pump = _kept(folder), folder.config.pump
        same = config
        if pump_trial.mapped(folder) and config.pump == pump_trial.mapped_of(folder).before:
            keys = (*keys, "flow_max_um_per_s")  # comes with the curve
            loop = config.loop.model_copy(update={"flow_max_um_per_s": gains.flow_max_um_per_s})
            same = config.model_copy(update={"pump": pump, "loop": loop})
        _require_same_bench(path, same, folder)
    else:
        _require_same_devices(path, config, folder)
    before = files.read_text(path, follow=True)
    shape = config.shape.model_copy(
        update={"time_constant_s": shape_s or config.shape.time_constant_s}
    )
    changed = {
        "loop": _changes(config.loop, gains, keys),
        "pump": _changes(config.pump, pump),
        "shape": _changes(config.shape, shape),
    }
    after = _with(before, changed, path)
    loop = schema.LoopConfig.model_validate(config.loop.model_dump() | changed["loop"])
    require_sound(config.model_copy(update={"loop": loop, "pump": pump, "shape": shape}), str(path))
    if not any(changed.values()):
        print(f"{path} already has the gains of {folder.path.name}")
        return errors.Exit.DONE
    if not _replaced(path, before, after, folder, yes):
        return errors.Exit.DONE
    told = gains_file.entry(
        "saved", folder.path.name, author, str(path.resolve()), folder.head.before, gains
    )
    gains_file.note(folder.path.resolve().parents[1], told)
    return errors.Exit.DONE


def _save_estimator(path: Path, folder: SessionFolder, config: schema.Config, yes: bool) -> int:
    """Save the pump and the noise levels that a session measured: the loop of an estimate has no
    other gains.

    With the pump's curve, if it measured one, come the gains that suit it, for a hold that begins
    on the laser.
    """
    _require_same_devices(path, config, folder)
    tables: dict[str, Section] = {}
    if pump_trial.mapped(folder):
        pump = folder.config.pump
        if config.pump not in (pump, pump_trial.mapped_of(folder).before):
            raise InputError(
                f"{path}: has another [pump] than the session began with: tune with this "
                "configuration"
            )
        keys = {*GAIN_KEYS, "flow_max_um_per_s"}
        loop = config.loop.model_copy(update=folder.head.before.model_dump(include=keys))
        tables = {"pump": pump, "loop": loop}
    known = config.estimator.model_dump() | session.estimator_of(folder)
    estimator = toml_file.parse(known, schema.EstimatorConfig, str(folder.path))
    tables["estimator"] = estimator
    require_sound(config.model_copy(update=tables), str(path))
    changed = {name: _changes(getattr(config, name), table) for name, table in tables.items()}
    if not any(changed.values()):
        print(f"{path} already has what {folder.path.name} measured")
        return errors.Exit.DONE
    before = files.read_text(path, follow=True)
    _replaced(path, before, _with(before, changed, path), folder, yes)
    return errors.Exit.DONE


def _replaced(path: Path, before: str, after: str, folder: SessionFolder, yes: bool) -> bool:
    """Show the difference and ask, unless `yes`; whether the file was written."""
    shown = difflib.unified_diff(
        before.splitlines(), after.splitlines(), str(path), folder.path.name, lineterm="", n=1
    )
    print("\n".join(shown))
    if not yes and not (
        sys.stdin.isatty() and Progress().ask(f"save to {path}? [y/N]").lower() in ("y", "yes")
    ):
        print(f"{path} is unchanged; --yes saves without asking", file=sys.stderr)
        return False
    _replace(path, before, after)
    return True


def _named(name: Path | None, logs: Path) -> tuple[SessionFolder, float | None]:
    """A session, by default the one whose gains were kept last; and the time constant of the shape
    loop it kept.

    By default that is the one kept last. Raises InputError if nothing was kept.
    """
    if name is not None:
        folder = open_session(name)
        return folder, gains_file.kept_shape_s(folder.path.resolve().parents[1], folder.path.name)
    shape_s = gains_file.kept_shape_s(logs)
    newest = gains_file.to_roll_back(logs)
    with contextlib.suppress(InputError):
        newest = gains_file.to_roll_back(logs, gains_only=True)
    return open_session(logs / "tuning" / newest.session), shape_s


def _changes(old: Section, new: Section, keys: Collection[str] = ()) -> dict[str, Any]:
    """Settings of a table that differ, all or some, as plain values."""
    plain = new.model_dump(mode="json", include=set(keys) or None)
    return {key: value for key, value in plain.items() if getattr(new, key) != getattr(old, key)}


def _kept(folder: SessionFolder) -> schema.LoopConfig:
    """The gains that the session kept: verified, or with a curve of the pump.

    Raises InputError if there are none, or they were rolled back.
    """
    if pump_trial.mapped(folder) and not (
        folder.done("verify") and session.verified_of(folder).kept
    ):
        return folder.head.before
    done = session.verified_of(folder)
    if not done.kept:
        raise InputError(f"{folder.path}: its gains were not kept: {done.reason}")
    noted = gains_file.entries(folder.path.resolve().parents[1])
    last = [line for line in noted if line.session == folder.path.name and line.shape_s is None]
    if last and last[-1].what == "rolled_back":
        raise InputError(
            f"{folder.path}: its gains were rolled back on {last[-1].time_utc} ({last[-1].reason})"
        )
    return done.after


def _require_same_devices(path: Path | str, config: schema.Config, folder: SessionFolder) -> None:
    """Raises InputError if the session tuned the simulated bench,
    and the configuration is another.
    """
    if config.devices is not None and (
        folder.config.devices is None or folder.head.source == "twin"
    ):
        raise InputError(f"{path}: has [devices], but the session tuned the simulated bench")


def _require_same_bench(path: Path | str, config: schema.Config, folder: SessionFolder) -> None:
    """Raises InputError if the gains are for another pump or another loop."""
    _require_same_devices(path, config, folder)
    tuned = folder.config
    for section in ("pump", "loop"):
        here, there = getattr(config, section), getattr(tuned, section)
        for key in type(here).model_fields:
            now, then = getattr(here, key), getattr(there, key)
            if now != then and key not in (*GAIN_KEYS, *_ANY):
                raise InputError(
                    f"{path}: {section}.{key} = {now}, the session had {then}: its gains do "
                    "not fit; tune with this "
                    "configuration"
                )


def _with(text: str, changed: dict[str, dict[str, Any]], path: Path) -> str:
    """The configuration's text with these keys of its tables; nothing else changes, or InputError
    is raised.
    """
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    wanted = tomllib.loads(text)
    changed = {name: keys for name, keys in changed.items() if keys}
    wanted |= {name: wanted.get(name, {}) | keys for name, keys in changed.items()}
    try:
        document = tomlkit.parse(text)
        for name, keys in changed.items():
            document.setdefault(name, tomlkit.table()).update(keys)
        edited = tomlkit.dumps(document)
        if tomllib.loads(edited) == wanted:
            return edited
    except (TOMLKitError, ValueError):
        pass
    lines = "; ".join(
        f"set in [{name}]: "
        + ", ".join(f"{key} = {json.dumps(value)}" for key, value in keys.items())
        for name, keys in changed.items()
    )
    raise InputError(f"{path}: cannot be edited by a program; {lines}")


def _replace(path: Path, before: str, after: str) -> None:
    """Write the file a link leads to, with its permissions. Raises InputError also if it has
    changed meanwhile.
    """
    target = path.resolve()
    with errors.writing(path):
        mode = target.stat().st_mode
        if files.read_text(target) != before:
            raise InputError(f"{path}: has changed meanwhile; repeat `tune save`")
        files.write_text_atomic(target, after)
        target.chmod(mode)


# Two sessions side by side: the gains of each on the plant and weather of each.

_WEATHER_KEYS = ("barometer_gain_um_per_pa", "temperature_gain_um_per_k")


def compared(a: SessionFolder, b: SessionFolder) -> str:
    """Return Markdown: the plants, the gains, and the prediction for each set of gains on each
    plant.

    Raises InputError if one of the sessions has no design yet.
    """
    for each in (a, b):
        each.require("design")
    files = [gains_file.load_gains(each.file("gains.toml")) for each in (a, b)]
    return "\n".join([*_plants(a, b, files), "", *_gains(files), "", *_crossed(a, b, files)])


def _plants(a: SessionFolder, b: SessionFolder, files: list[gains_file.GainsFile]) -> list[str]:
    head = (
        "| plant | k | +- | dead time s | lag s | delay +- s | leak µm/s | laser µm | least std "
        "µm |"
    )
    lines = [head, "|---" + "|---:" * 8 + "|"]
    for each, gains in zip((a, b), files, strict=True):
        plant = gains.plant
        lines.append(
            f"| {each.path.name} | {plant.gain:.3f} | {plant.gain_sigma:.3f} | "
            f"{plant.dead_time_s:.3f} "
            f"| {plant.lag_s:.3f} | {plant.delay_sigma_s:.3f} | {plant.leak_um_per_s:.2f} "
            f"| {session.disturbance_of(each).laser_um:.2f} | {gains.least_std_um:.3f} |"
        )
    return lines


def _gains(files: list[gains_file.GainsFile]) -> list[str]:
    """Table of the loop settings that differ."""
    left, right = (gains.loop.model_dump() for gains in files)
    lines = ["| setting | A | B |", "|---|---:|---:|"]
    lines += [
        f"| {name} | {left[name]} | {right[name]} |" for name in left if left[name] != right[name]
    ]
    return lines


def _crossed(a: SessionFolder, b: SessionFolder, files: list[gains_file.GainsFile]) -> list[str]:
    head = "| gains of | on plant and weather of | std µm | / least | Ms | load peak µm |"
    lines = [head, "|---|---" + "|---:" * 4 + "|"]
    for place, each in (("A", a), ("B", b)):
        found, weather = session.found_of(each), session.disturbance_of(each)
        own = files[0 if place == "A" else 1].loop
        for name, gains in zip("AB", files, strict=True):
            # the weather gains belong to the bench, not to the design
            loop = schema.LoopConfig.model_validate(
                gains.loop.model_dump() | {key: getattr(own, key) for key in _WEATHER_KEYS}
            )
            row = design.candidate(
                name, Gains.of(loop), found.identified.model, weather, loop, candidates.Demands()
            )
            std = (
                f"{row.predicted.std_um:.3f} | {row.ratio:.2f}"
                if row.predicted is not None
                else "unstable | "
            )
            lines.append(
                f"| {name} | {place} | {std} | {row.margins.ms:.2f} | {row.load_peak_um:.2f} |"
            )
    return lines
