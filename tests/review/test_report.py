"""The report: its figures against known inputs, its page, comparisons."""

from __future__ import annotations

import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape

from membrane_ctrl.cli import run as command
from membrane_ctrl.model import plain_json
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.telemetry import (
    COLUMN,
    SETTLED_AFTER_S,
    ShapeState,
    State,
    get_column,
    get_columns,
)
from membrane_ctrl.review import open_run
from membrane_ctrl.review.report.json import report_table
from membrane_ctrl.review.report.run_page import render_report
from membrane_ctrl.review.statistics.analysis import analyse_run
from membrane_ctrl.review.statistics.compare import compare_analyses
from membrane_ctrl.review.statistics.error_series import fill_short_gaps
from membrane_ctrl.review.statistics.without_feedforward import WithoutFeedforward
from membrane_ctrl.run_files.hold_parts import HoldParts
from tests.support.review_runs import same, written
from tests.worlds.nights import Planted, night, write_run

HOURS = 0.5


@pytest.fixture(scope="module")
def quiet_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("report"), HOURS)


def test_windows_are_those_of_the_ticks(quiet_run: Path) -> None:
    rows, _ = night(1, HOURS, "typical", [])
    time_s = get_column(rows, "mono_s")
    reading = (get_column(rows, "setpoint_um") - get_column(rows, "displacement_um"))[
        time_s >= time_s[0] + SETTLED_AFTER_S
    ]
    seconds = reading[np.floor(time_s[-reading.size :]) >= np.ceil(time_s[-reading.size])]
    means = seconds[: seconds.size // 10 * 10].reshape(-1, 10).mean(axis=1)
    analysis = analyse_run(open_run(quiet_run))
    assert analysis.reading is not None
    window = analysis.reading.windows[0]
    assert window.count == pytest.approx(means.size, abs=2)
    assert window.std_um == pytest.approx(means.std(), rel=0.01)
    assert window.p99_7_um == pytest.approx(np.quantile(np.abs(means), 0.997), rel=0.05)
    assert analysis.ticks.raw_reading.std == pytest.approx(reading.std(), rel=1e-4)
    assert analysis.ticks.histogram_counts.sum() == reading.size


def test_settled_is_five_seconds_of_hold_at_the_target() -> None:
    rows, _ = night(1, 0.02, "typical", [])
    rows[100:200, COLUMN["state"]] = State.SETTLE
    rows[400:450, COLUMN["setpoint_um"]] = 3.0  # a ramp
    hold_parts = HoldParts(2.0)
    mask = np.concatenate(
        [
            hold_parts.classify_block(get_columns(part))["held"]
            for part in np.split(rows, (150, 151, 430))
        ]
    )
    expected, unsettled_s = [], np.nan
    for time_s, state, setpoint_um in rows[
        :, [COLUMN[name] for name in ("mono_s", "state", "setpoint_um")]
    ]:
        if state != State.HOLD:
            unsettled_s = np.nan
        elif np.isnan(unsettled_s) or setpoint_um != 0.0:
            unsettled_s = time_s
        expected.append(time_s - unsettled_s >= SETTLED_AFTER_S)
    assert list(mask) == expected
    assert mask.any()


def held(
    disturbance: np.ndarray, feedforward: np.ndarray, kp: float, ti: float, period_s: float
) -> np.ndarray:
    """Error of a PI loop round an integrator that is disturbed, and helped by a feed-forward."""
    error, integral, position = np.zeros(disturbance.size), 0.0, 0.0
    for k in range(disturbance.size):
        error[k] = -position
        integral += kp / ti * error[k] * period_s
        position += (kp * error[k] + integral + feedforward[k] + disturbance[k]) * period_s
    return error


def test_the_benefit_of_the_feedforward_is_that_of_a_loop_without() -> None:
    rng = np.random.default_rng(2)
    disturbance = np.convolve(rng.normal(size=20_000), np.ones(50) / 50, "same")
    feedforward = -0.8 * disturbance
    with_it, without = (
        held(disturbance, ff, 0.61, 6.5, 0.02) for ff in (feedforward, 0 * feedforward)
    )
    kept = WithoutFeedforward(0.61, 6.5, 0.02)
    computed = with_it + np.concatenate(
        [kept.estimate_kept_away_um(part) for part in np.array_split(feedforward, 7)]
    )
    assert np.std(computed - without) < 0.03 * np.std(without)
    assert np.std(without) > 3 * np.std(with_it)


def test_the_report_needs_no_segment(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.05)
    before = plain_json.dumps(report_table(analyse_run(open_run(folder))))
    (folder / "night-000.rrd").write_bytes(b"no recording")
    assert plain_json.dumps(report_table(analyse_run(open_run(folder)))) == before
    (folder / "night-000.rrd").unlink()
    assert plain_json.dumps(report_table(analyse_run(open_run(folder)))) == before


def test_shape_figures(quiet_run: Path) -> None:
    shape = analyse_run(open_run(quiet_run)).shape
    assert shape is not None
    assert shape.cycles == HOURS * 900
    assert [round(pair.lag_s) for pair in shape.pairs] == [60, 600]
    # 20 nm of noise in each of 36 terms, twice: sqrt(2) 20 nm sqrt(36) over the disc, less inside
    # the rim
    for pair in shape.pairs:
        assert 0.05 < pair.mean_sigma_um < 0.25
        assert pair.pairs > 50
    assert np.isnan(shape.sd_um[0, 0])
    assert shape.sd_um[64, 64] < shape.sd_um[64, 3]


def test_report_is_plain_json(quiet_run: Path) -> None:
    table = json.loads(plain_json.dumps(report_table(analyse_run(open_run(quiet_run)))))
    assert table["schema"] == "membrane-report/1"
    assert table["reading"]["windows"][0]["window_s"] == 1
    assert table["anomalies"] == []
    assert table["verdict"] == "good"
    assert table["timeline"][0]["kind"] == "start"


class Tags(HTMLParser):
    """Counts tags and finds what would be loaded from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.count: dict[str, int] = {}
        self.loaded: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1
        for name, value in attrs:
            if (
                name in {"src", "href", "xlink:href"}
                and value
                and not value.startswith(("#", "data:"))
            ):
                self.loaded.append(value)


def test_the_page_carries_everything_itself(tmp_path: Path) -> None:
    folder = written(tmp_path, HOURS, [Planted("pressure step", 900.5, 20.0)], name="a night")
    with (folder / "events.jsonl").open("a") as file:
        file.write(
            json.dumps(
                {"mono_s": 60.0, "kind": "command", "command": "mark", "text": "<b>knock</b>"}
            )
            + "\n"
        )
    tags = Tags()
    page = render_report(analyse_run(open_run(folder)))
    tags.feed(page)
    assert tags.count["svg"] >= 5
    assert tags.loaded == []
    assert "pressure step" in page
    assert str(escape("membrane-ctrl review 'a night' --from +")) in page
    assert "&lt;b&gt;knock&lt;/b&gt;" in page


@pytest.mark.usefixtures("undrawn")
def test_command_writes_page_and_json(
    quiet_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert command(["report", str(quiet_run), "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["run"] == quiet_run.name
    assert {path.name for path in out.iterdir()} == {"report.html", "report.json"}
    assert not (quiet_run / "report").exists()


def test_equal_runs_do_not_differ_and_unequal_ones_do(quiet_run: Path, tmp_path: Path) -> None:
    ours = analyse_run(open_run(quiet_run))
    twin = analyse_run(open_run(written(tmp_path, HOURS, seed=7, name="20261122T180000Z-twin")))
    verdicts = {d.name: d.verdict_text for d in compare_analyses(ours, twin)}
    assert verdicts["reading, std of 1 s"] == "no significant difference"
    rows, shapes = night(7, HOURS, "gusty", [])
    rows[:, COLUMN["displacement_um"]] *= 1.5
    write_run(tmp_path / "20261123T180000Z-worse", iter([(rows, shapes)]))
    worse = analyse_run(open_run(tmp_path / "20261123T180000Z-worse"))
    unlike = {d.name: d.verdict_text for d in compare_analyses(ours, worse)}
    assert unlike["reading, std of 1 s"] == "smaller"


@pytest.mark.usefixtures("undrawn")
def test_compare_command(quiet_run: Path, tmp_path: Path) -> None:
    other = written(tmp_path, 0.1, seed=8, name="20261122T180000Z-short")
    assert (
        command(["report", str(quiet_run), "--compare", str(other), "--out", str(tmp_path / "o")])
        == 0
    )
    table = json.loads((tmp_path / "o" / "report.json").read_text())
    assert table["compared_with"]["run"] == other.name
    assert "Against 20261122T180000Z-short" in (tmp_path / "o" / "report.html").read_text()


@pytest.mark.usefixtures("undrawn")
def test_a_run_that_never_held(tmp_path: Path) -> None:
    rows, _ = night(1, 0.05, "typical", [])
    rows[:, COLUMN["state"]] = State.INFLATE
    write_run(tmp_path / "run", iter([(rows, [])]))
    analysis = analyse_run(open_run(tmp_path / "run"))
    assert report_table(analysis)["verdict"] == "bad"
    assert "Not held" in render_report(analysis)


def test_a_mark_may_contain_any_text(quiet_run: Path, tmp_path: Path) -> None:
    folder = tmp_path / quiet_run.name
    shutil.copytree(quiet_run, folder)
    texts = ["$\\frac{$ <b>", "日本 $", "two\nlines", "long " * 100]
    for number, text in enumerate(texts):
        assert command(["review", "mark", str(folder), text, "--at", f"+{100 + number}s"]) == 0
    page = render_report(analyse_run(open_run(folder)))
    assert all(str(escape(" ".join(text.split()))) in page for text in texts)
    assert "<b>" not in page.split("<svg")[1]


@pytest.mark.parametrize(
    ("state", "share"), [(ShapeState.WAITING, "0 %"), (ShapeState.TRACKING, None)]
)
def test_a_shape_loop_that_does_not_track_is_named(
    tmp_path: Path, state: ShapeState, share: str | None
) -> None:
    rows, _ = night(1, 0.1, "quiet", [])
    rows[:, COLUMN["shape_state"]] = state
    write_run(tmp_path / "run", iter([(rows, [])]))
    seen = [
        odd.seen
        for odd in analyse_run(open_run(tmp_path / "run")).anomalies
        if odd.name == "shape loop"
    ]
    assert [text.split(" of ")[0] for text in seen] == (
        [] if share is None else [f"tracked {share}"]
    )


def test_one_window_has_no_spread(quiet_run: Path) -> None:
    analysis = analyse_run(open_run(quiet_run), 59.5, 125.0)
    assert analysis.reading is not None
    minutes = analysis.reading.windows[2]
    assert (minutes.count, np.isnan(minutes.std_um), np.isfinite(minutes.max_um)) == (1, True, True)


def test_no_window_has_no_share(quiet_run: Path) -> None:
    analysis = analyse_run(open_run(quiet_run), 59.5, 95.0)
    assert analysis.reading is not None
    assert analysis.reading.windows[2].count == 0
    assert "– %" not in render_report(analysis)


def test_nothing_to_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = written(tmp_path, 0.02)
    with pytest.raises(InputError, match="nothing to report"):
        analyse_run(open_run(folder), 1e6, 2e6)
    assert command(["report", str(tmp_path / "absent")]) == 2
    assert "no such run" in capsys.readouterr().err


def test_short_gaps_are_bridged_and_long_ones_stay() -> None:
    values = np.arange(20, dtype=np.float32)
    values[[0, 5, 6]] = np.nan
    values[10:14] = np.nan
    filled = fill_short_gaps(values, 2)
    assert same(filled[5:7], np.array([5.0, 6.0]), 1e-6)
    assert np.isnan(filled[[0, 10, 13]]).all()
