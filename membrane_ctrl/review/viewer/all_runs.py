"""All runs of a folder in one viewer: a Rerun catalogue with a row per run, served to this machine only.

The rows come first, from the runs' small files; each run's timeline follows in the background, newest first.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import rerun as rr
from rerun.blueprint.table import Column, SortBy, TableBlueprint, TableLayout
from rerun_bindings import CatalogClientInternal

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import errors
from membrane_ctrl.review import catalogue
from membrane_ctrl.review.viewer.blueprints import COARSE_TABS, ReviewBlueprint
from membrane_ctrl.review.viewer.layer import APPLICATION, Layer
from membrane_ctrl.run_files.run import open_run

_DATASET = "runs"
# Property of a recording to its heading; the properties are an interface (docs/interfaces.md).
PROPERTIES = {
    "started_utc": "started, UTC",
    "duration_s": "length, s",
    "held_s": "held, s",
    "std_um": "std, µm",
    "in_band": "in band",
    "faults": "faults",
    "faults_share": "time in faults",
    "kp_per_s": "Kp, 1/s",
    "ti_s": "Ti, s",
    "pump_scale": "pump / curve",
    "pump_sigma": "±",
    "geometry": "geometry",
    "configuration": "configuration",
    "exit": "end",
    "marks": "marks",
}


class RunCatalogue:
    """A catalogue server, until closed.

    Parameters
    ----------
    entries : sequence of RunEntry
        The runs, at least one.
    folder : Path
        Empty folder for its files, to be deleted afterwards.
    """

    def __init__(self, entries: Sequence[catalogue.RunEntry], folder: Path) -> None:
        self._folder = folder
        self._entries = entries
        rows = [_row(entry, folder / f"row-{number}.rrd") for number, entry in enumerate(entries)]
        self._server = rr.server.Server(host="127.0.0.1", datasets={_DATASET: rows})
        # the public client would need datafusion, which takes 115 MB
        self._dataset = rr.catalog.DatasetEntry(
            CatalogClientInternal(self._server.url()).datasets(include_hidden=False)[0]
        )
        self._lay_out()
        self.url = self._server.url()  # for clients
        self.page = f"{self.url}/entry/{self._dataset.id}"  # its table, for the viewer

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()

    def add_timelines(self, wanted: Callable[[], bool]) -> None:
        """Add the runs' timelines, newest first, while `wanted`; a run that has none is named on stderr."""
        for number, entry in reversed(list(enumerate(self._entries))):
            if not wanted():
                return
            try:
                self._add_timeline(entry, self._folder / f"timeline-{number}.rrd")
            except (errors.CommandError, OSError) as error:
                print(f"note: {entry.name}: no timeline ({error})", file=sys.stderr)

    def _add_timeline(self, entry: catalogue.RunEntry, file: Path) -> None:
        layer = Layer(file, entry.name, overview_only=True)
        try:
            layer.add(open_run(entry.folder))
        finally:
            layer.close()
        self._dataset.register([file.as_uri()], layer_name="timeline").wait()

    def _lay_out(self) -> None:
        """One layout for the table, one for every run."""
        columns = [Column("recording link", name="run")]
        learned = any(entry.pump_scale == entry.pump_scale for entry in self._entries)
        shown = {name: words for name, words in PROPERTIES.items() if learned or not name.startswith("pump_")}
        columns += [Column(f"property:run:{name}", name=heading) for name, heading in shown.items()]
        hidden = [Column(f"property:RecordingInfo:{name}", visible=False) for name in ("name", "start_time")]
        started = SortBy("property:run:started_utc", direction="Descending")
        table = TableBlueprint(table_layout=TableLayout(columns=columns + hidden), sort_by=started)
        runs = ReviewBlueprint(("",), "utc", None, Config().limits.band_um).made(tabs=COARSE_TABS)
        table.save(APPLICATION, self._folder / "table.rbl")
        runs.save(APPLICATION, self._folder / "run.rbl")
        self._dataset.register_blueprint((self._folder / "table.rbl").as_uri(), segment_table=True)
        self._dataset.register_blueprint((self._folder / "run.rbl").as_uri())


def _row(entry: catalogue.RunEntry, file: Path) -> Path:
    """Write a recording that has only the run's properties; unknown ones are omitted."""
    values = catalogue.as_dict(entry) | {"started_utc": f"{entry.started_utc:%Y-%m-%d %H:%M:%S}"}
    values["geometry"] = entry.geometry[:8]
    values["faults_share"] = entry.faults_s / entry.duration_s if entry.duration_s else float("nan")
    # more digits would make the table's columns too wide to compare
    values |= {name: float(f"{value:.4g}") for name, value in values.items() if isinstance(value, float)}
    known = {name: values[name] for name in PROPERTIES if values[name] == values[name] and values[name] != ""}
    stream = rr.RecordingStream(APPLICATION, recording_id=entry.name)
    stream.save(file)
    stream.send_recording_name(entry.name)
    stream.send_property("run", rr.AnyValues(**known))
    stream.disconnect()
    return file
