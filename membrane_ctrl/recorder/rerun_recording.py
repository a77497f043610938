"""The Rerun file of a run: segments, time axes, statics, and a flush that reports a dead writer.

Rerun facts behind this module (0.41, all reproduced): on a full disk `log` and `send_columns`
continue silently, only `flush` raises; `save` on a healthy stream starts a new file at once and
loses no row; statics and properties must be sent again after each `save`, as must the blueprint,
but sending one leaks 3 MB (0.5 GB in a week of hourly segments): it goes into the first file, and
into the others when they are optimised (`segment_optimizer`); segments with the same recording id
are one recording in the viewer. If the writer dies between taking a flush and answering it, `flush`
times out, and then `save`, `disconnect`, the stream's destructor and Rerun's own exit handler wait
forever: such a stream is kept untouched, and the process must end without exit handlers.
"""

import contextlib
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from rerun.chunk import RrdReader

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.files import sync_data
from membrane_ctrl.model.program import file_origin
from membrane_ctrl.model.zernike_terms import NOLL_INDICES, ZERNIKE_TERMS
from membrane_ctrl.recorder.blueprint import run_blueprint
from membrane_ctrl.recorder.state_lanes import LANES
from membrane_ctrl.run_files import plot_marks, shapes, streams
from membrane_ctrl.run_files.stream import Stream

APPLICATION = "membrane_ctrl"
RUN_TIME = "run_time"
UTC = "utc"
OUTSIDE_CLASS = 1
LAYOUT = ".layout.rbl"  # the blueprint's own file, during the recording

# A disk that needs longer than this for a second of data (tens of kB) is treated as lost.
_FLUSH_TIMEOUT_S = 5.0

# Held by the module, so that no destructor runs.
_abandoned: list[rr.RecordingStream] = []


class RecordingError(Exception):
    """The writer behind the Rerun stream is dead or did not start; the message is Rerun's."""


class Recording:
    """One Rerun recording in segments `<name>-000.rrd`, `-001.rrd`, ...

    The folder's name is the recording's id, so that all segments are one recording. `first_segment`
    is not 0 if an earlier recorder started the run.
    """

    def __init__(
        self, run_dir: Path, run_name: str, clock: RunClock, config: Config, first_segment: int = 0
    ) -> None:
        self._run_dir = run_dir
        self._run_name = run_name
        self._origin = np.datetime64(clock.origin_utc.replace(tzinfo=None), "ns")
        self._config = config
        self._stream = self._new_stream()
        self.stuck = False  # a stream was abandoned: Rerun's exit handler may wait for it forever
        self.path: Path | None = None  # the present file
        self.segments = first_segment  # number of the next file
        self._laid_out = False

    def next_segment(self) -> None:
        """Close the present file and start a new one. Raises RecordingError;
        then call again later.
        """
        path = self._run_dir / f"{self._run_name}-{self.segments:03d}.rrd"
        try:
            self._stream.save(path)
            self._lay_out()
            self._send_statics()
            self._stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except (RuntimeError, OSError) as error:
            path.unlink(missing_ok=True)
            self._replace_stream()
            raise RecordingError(f"{path}: {error}") from None
        self.path = path
        self.segments += 1

    def _new_stream(self) -> rr.RecordingStream:
        return rr.RecordingStream(APPLICATION, recording_id=self._run_dir.name)

    def _replace_stream(self) -> None:
        """Continue with another stream and never touch the old one
        again (see the module's facts).
        """
        _abandoned.append(self._stream)
        self.stuck = True
        self._stream = self._new_stream()
        self.path = None

    def _lay_out(self) -> None:
        """Send the blueprint with the first segment, and write its own file."""
        if self._laid_out:
            return
        self._laid_out = True  # even on failure: a full disk is retried every few seconds
        blueprint = run_blueprint(self._config)
        self._stream.send_blueprint(blueprint)
        blueprint.save(APPLICATION, str(self._run_dir / LAYOUT))

    def _send_statics(self) -> None:
        """Send what holds for the whole run: names, colours, lanes, masks of maps."""
        stream = self._stream
        # Which run this is, and which program wrote it.
        stream.send_recording_name(self._run_dir.name)
        origin: dict[str, Any] = {"name": self._run_name, "started_utc": str(self._origin)}
        origin |= file_origin("membrane-recording/1")
        stream.send_property("run", rr.AnyValues(**origin))
        # Names, colours and widths of the lines of each stream.
        for block in (
            *streams.STREAMS,
            *streams.DERIVED,
            *streams.SHAPE_STREAMS,
            streams.VIBRATIONS,
        ):
            stream.log(block.path, _style_lines(rr.SeriesLines, block), static=True)
        for block in (
            streams.make_band(self._config.limits.band_um),
            streams.CHANGE,
            streams.SAG,
            streams.FOCUS,
            streams.FIGURE_RMS,
            streams.PUMP,
        ):
            stream.log(block.path, _style_lines(rr.Measurements.from_fields, block), static=True)
        for block in plot_marks.MARKS:  # the average of the lines in a pixel would be none
            stream.log(
                block.path,
                _style_lines(rr.SeriesLines, block, aggregation_policy="Off"),
                static=True,
            )
        # The bars of the Zernike coefficients are counted by their Noll index.
        bars = rr.BarChart(
            np.zeros(ZERNIKE_TERMS - 1), abscissa=NOLL_INDICES[1:]
        ).as_component_batches()
        abscissa = [
            part for part in bars if part.component_descriptor().component == "BarChart:abscissa"
        ]
        stream.log(shapes.BARS_PATH, abscissa, static=True)
        # The words of each lane of states, with their colours.
        for lane in LANES:
            words = list(lane.colours)
            colours = np.array([lane.colours[word] for word in words], dtype=np.uint32)
            stream.log(
                lane.path,
                rr.StateConfiguration(values=words, labels=words, colors=colours),
                static=True,
            )
        stream.log(
            "/shape",
            rr.AnnotationContext([(0, "", (0, 0, 0, 0)), (OUTSIDE_CLASS, "", (24, 24, 24, 255))]),
            static=True,
        )
        # Maps are square; a mask greys what lies outside of the mirror's disc.
        outside = rr.SegmentationImage(
            shapes.outside_disc() * OUTSIDE_CLASS, opacity=1.0, draw_order=1.0
        )
        for kind in shapes.MAPS:
            stream.log(f"/shape/map/{kind}/outside", outside, static=True)

    def send_columns(
        self, path: str, time_s: FloatArray, columns: Iterable[rr.ComponentColumn]
    ) -> None:
        """Send rows of one entity.

        Parameters
        ----------
        path : str
            Of the entity.
        time_s : (n,) array
            Times of the run.
        columns : iterable of ComponentColumn
            As Rerun's archetypes make them, each of n rows.
        """
        nanoseconds = np.round(time_s * 1e9).astype("timedelta64[ns]")
        indexes = [
            rr.TimeColumn(RUN_TIME, duration=nanoseconds),
            rr.TimeColumn(UTC, timestamp=self._origin + nanoseconds),
        ]
        self._stream.send_columns(path, indexes=indexes, columns=columns)

    def send_scalars(self, path: str, time_s: FloatArray, values: FloatArray) -> None:
        """Send values of one entity.

        Parameters
        ----------
        path : str
            Of the entity.
        time_s : (n,) array
            Times of the run.
        values : (n, m) array
            A column for each line of the plot; NaN interrupts a line.
        """
        self.send_columns(path, time_s, rr.Scalars.columns(scalars=values))

    def send_measurements(
        self, path: str, time_s: FloatArray, values: FloatArray, variances: FloatArray
    ) -> None:
        """Send values of one entity with their variances.

        Parameters
        ----------
        path : str
            Of the entity.
        time_s : (n,) array
            Times of the run.
        values, variances : (n, m) arrays
            A column for each line of the plot; the variances are those of the values, in their unit
            squared.
        """
        self.send_columns(path, time_s, rr.Measurements.columns(values=values, variances=variances))

    def log_component(self, path: str, time_s: float, archetype: rr.AsComponents) -> None:
        """Send one component at one time of the run.

        Parameters
        ----------
        path : str
            Of the entity, such as `/events`.
        time_s : float
            Time of the run; UTC follows from it and the start.
        archetype : rr.AsComponents
            What Rerun shows there, such as a picture or a text.
        """
        nanoseconds = np.timedelta64(round(time_s * 1e9), "ns")
        self._stream.set_time(RUN_TIME, duration=nanoseconds)
        self._stream.set_time(UTC, timestamp=self._origin + nanoseconds)
        self._stream.log(path, archetype)

    def send_page(self, path: str, time_s: float, markdown: str) -> None:
        """Send a page of text at one time of the run.

        Parameters
        ----------
        path : str
            Of the entity; a later page at the same path replaces it in the viewer.
        time_s : float
            Time of the run.
        markdown : str
            The page.
        """
        self.log_component(path, time_s, rr.TextDocument(markdown, media_type="text/markdown"))

    def lay_out_again(self) -> None:
        """Send the blueprint with the next segment, which is now the first in the folder."""
        self._laid_out = False

    def flush(self) -> None:
        """Write everything sent to the file. Raises RecordingError if the writer has died since the
        last call.
        """
        try:
            self._stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except (RuntimeError, OSError) as error:
            self._replace_stream()
            raise RecordingError(str(error)) from None

    def pause(self) -> None:
        """Close the file without a new one; `next_segment` continues. Raises RecordingError as
        `close`.
        """
        self.close()
        self._stream = self._new_stream()

    def sync(self) -> None:
        """Sync flushed data to disk, which Rerun never does. Raises OSError."""
        if self.path is not None:
            sync_data(self.path)

    def close(self) -> None:
        """Write the footer and close the file.

        Raises RecordingError if the file has no footer: it then opens slowly, and may lack its last
        second.
        """
        self.flush()
        self._stream.disconnect()
        path, self.path = self.path, None
        if path is not None and not is_whole(path):
            raise RecordingError(
                f"{path}: closed without its footer, so it opens slowly; "
                "`membrane-ctrl review` makes a whole recording from the tables"
            )


def is_whole(path: Path) -> bool:
    """Whether a closed file has its footer, which `disconnect` does not report."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the reader warns if there is none
        try:
            with _panics_are_errors():
                RrdReader(path).store()
        except (RuntimeError, ValueError, OSError):
            return False
    return True


@contextlib.contextmanager
def _panics_are_errors() -> Iterator[None]:
    """Turn a panic in Rerun's code, which is not an `Exception` in Python,
    into a `RuntimeError`.
    """
    try:
        yield
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise RuntimeError(f"Rerun failed on it ({str(error)[:80]})") from None


def _style_lines(
    archetype: Callable[..., rr.AsComponents], stream: Stream, **more: object
) -> rr.AsComponents:
    """Names, colours and widths of a stream's lines."""
    names, colours, widths = zip(
        *((line.name, line.colour, line.width) for line in stream.lines), strict=True
    )
    return archetype(names=names, colors=colours, widths=widths, **more)
