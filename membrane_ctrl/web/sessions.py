"""Tuning sessions on the page: the newest one's progress, what it has found, and how to choose."""

from pathlib import Path

from nicegui import ui

from membrane_ctrl.model import errors
from membrane_ctrl.sessions import folder as folders
from membrane_ctrl.sessions.live_log import LiveReader

_LOOK_S = 1.0


def tuning_panel(logs: Path) -> None:
    """Fill the tab."""
    head = ui.label("No tuning session in this folder.").classes("text-subtitle1")
    steps = ui.row()
    said = ui.log(max_lines=200).classes("w-full h-64")
    known: dict[str, object] = {"path": None, "reader": None, "said": 0, "step": ""}

    def look() -> None:
        newest = _newest(logs)
        if newest is None:
            return
        if known["path"] != newest.path:
            known.update(path=newest.path, reader=LiveReader(newest.path), said=0)
            said.clear()
        reader = known["reader"]
        assert isinstance(reader, LiveReader)
        reader.read()
        progress = reader.progress
        done = {step for step in folders.STEPS if newest.done(step)}
        head.set_text(
            f"{newest.path.name}: {progress.step or 'begun'}"
            + (f", asks on its terminal: {progress.asks}" if progress.asks else "")
            + (f", ended: {progress.ended}" if progress.ended else "")
        )
        for line in progress.said[int(str(known["said"])) :]:
            said.push(line)
        known["said"] = len(progress.said)
        shown = f"{progress.step} {sorted(done)}"
        if shown != known["step"]:
            known["step"] = shown
            steps.clear()
            with steps:
                for step in folders.STEPS:
                    colour = "positive" if step in done else "info" if step == progress.step else "grey"
                    ui.badge(step, color=colour)

    ui.timer(_LOOK_S, look)


def _newest(logs: Path) -> folders.SessionFolder | None:
    try:
        return folders.newest_session(logs)
    except (errors.CommandError, OSError):
        return None
