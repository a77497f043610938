"""Finds the mirror's vibrations in its figures, and keeps them in the run's folder."""

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.metrology.vibrations.mode_follower import FollowedModes, VibrationFollower
from membrane_ctrl.model import file_checksums, files, plain_json
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.program import file_origin, remove_origin
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import decode_state, encode_state
from membrane_ctrl.run_files import run_config

_VIBRATIONS_FILE = "vibrations.json"  # in the run's folder
_SCHEMA = "membrane-vibrations/1"
_MODES_KEY = "modes"  # of the modes in the file
_FILE_BYTES_MAX = 1 << 20  # usually 10 kB


def make_vibration_handler(
    config: Config, clock: RunClock, run_dir: Path | None
) -> Callable[[ShapeEstimate], list[Event]]:
    """Make the function that gets each figure and returns the events of the mirror's vibrations.

    The modes continue from the run's last acquisition, or from the newest earlier run with the same
    devices in the folder of runs: a film that moved in between is reported, too.

    Parameters
    ----------
    config : Config
    clock : RunClock
    run_dir : path or None
        Where they are stored; None: nowhere.
    """
    known = None
    if run_dir is not None:
        known = _read_earlier(config, run_dir)
    follower = VibrationFollower(config.pump.stroke_hz, clock.origin_utc.timestamp(), known)

    def follow_vibrations(estimate: ShapeEstimate) -> list[Event]:
        new_events = follower.add_estimate(estimate)
        if new_events and run_dir is not None:
            with suppress(OSError):  # a full disk: the recorder reports it
                _write_followed(run_dir / _VIBRATIONS_FILE, follower.followed)
        return new_events

    return follow_vibrations


def _write_followed(path: Path, followed: FollowedModes) -> None:
    """Store the followed modes. Raises OSError."""
    modes = json.loads(encode_state(followed))
    text = file_checksums.dumps_checked({**file_origin(_SCHEMA), _MODES_KEY: modes})
    files.write_text_atomic(path, text + "\n")


def _read_earlier(config: Config, run_dir: Path) -> FollowedModes | None:
    """The modes of this run, or of the newest earlier one with the same devices."""
    for path in sorted(run_dir.parent.glob(f"*/{_VIBRATIONS_FILE}"), reverse=True):
        run = path.parent
        if run.name > run_dir.name:
            continue
        if _bench_name(run_config.read_config(run, [])) != _bench_name(config):
            continue
        with suppress(OSError, ValueError, RecursionError):  # damaged: read an older one
            followed = _read_followed(path)
            if run != run_dir:  # its notices are not those of this run
                followed = replace(followed, active_notices=[])
            return followed
    return None


def _read_followed(path: Path) -> FollowedModes:
    """Read the modes that an acquisition followed. Raises OSError; ValueError if damaged."""
    table = plain_json.loads(files.read_text(path, _FILE_BYTES_MAX))
    if not isinstance(table, dict) or not file_checksums.pop_checksum(table):
        raise ValueError(f"{path}: damaged")
    remove_origin(table, _SCHEMA)
    return decode_state(json.dumps(table.get(_MODES_KEY)).encode(), FollowedModes, _FILE_BYTES_MAX)


def _bench_name(config: Config) -> str:
    if config.devices is None:
        return ""
    return config.devices.name
