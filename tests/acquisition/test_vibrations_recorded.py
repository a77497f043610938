"""What a hold records of the mirror's vibrations, from its figures on: events, report, alarms,
timeline, `modes`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.acquisition.vibrations import make_vibration_handler
from membrane_ctrl.alarms.book import AlarmMessage
from membrane_ctrl.alarms.outbox import Outbox
from membrane_ctrl.alarms.watcher import Watcher
from membrane_ctrl.cli import run as command_line
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.tick_codec import MESSAGE_BYTES
from membrane_ctrl.hold.supervisor import Supervisor, Wiring
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.metrology.phase import pattern_sequence
from membrane_ctrl.metrology.tracking.live_tracker import LiveTracker
from membrane_ctrl.model import event_lines, run_events
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.program import program_identity, stated_program
from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate
from membrane_ctrl.model.telemetry import FIELDS, TelemetryRow
from membrane_ctrl.processes.ring import RingReader, RingWriter, open_ring
from membrane_ctrl.recorder.recorder import Recorder
from membrane_ctrl.recorder.rerun_recording import Recording
from membrane_ctrl.run_files.run_folder import create_run_folder
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.drum_modes import drum_modes
from tests.metrology.tracking.test_track_live import FILM, OPTICS, held_um
from tests.support.rrd_reading import reader, scalars, strings
from tests.worlds.synthetic_run import STARTED_UTC, message_of, rows_of, shape_of
from tests.worlds.vibrating_mirror import watched

DAY_S = 86400.0
FEWER_HZ = (12.0, 12 / 1.09, 12 / 1.17)
ROW = TelemetryRow(*(0.0 for _ in FIELDS)).pack()
TICKS = rows_of(12.0)[300:]  # six seconds of hold
CONFIG = Config.model_validate(
    {"shape": {"mode": "track"}, "devices": {"board": "tcp://127.0.0.1:5020"}}
)
PUMPED = CONFIG.model_copy(update={"pump": CONFIG.pump.model_copy(update={"stroke_hz": 48.1})})


class HandClock(RunClock):
    """A clock moved by hand."""

    moment_s = 0.0

    def now(self) -> float:
        return HandClock.moment_s


class Hold:
    """A run of a hold that begins on some day of the week, without its processes and its ticks in
    between.
    """

    def __init__(self, logs: Path, day: float, stack: ExitStack, config: Config = CONFIG) -> None:
        self.clock = HandClock(0.0, STARTED_UTC + timedelta(days=day))
        self.config = config
        self.folder = create_run_folder(logs, "week", self.clock.origin_utc, config)
        sizes = {"inputs": (600, MESSAGE_BYTES), "events": (64, 8192), "shapes": (64, 1 << 16)}
        addresses = {name: stack.enter_context(open_ring(*size)) for name, size in sizes.items()}
        self.rings = {name: RingWriter(address) for name, address in addresses.items()}
        readers = {name: RingReader(address) for name, address in addresses.items()}
        self.events = RingReader(addresses["events"])
        for end in (*self.rings.values(), *readers.values(), self.events):
            stack.callback(end.close)
        recording = Recording(self.folder, "week", self.clock, config)
        self.troubles: list[str] = []
        self.recorder = Recorder(
            self.folder,
            self.clock,
            config,
            readers,
            recording,
            None,
            lambda event: self.troubles.append(event.kind),
        )
        self.supervisor = Supervisor(
            Controller(config, zernike_projection()),
            Wiring(None, events=self.rings["events"]),
            self.clock,
            50.0,
        )
        self.alarms: list[AlarmMessage] = []
        self.taken = 0
        HandClock.moment_s = 0.0
        self.watcher = Watcher(AlarmsConfig(), [Outbox(self._sent)], 0.0)
        self.restart_acquisition()

    def _sent(self, notice: AlarmMessage) -> bool:
        self.alarms.append(notice)
        return True

    def restart_acquisition(self) -> None:
        self.hear = make_vibration_handler(self.config, self.clock, self.folder)

    def ticks(self, at_s: float) -> None:
        """Six seconds of telemetry."""
        for row in TICKS:
            moved = replace(row, mono_s=row.mono_s + at_s, tick=row.tick + round(50 * at_s))
            self.rings["inputs"].put(message_of(moved))
        self.settle(at_s + 12.0)

    def take(self, estimate: ShapeEstimate) -> None:
        """As the acquisition publishes a figure, and the supervisor what the acquisition sends."""
        HandClock.moment_s = estimate.time_s
        self.rings["shapes"].put(pack_estimate(estimate))
        for event in self.hear(estimate):
            self.supervisor.record_event(event_lines.from_dict(event.to_dict()))
        self.taken += 1
        if self.taken % 50 == 0:
            self.recorder.drain_rings()

    def settle(self, now_s: float) -> None:
        """The recorder writes, and the alarms look."""
        HandClock.moment_s = now_s
        self.recorder.drain_rings()
        self.recorder.write_second()
        self.watcher.process_news([ROW], self.events.drain(), now_s)

    def end(self) -> None:
        self.supervisor.record_event(run_events.Ended("done", 0, len(TICKS), 0))
        self.recorder.drain_rings()
        self.recorder.finish(in_haste=True)
        self.watcher.process_news([ROW], self.events.drain(), HandClock.moment_s)
        assert set(self.troubles) <= {"recorder_done"}

    @property
    def maintenance_events(self) -> list[dict[str, Any]]:
        """Maintenance notices and their ends in `events.jsonl`."""
        lines = map(json.loads, (self.folder / "events.jsonl").read_text().splitlines())
        return [line for line in lines if line["kind"].startswith("maintenance")]

    def alarmed(self, name: str) -> list[str]:
        return [
            notice.text
            for notice in self.alarms
            if (notice.name, notice.kind) == (f"maintenance_{name}", "raised")
        ]

    def timeline(self) -> tuple[np.ndarray, np.ndarray, list[str]]:
        """Times and frequencies of the plot, and the sentences, in all segments."""
        paths = sorted(self.folder.glob("*.rrd"))
        plots = [scalars(path, "/shape/vibrations") for path in paths]
        assert "SeriesLines:names" in components(paths[0], "/shape/vibrations")
        plots = [plot for plot in plots if plot[0].size]
        words = [text for path in paths for _, text in strings(path, "/events", "TextLog:text")]
        return (
            np.concatenate([t for t, _ in plots]),
            np.concatenate([values for _, values in plots]),
            words,
        )


def components(path: Path, entity: str) -> set[str]:
    """Names of what an entity has."""
    chunks = reader(path).stream().filter(content=entity)
    return {name for chunk in chunks for name in chunk.to_record_batch().schema.names}


def report_of(folder: Path, capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    """Maintenance notices in the report."""
    capsys.readouterr()
    assert command_line(["report", str(folder), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    return [line for line in table["timeline"] if line["kind"].startswith("maintenance")]


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as found:
        yield found


def minutes(hold: Hold, at_s: float, count: int, line_hz: float) -> None:
    """Minutes of figures of a film with one vibration."""
    hold.ticks(at_s)
    time_s, terms_um, _ = watched(5, (line_hz,), FEWER_HZ, seconds=62.0, amplitude_nm=20.0)
    base = shape_of(0.0, 0)
    for minute in range(count):
        for k, (t, terms) in enumerate(zip(time_s - time_s[0], terms_um, strict=True)):
            time = round(at_s + 20.0 + 65.0 * minute + t, 6)
            coeffs_um = np.round(base.coeffs_um + terms, 3)
            hold.take(replace(base, kind="track", time_s=time, coeffs_um=coeffs_um, cycle=k))
        hold.settle(HandClock.moment_s + 0.1)


def test_a_shift_over_a_restart_of_the_hold_is_reported_everywhere(
    tmp_path: Path, stack: ExitStack, capsys: pytest.CaptureFixture[str], undrawn: None
) -> None:
    """Five minutes of one run, and of the next, a week later."""
    first = Hold(tmp_path, 0.0, stack, PUMPED)
    minutes(first, 0.0, 3, 48.0)
    first.restart_acquisition()
    minutes(first, 400.0, 2, 48.0)
    first.end()
    kept = json.loads((first.folder / "vibrations.json").read_text())
    assert kept["schema"] == "membrane-vibrations/1"
    assert stated_program(kept) == program_identity()
    assert [(line["kind"], line["name"]) for line in first.maintenance_events] == [
        ("maintenance", "pump_resonance")
    ]
    (driven,) = first.alarmed("pump_resonance")
    assert "the pump's strokes, 48.1 Hz, drive the mirror's vibration at 48." in driven
    (reported,) = report_of(first.folder, capsys)
    assert driven == f"Maintenance pump_resonance: {reported['message']}"
    second = Hold(tmp_path, 7.0, stack)
    minutes(second, 0.0, 3, 48.0 * 1.01)
    second.end()
    (moved,) = second.maintenance_events
    assert (moved["kind"], moved["name"]) == ("maintenance", "film_tension")
    assert (
        "moved by +1.0% within 168 h: the film's tension by +2.0%; check clamping"
        in moved["message"]
    )
    assert second.alarmed("film_tension") == [f"Maintenance film_tension: {moved['message']}"]
    assert [line["message"] for line in report_of(second.folder, capsys)] == [moved["message"]]
    before, after = (hold.timeline() for hold in (first, second))
    assert (len(before[0]), len(after[0])) == (5, 3)
    assert np.nanmedian(after[1]) / np.nanmedian(before[1]) == pytest.approx(1.01, abs=5e-4)
    assert any("Maintenance film_tension: the mirror's vibration" in text for text in after[2])
    assert not any("film_tension" in text for text in before[2])


class Film:
    """The twin's film as a hold moves it, and what a hold that tracks makes of its pictures."""

    def __init__(self) -> None:
        camera = OPTICS.camera.model_copy(update={"bits": 12, "noise_adu": 1.0})
        self.optics = OPTICS.model_copy(update={"camera": camera})
        self.tracker = LiveTracker(self.optics, LiveReconstructor(self.optics, 1), 32, step_s=10.0)
        self.moved_um = held_um(190.0)

    def watch(self, hold: Hold, at_s: float, searches: int, change: float) -> None:
        """Minutes of a film whose vibrations have changed their frequencies."""
        modes = tuple(
            replace(mode, amplitude_nm=20.0, frequency_hz=mode.frequency_hz * (1 + change))
            for mode in drum_modes(1.0)
        )
        renderer = OpticsRenderer(self.optics, FILM, seed=3, modes=modes)
        hold.ticks(at_s)
        still = [
            renderer.render_picture(p, float(self.moved_um[0]))
            for p in pattern_sequence.full_sequence(self.optics.pattern)
        ]
        full = self.tracker.measure_full(
            still, at_s + 13.0 + 0.1 * np.arange(18), np.full(18, np.nan)
        )
        assert full.verdict == "ok", full.reason
        hold.take(full)
        since_s = 2.0
        while since_s < 61.0 * searches + 3.0:
            time_s, um = at_s + 13.0 + since_s, float(self.moved_um[round(50 * since_s)])
            picture = renderer.render_picture(self.tracker.pattern, um, time_s=time_s)
            hold.take(
                self.tracker.measure_fringes([picture], np.array([time_s]), np.array([np.nan]))
            )
            since_s += self.tracker.interval_factor / 20
        hold.settle(HandClock.moment_s + 0.1)


MINUTES = (3, 2, 1, 1, 1, 1, 2, 3)  # of each day


@pytest.mark.campaign
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("change", [0.01, -0.01, 0.003, 0.0])
def test_a_shift_of_a_per_cent_within_a_week_of_pictures_is_reported_everywhere(
    change: float,
    tmp_path: Path,
    stack: ExitStack,
    capsys: pytest.CaptureFixture[str],
    undrawn: None,
) -> None:
    """All of a drum's modes move by it within a week; on day 4 the acquisition restarts."""
    hold, film = Hold(tmp_path, 0.0, stack), Film()
    for day, searches in enumerate(MINUTES):
        if day == 4:
            hold.restart_acquisition()
        film.watch(hold, day * DAY_S, searches, change * day / 7)
    hold.end()
    capsys.readouterr()
    assert command_line(["modes", str(hold.folder), "--no-pictures"]) == 0
    message = capsys.readouterr().out
    assert command_line(["modes", str(hold.folder), "--no-pictures", "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    reported = report_of(hold.folder, capsys)
    time_s, frequencies_hz, words = hold.timeline()
    moves = [mode["moved"] for mode in table["modes"]]
    first, last = (np.sort(row[np.isfinite(row)]) for row in frequencies_hz[[0, -1]])
    assert table["searches"] == len(time_s) == sum(MINUTES)
    assert time_s[-1] - time_s[0] == pytest.approx(7 * DAY_S, abs=300)
    assert [mode["searches"] for mode in table["modes"]] == [sum(MINUTES)] * 4
    assert moves == pytest.approx([change] * 4, abs=3e-4)
    assert last / first == pytest.approx(np.full(4, 1 + change), abs=5e-4)
    if abs(change) < 0.01:
        assert hold.maintenance_events == hold.alarmed("film_tension") == reported == []
        assert "moved" not in message
        assert not any("Maintenance" in text for text in words)
        return
    assert message.count(f"it moved by {change:+.1%}: the film's tension by {2 * change:+.1%}") == 4
    (maintenance,) = hold.maintenance_events
    assert (maintenance["kind"], maintenance["name"]) == ("maintenance", "film_tension")
    # the first five searches end on day 1, and their median is of day 0
    assert (
        f"moved by {change:+.1%} within 144 h: the film's tension by {2 * change:+.1%}"
        in maintenance["message"]
    )
    assert maintenance["mono_s"] > 7 * DAY_S
    assert (
        hold.alarmed("film_tension")
        == [line["message"] for line in reported]
        == [maintenance["message"]]
    )
    assert any(maintenance["message"] in text for text in words)
