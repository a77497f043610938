"""Which runs the service follows: the newest published one of a folder, if it has alarms."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

from membrane_ctrl.alarms.sent_log import LOG_NAME
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.processes import published_rings
from membrane_ctrl.run_files.run_config import read_config
from membrane_ctrl.run_files.run_lookup import is_run_name

_NEWS_AGE_MAX_S = 86_400.0  # an older end is no news
_RINGS = "rings.json"


def find_published_run(logs: Path) -> Path | None:
    """Return the newest run of a folder that has published its rings; None without one."""
    with suppress(OSError):
        for folder in sorted(logs.iterdir(), reverse=True):
            if is_run_name(folder.name) and (folder / _RINGS).exists():
                return folder
    return None


def read_alarms_config(folder: Path) -> AlarmsConfig | None:
    """Return the alarms of a run; None if none are to be sent: it names no addresses, or its end is
    no news.
    """
    alarms = read_config(folder, []).alarms
    if alarms.urls_file is None:
        return None
    with suppress(OSError):
        if published_rings.is_control_alive(folder):
            return alarms
    return alarms if _is_news(folder) else None


def _is_news(folder: Path) -> bool:
    """Whether a run without a control process has recorded something in the last day."""
    with suppress(OSError):
        age_s = time.time() - (folder / "events.jsonl").stat().st_mtime
        return age_s < _NEWS_AGE_MAX_S and (folder / LOG_NAME).exists()
    return False
