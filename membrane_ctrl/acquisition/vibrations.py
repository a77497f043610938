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
_HEARD_SCHEMA = "membrane-vibrations/1"
_FILE_BYTES_MAX = 1 << 20  # usually 10 kB


def make_vibration_handler(
    config: Config, clock: RunClock, run_dir: Path | None
) -> Callable[[ShapeEstimate], list[Event]]:
    """What takes the figures and tells the mirror's vibrations.

    It goes on where the run's last acquisition ended, or that of the newest earlier run with the
    same devices in the folder of runs: a film that moved meanwhile is told as well. What it has
    heard is kept in the run's folder.
    """
    known = None if run_dir is None else _read_earlier(config, run_dir)
    stethoscope = VibrationFollower(config.pump.stroke_hz, clock.origin_utc.timestamp(), known)

    def hear(estimate: ShapeEstimate) -> list[Event]:
        told = stethoscope.add_estimate(estimate)
        if told and run_dir is not None:
            with suppress(OSError):  # a full disk: the recorder says so
                heard = json.loads(encode_state(stethoscope.followed))
                table = {**file_origin(_HEARD_SCHEMA), "heard": heard}
                text = file_checksums.dumps_checked(table)
                files.write_text_atomic(run_dir / _VIBRATIONS_FILE, text + "\n")
        return told

    return hear


def _read_earlier(config: Config, run_dir: Path) -> FollowedModes | None:
    for path in sorted(run_dir.parent.glob(f"*/{_VIBRATIONS_FILE}"), reverse=True):
        run = path.parent
        if run.name > run_dir.name or _bench_name(run_config.read_config(run, [])) != _bench_name(
            config
        ):
            continue
        with suppress(OSError, ValueError, RecursionError):  # damaged: take an older one
            heard = _read_heard(path)
            # what another run has reported, this one has not
            return heard if run == run_dir else replace(heard, active_notices=[])
    return None


def _read_heard(path: Path) -> FollowedModes:
    """Read what an acquisition has heard. Raises OSError; ValueError for a damaged file."""
    table = plain_json.loads(files.read_text(path, _FILE_BYTES_MAX))
    if not isinstance(table, dict) or not file_checksums.take_checksum(table):
        raise ValueError(f"{path}: damaged")
    remove_origin(table, _HEARD_SCHEMA)
    return decode_state(json.dumps(table.get("heard")).encode(), FollowedModes, _FILE_BYTES_MAX)


def _bench_name(config: Config) -> str:
    return "" if config.devices is None else config.devices.name
