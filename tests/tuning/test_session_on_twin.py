"""A whole session on the twin, as the command runs it: what it leaves, and how each step goes
wrong.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.cli import run as command_line
from membrane_ctrl.config.schema import Config, EstimatorConfig, ShapeConfig, TwinConfig
from membrane_ctrl.model.errors import Exit, InputError, RejectedError
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sessions.folder import FILES, STEPS, SessionFolder, create_session, open_session
from membrane_ctrl.sessions.progress import Progress
from tuning import connection, estimator_levels, journal, twin_hold
from tuning.commands import choose, run
from tuning.commands.compare import compare_sessions as compare
from tuning.gains_file import load_gains
from tuning.identification.closed_loop import Gains
from tuning.identification.margins import compute_margins
from tuning.proposal.candidate import NAMES
from tuning.proposal.candidate_table import describe_change
from tuning.report import page, pictures
from tuning.rigs.hold_rig import HoldRig
from tuning.steps import apply, characterise, design, identify, observe, preview, verify
from tuning.twin_hold import TwinHold

CONFIG = """
[twin]
scenario = "typical"
start_error_um = -5.0
[shape]
enabled = false
[loop]
feedforward_barometer = false
feedforward_temperature = false
rate_hz = 25.0
"""
TIMES = ("--observe", "5m", "--verify", "5m")


def tune_twin(logs: Path, *words: str, config: str = CONFIG) -> int:
    logs.mkdir(exist_ok=True)
    path = logs / "twin.toml"
    path.write_text(config)
    return command_line(["tune", *words, "--twin", "--config", str(path), "--logs", str(logs)])


class Killed:
    """What a kill leaves of a session after each change of its folder; hard links cost nothing."""

    def __init__(self, logs: Path, into: Path) -> None:
        self._logs, self._into = logs, into
        self.folders: list[Path] = []

    def after(self, change: Callable[..., None]) -> Callable[..., None]:
        """The change, after which the folder is kept as it then is."""

        def changed(*given: Any, **named: Any) -> None:
            change(*given, **named)
            for source in (self._logs / "tuning").glob("*-first"):
                self.folders.append(self._into / str(len(self.folders)))
                self.folders[-1].mkdir()
                for path in source.iterdir():
                    if path.suffix != ".jsonl":  # which grows
                        os.link(path, self.folders[-1] / path.name)

        return changed


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Killed:
    """One complete session, and what it would have left if killed."""
    folder = tmp_path_factory.mktemp("logs")
    found = Killed(folder, tmp_path_factory.mktemp("killed"))
    words = ("--name", "first", "--author", "eve", "--reason", "new film", "--yes")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(os, "replace", found.after(os.replace))
        patched.setattr(os, "unlink", found.after(os.unlink))
        assert tune_twin(folder, "run", *words, *TIMES) == Exit.DONE
    return found


@pytest.fixture(scope="module")
def logs(killed: Killed) -> Path:
    """Logs with one complete session in them."""
    return killed._logs


LOADED: dict[str, Callable[[SessionFolder], object]] = {
    "characterise": characterise.load_experiments,
    "identify": identify.load_identified,
    "observe": observe.load_disturbance,
    "design": design.load_candidates,
    "preview": preview.load_preview,
    "apply": apply.load_checked_gains,
    "verify": verify.load_verified,
}


def test_a_session_killed_at_any_moment_has_whole_steps_only(killed: Killed) -> None:
    reached = set()
    for path in killed.folders:
        if not (path / "session.json").exists():
            continue
        opened = open_session(path)
        steps = [step for step in STEPS if opened.is_done(step)]
        assert steps == list(STEPS[: len(steps)])
        if (
            steps and steps[-1] not in reached
        ):  # the earlier a step counts as done, the less of it may be there
            LOADED[steps[-1]](opened)
            reached.add(steps[-1])
    assert reached == set(STEPS)


def test_a_session_killed_before_its_journal_is_complete_when_resumed(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copied = Path(shutil.copytree(logs, tmp_path / "logs"))
    (path,) = (copied / "tuning").glob("*-first")
    (copied / "tuning" / "journal.jsonl").unlink()
    (path / "session.rrd").unlink()
    before = {file.name: file.stat().st_mtime_ns for file in path.glob("*.npz")}
    assert tune_twin(copied, "run", "--resume", str(path), "--yes") == Exit.DONE
    run._note_verified(open_session(path), copied, "once more")
    assert [(line.what, line.session) for line in journal.read_entries(copied)] == [
        ("kept", path.name)
    ]
    assert {file.name: file.stat().st_mtime_ns for file in path.glob("*.npz")} == before
    assert (path / "session.rrd").exists()
    assert "characterise" not in capsys.readouterr().err


@pytest.mark.campaign
@pytest.mark.parametrize("step", STEPS)
def test_a_session_killed_in_any_step_continues_with_it(
    killed: Killed, tmp_path: Path, step: str
) -> None:
    """The steps before it are not repeated, and the end is the same."""
    at = next(
        path
        for path in reversed(killed.folders)
        if (path / "session.json").exists() and not open_session(path).is_done(step)
    )
    path = Path(shutil.copytree(at, tmp_path / "tuning" / "20260101T000000Z-first"))
    kept = {file.name: file.stat().st_mtime_ns for file in path.glob("*.npz")}
    assert tune_twin(tmp_path, "run", "--resume", str(path), "--yes", *TIMES) == Exit.DONE
    opened = open_session(path)
    assert all(opened.is_done(each) for each in STEPS)
    assert verify.load_verified(opened).kept
    assert [line.what for line in journal.read_entries(tmp_path)] == ["kept"]
    done = [name for each in STEPS[: STEPS.index(step)] for name in FILES[each] if name in kept]
    assert all((path / name).stat().st_mtime_ns == kept[name] for name in done)


@pytest.fixture
def done(logs: Path, tmp_path: Path) -> SessionFolder:
    """A copy of the complete session, to be spoilt."""
    (source,) = (logs / "tuning").glob("*-first")
    return open_session(Path(shutil.copytree(source, tmp_path / "tuning" / source.name)))


def test_it_leaves_gains_that_are_kept_and_justified(done: SessionFolder) -> None:
    assert all(done.is_done(step) for step in STEPS)
    verified = verify.load_verified(done)
    assert verified.kept, verified.reason
    assert all(stage.growth < stage.growth_max for stage in verified.stages)
    gains = load_gains(done.file_path("gains.toml"))
    assert (gains.author, gains.reason) == ("eve", "new film")
    assert gains.data_sha256 == characterise.load_experiments(done).record.sha256()
    assert gains.plant.gain == pytest.approx(1.0, abs=0.06)
    assert gains.plant.model.delay_s == pytest.approx(0.225, abs=0.05)
    assert gains.predicted_std_um < 1.2 * gains.least_std_um
    assert gains.predicted_std_um < 0.98 * next(
        row.predicted.std_um
        for row in design.load_design(done).candidates
        if row.name == "present" and row.predicted
    )
    assert verified.stages[-1].std_um == pytest.approx(gains.predicted_std_um, rel=0.3)


def test_the_report_stands_alone_and_the_recording_is_there(done: SessionFolder) -> None:
    text = done.file_path("report.html").read_text(encoding="utf-8")
    assert text.count("data:image/png;base64,") == 4
    assert "://" not in text  # base64 may spell "http" by chance
    for word in ("ziegler-nichols", "eve", "Verification", "kept"):
        assert word in text
    assert done.file_path("session.rrd").stat().st_size > 100_000


@pytest.mark.parametrize(
    ("renewed", "drawn"),
    [
        (None, set()),
        ("identified.json", {"experiments.png", "weather.png", "candidates.png", "verify.png"}),
        ("quiet.npz", {"weather.png", "candidates.png", "verify.png"}),
        ("gains.toml", {"candidates.png"}),
        ("candidates.png", {"candidates.png"}),
    ],
)
def test_a_picture_is_drawn_again_when_its_data_change(
    done: SessionFolder, monkeypatch: pytest.MonkeyPatch, renewed: str | None, drawn: set[str]
) -> None:
    names = {"experiments.png", "weather.png", "candidates.png", "verify.png"}
    for name in names:
        os.utime(done.file_path(name), ns=(10**18, 2 * 10**18))
    for path in set(done.path.iterdir()) - {done.file_path(name) for name in names}:
        os.utime(path, ns=(10**18, 10**18))
    if renewed in names:
        done.file_path(renewed).unlink()
    elif renewed is not None:
        os.utime(
            done.file_path(renewed), ns=(10**18, 2 * 10**18)
        )  # at the same moment: which was first is not known
    seen: set[str] = set()
    monkeypatch.setattr(pictures, "write_picture", lambda path, figure, dpi: seen.add(path.name))
    page.draw_pictures(done)
    assert seen == drawn


def test_calculating_steps_can_be_repeated_without_a_hold(done: SessionFolder) -> None:
    before = load_gains(done.file_path("gains.toml"))
    found = identify.run_identify(done)
    assert not done.is_done("observe")  # what stood on the old fit is gone
    assert found.identified.model.gain == pytest.approx(before.plant.gain, rel=1e-6)


def test_a_step_whose_data_are_missing_names_the_step_to_run(done: SessionFolder) -> None:
    done.begin_step("observe")
    with pytest.raises(
        InputError, match="observe is missing; run `membrane-ctrl tune observe` first"
    ):
        design.run_design(done)


def test_the_estimate_gets_the_values_that_the_session_measured(
    done: SessionFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The twin's own numbers; its laser rounds to 0.1 µm."""
    twin, found = TwinConfig(), estimator_levels.derive_estimator_levels(done)
    assert found["pump_delay_s"] + found["pump_lag_s"] == pytest.approx(
        twin.pump_delay_s + twin.pump_lag_s, abs=0.04
    )
    assert found["laser_noise_um"] == pytest.approx(twin.laser_noise_um, rel=0.1)
    assert found["barometer_noise_pa"] == pytest.approx(twin.barometer_noise_pa, rel=0.2)
    assert found["thermometer_noise_k"] == pytest.approx(twin.thermometer_noise_k, rel=0.2)
    assert 0.05 < found["pressure_walk_pa_per_root_s"] < 2.0
    assert 0.0005 < found["air_walk_k_per_root_s"] < 0.02
    path = tmp_path / "lab.toml"
    path.write_text('[estimator] # all\nprocess_value = "estimate"\n')
    words = ["tune", "save", str(done.path), "--config", str(path), "--yes"]
    assert command_line(words) == Exit.DONE
    saved = tomllib.loads(path.read_text())["estimator"]
    changed = {
        key: value for key, value in found.items() if value != getattr(EstimatorConfig(), key)
    }
    assert saved == {"process_value": "estimate"} | changed
    capsys.readouterr()
    assert command_line(words) == Exit.DONE
    assert "already has what" in capsys.readouterr().out


def test_gains_are_not_designed_for_a_loop_that_has_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = Config(estimator=EstimatorConfig(process_value="estimate"))
    made = create_session(tmp_path, "s", "eve", "a-run", config, config.loop)
    run._run_steps(["design", "apply"], made, None, None, Progress())  # type: ignore[arg-type]  # are not reached
    assert f"`membrane-ctrl tune save {made.path} --config FILE`" in capsys.readouterr().err
    with pytest.raises(RejectedError, match="apply: the hold follows the estimate"):
        run._run_steps(["apply"], made, None, None, Progress())  # type: ignore[arg-type]


BY_OPTICS = (
    '[estimator]\nprocess_value = "optics"\n[shape]\nmode = "track"\n[twin]\nlaser = false\n'
)


def test_a_hold_without_a_laser_is_tuned_by_its_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = BY_OPTICS + "pump_lag_s = 0.3\n[loop]\nrate_hz = 25.0\n"
    assert tune_twin(tmp_path / "logs", "run", "--short", "--yes", config=config) == Exit.DONE
    assert "figure noise 0.0" in capsys.readouterr().err
    path = tmp_path / "lab.toml"
    path.write_text(config)
    assert (
        command_line(
            ["tune", "save", "--config", str(path), "--logs", str(tmp_path / "logs"), "--yes"]
        )
        == Exit.DONE
    )
    saved = tomllib.loads(path.read_text())["estimator"]
    assert saved["pump_delay_s"] + saved["pump_lag_s"] == pytest.approx(0.375, abs=0.05)
    assert "laser_noise_um" not in saved


def test_without_a_laser_there_is_no_shape_loop_to_tune(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tune_twin(tmp_path / "logs", "outer", "--yes", config=BY_OPTICS) == Exit.BAD_INPUT
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.endswith(
        "has nothing to follow: the figure itself is held (estimator.process_value)"
    )
    assert not (tmp_path / "logs" / "tuning").exists()


@pytest.mark.parametrize("name", ["experiments.npz", "experiments.json", "identified.json"])
def test_damaged_files_are_named(done: SessionFolder, name: str) -> None:
    path = done.file_path(name)
    path.write_bytes(path.read_bytes()[:-200])
    step = identify.load_identified if name == "identified.json" else identify.run_identify
    with pytest.raises(InputError, match=f"{name}: damaged"):
        step(done)


def test_an_identified_plant_of_other_experiments_is_refused(done: SessionFolder) -> None:
    path = done.file_path("identified.json")
    good = json.loads(path.read_text())
    shorter = good["identified"] | {"residual_um": good["identified"]["residual_um"][:-1]}
    for forged in (good | {"data_sha256": "0" * 64}, good | {"identified": shorter}):
        path.write_text(json.dumps(forged))
        with pytest.raises(
            InputError, match=r"identified\.json comes from other experiments; run identify again"
        ):
            identify.load_identified(done)


@pytest.mark.parametrize("white", [1e200, 1e20, -1.0, "nan"])
def test_noise_that_is_no_number_ends_the_design_in_one_line(
    done: SessionFolder, white: float | str
) -> None:
    path = done.file_path("disturbance.json")
    weather = json.loads(path.read_text())
    path.write_text(json.dumps(weather | {"rest": weather["rest"] | {"white": white}}))
    with pytest.raises(
        (RejectedError, InputError), match=r"^(design: |.*disturbance\.json: damaged)"
    ):
        design.run_design(done)


def edited(done: SessionFolder, **changed: float) -> None:
    """Edit the gains file by hand."""
    path = done.file_path("gains.toml")
    lines = path.read_text().splitlines()
    path.write_text(
        "\n".join(
            f"{k} = {changed[k]}" if (k := line.split(" ")[0]) in changed else line
            for line in lines
        )
    )


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"kp_per_s": 9.0, "ti_s": 0.5}, "unstable on this file's plant"),
        ({"kp_per_s": 3.0, "ti_s": 3.0}, "sensitivity"),
        ({"kp_per_s": 99.0}, "kp_per_s"),
        ({"rate_hz": 100.0}, "rate_hz"),
    ],
)
def test_a_gains_file_edited_to_something_bad_is_not_applied(
    done: SessionFolder, changed: dict[str, float], words: str
) -> None:
    edited(done, **changed)
    with pytest.raises(InputError, match=words) as refused:
        apply.load_checked_gains(done)
    assert "gains.toml" in str(refused.value)


def test_gains_that_are_worse_are_taken_back_by_themselves(
    done: SessionFolder, tmp_path: Path
) -> None:
    """Sluggish gains, with margins that nothing can be said against."""
    edited(done, kp_per_s=0.1, ti_s=60.0)
    words = ("apply", "verify")
    codes = [
        tune_twin(tmp_path, word, "--session", str(done.path), "--yes", *TIMES) for word in words
    ]
    assert codes == [Exit.DONE, Exit.REJECTED]
    verified = verify.load_verified(done)
    assert not verified.kept
    assert "times that of the previous gains" in verified.reason
    (noted,) = journal.read_entries(tmp_path)
    assert noted.what == "taken_back"


def kp_of(link: TwinHold) -> float:
    rows = [row for row in link.rows[-200:] if abs(row.error_um) > 0.02]
    return float(np.median([row.p_um_per_s / row.error_um for row in rows]))


class Kept(TwinHold):
    """Remembers the twin of the command that is tested."""

    last: TwinHold

    def __init__(self, *given: object) -> None:
        super().__init__(*given)  # type: ignore[arg-type]
        Kept.last = self

    def close(self) -> None:
        """Leaves the twin as it was left."""


@pytest.mark.parametrize(
    ("step", "after_s"), [("characterise", 75.0), ("characterise", 10.0), ("verify", 30.0)]
)
def test_an_interrupt_gives_the_mirror_back_with_the_last_good_gains(
    done: SessionFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, after_s: float
) -> None:
    class Interrupted(connection.Progress):
        heard_s = 0.0

        def __call__(self, seconds: float) -> None:
            self.heard_s += seconds
            self.interrupted = self.interrupted or after_s < self.heard_s < after_s + 0.05
            super().__call__(seconds)

    monkeypatch.setattr(twin_hold, "TwinHold", Kept)
    monkeypatch.setattr(connection, "Progress", Interrupted)
    code = tune_twin(tmp_path, step, "--session", str(done.path), *TIMES)
    assert code == Exit.INTERRUPTED
    for _ in range(20):
        Kept.last.read_news()
    assert Kept.last.rows[-1].state == State.HOLD
    assert kp_of(Kept.last) == pytest.approx(done.head.before.kp_per_s, rel=0.02)


def test_history_rollback_and_comparison(
    logs: Path,
    done: SessionFolder,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    copied = tmp_path / "logs"
    shutil.copytree(logs, copied)
    monkeypatch.setattr(twin_hold, "TwinHold", Kept)
    assert tune_twin(copied, "rollback", "--reason", "did not like it") == Exit.DONE
    assert [line.what for line in journal.read_entries(copied)] == ["kept", "rolled_back"]
    assert tune_twin(copied, "rollback") == Exit.BAD_INPUT
    capsys.readouterr()
    assert command_line(["tune", "history", "--logs", str(copied), "--json"]) == Exit.DONE
    kept, back = json.loads(capsys.readouterr().out)
    assert back["reason"] == "did not like it"
    assert kept["traded"]["candidate"] == "least-variance"
    assert kept["traded"]["before"]["std_um"] > kept["traded"]["after"]["std_um"]
    assert (
        f"| least-variance | {kept['traded']['before']['std_um']:.3f} -> "
        in journal.format_history(journal.read_entries(copied))
    )


def test_a_comparison_crosses_gains_and_benches(done: SessionFolder, tmp_path: Path) -> None:
    other = open_session(Path(shutil.copytree(done.path, tmp_path / "other")))
    edited(other, kp_per_s=0.2)
    text = compare(done, other)
    assert "| kp_per_s |" in text
    assert len([line for line in text.splitlines() if line.startswith(("| A | ", "| B | "))]) == 4


def test_rolling_back_sets_the_gains_of_before(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied = tmp_path / "logs"
    shutil.copytree(logs, copied)
    monkeypatch.setattr(twin_hold, "TwinHold", Kept)
    config = CONFIG + "kp_per_s = 0.3\n"
    assert tune_twin(copied, "rollback", config=config) == Exit.DONE
    for _ in range(12):
        Kept.last.read_news()
    assert kp_of(Kept.last) == pytest.approx(0.61, rel=0.02)


class Terminal(io.StringIO):
    """A terminal at which a person types these answers; `!` is Ctrl-C."""

    def isatty(self) -> bool:
        return True

    def readline(self, size: int | None = -1, /) -> str:
        answer = super().readline()
        if answer == "!\n":
            signal.raise_signal(signal.SIGINT)
        return answer


def asked(
    done: SessionFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answers: str, *words: str
) -> tuple[int, float]:
    """Exit code of `tune apply` answered so, and the gain that then holds the mirror."""
    monkeypatch.setattr(sys, "stdin", Terminal(answers))
    monkeypatch.setattr(twin_hold, "TwinHold", Kept)
    done.begin_step("apply")
    code = tune_twin(tmp_path, "apply", "--session", str(done.path), *words)
    for _ in range(20):
        Kept.last.read_news()
    assert Kept.last.rows[-1].state == State.HOLD
    return code, kp_of(Kept.last)


def test_the_candidate_that_a_person_chooses_is_the_one_that_is_applied(
    done: SessionFolder,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, kp_per_s = asked(
        done, tmp_path, monkeypatch, "fast\nziegler-nichols\npresent\nsimc-slow\n"
    )
    chosen = next(row for row in design.load_design(done).candidates if row.name == "simc-slow")
    gains = load_gains(done.file_path("gains.toml"))
    assert code == Exit.DONE
    assert kp_per_s == pytest.approx(chosen.gains.kp_per_s, rel=0.02)
    assert (gains.candidate, gains.loop.kp_per_s) == ("simc-slow", chosen.gains.kp_per_s)
    assert preview.load_preview(done).proposed[0].load_peak_um == pytest.approx(
        chosen.load_peak_um, rel=0.05
    )
    printed = capsys.readouterr().err
    assert [name for name in ("fast", "present") if f"{name}: not a candidate of" in printed] == [
        "fast",
        "present",
    ]
    assert "ziegler-nichols: is not applied: Ms" in printed
    shown = [line.split()[0] for line in printed.splitlines() if line.strip()]
    ordered = ["present", *[name for name in NAMES if name in shown]]
    assert ordered[1] == "least-variance"  # it keeps the load peak, and is the proposal
    assert [
        name for name in shown if name in ordered
    ] == 2 * ordered  # the figures, and what gets better and worse
    assert "in use" in printed
    assert "simc-slow is on trial" in printed
    assert "simc-slow is chosen" in done.file_path("report.html").read_text()


@pytest.mark.parametrize(
    ("answers", "code"), [("\n", Exit.DONE), ("", Exit.DONE), ("!\n", Exit.INTERRUPTED)]
)
def test_no_answer_applies_nothing(
    done: SessionFolder,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answers: str,
    code: Exit,
) -> None:
    before = done.file_path("gains.toml").read_bytes()
    assert asked(done, tmp_path, monkeypatch, answers) == (
        code,
        pytest.approx(done.head.before.kp_per_s, rel=0.02),
    )
    assert done.file_path("gains.toml").read_bytes() == before
    assert not done.is_done("apply")
    printed = capsys.readouterr().err
    assert ("nothing is applied; `membrane-ctrl tune apply" in printed) == (code == Exit.DONE)


@pytest.mark.parametrize("name", ["balanced", "same-load"])
def test_the_least_variance_is_the_same_load_where_it_answers_a_load_no_worse(
    done: SessionFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """`hold --autotune` asks for `same-load`, which is designed only where the least variance
    answers a load worse.
    """
    bounded = ("balanced", "same-load")
    rows = [row for row in design.load_candidates(done)[0] if row.name not in bounded]
    opened = open_session(Path(shutil.copytree(done.path, tmp_path / "copy")))
    monkeypatch.setattr(design, "load_candidates", lambda folder: (tuple(rows), rows[0]))
    apply.select_candidate(opened, name)
    assert load_gains(opened.file_path("gains.toml")).candidate == "least-variance"


def test_a_named_candidate_without_benefit_is_applied_only_for_a_person(
    done: SessionFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`hold --autotune` verified gains for five minutes that were predicted to be no better."""
    rows, proposed = design.load_candidates(done)
    present = next(row for row in rows if row.name == "present")
    better = replace(present, name="same-load")
    assert present.predicted is not None
    for share, applied in ((1.0, False), (0.8, True)):
        predicted = replace(present.predicted, std_um=share * present.predicted.std_um)
        same_load = replace(better, predicted=predicted)
        loaded = ((present, same_load), proposed)
        monkeypatch.setattr(design, "load_candidates", lambda folder, loaded=loaded: loaded)
        assert choose.choose_candidate(done, False, "same-load", Progress()) == "same-load"
        chosen = choose.choose_candidate(done, True, "same-load", Progress())
        assert chosen == ("same-load" if applied else None)
    assert "the present gains are as good as same-load" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["fast", "ziegler-nichols", "present"])
def test_a_refused_name_applies_nothing(
    done: SessionFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    code, kp_per_s = asked(done, tmp_path, monkeypatch, "simc\n", "--choose", name)
    assert code == Exit.BAD_INPUT
    assert kp_per_s == pytest.approx(done.head.before.kp_per_s, rel=0.02)
    assert not done.is_done("apply")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ((), "add --yes (the proposal) or --choose NAME"),
        (("--choose", "fast"), "--choose fast: not a candidate"),
    ],
)
@pytest.mark.parametrize("step", ["run", "apply"])
def test_gains_that_no_person_can_choose_are_refused_before_anything_moves(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    step: str,
    words: tuple[str, ...],
    reason: str,
) -> None:
    assert tune_twin(tmp_path, step, *words) == Exit.BAD_INPUT
    assert reason in capsys.readouterr().err
    assert not (tmp_path / "tuning").exists()


def test_a_hold_is_watched_without_leaving_anything(
    done: SessionFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(path.name for path in done.path.parent.iterdir())
    assert tune_twin(tmp_path, "watch", "--session", str(done.path), *TIMES) == Exit.DONE
    assert "of the lower bound" in capsys.readouterr().err
    assert sorted(path.name for path in done.path.parent.iterdir()) == before
    (tmp_path / "fresh").mkdir()
    assert tune_twin(tmp_path / "fresh", "watch") == Exit.BAD_INPUT
    assert sorted(path.name for path in (tmp_path / "fresh").iterdir()) == ["twin.toml"]


def test_edited_gains_are_a_candidate_of_their_own(done: SessionFolder) -> None:
    assert design.load_candidates(done)[1].name == "least-variance"
    edited(done, kp_per_s=0.2)
    rows, now = design.load_candidates(done)
    assert (now.name, now.gains.kp_per_s, len(rows)) == (
        "edited",
        0.2,
        1 + len(design.load_design(done).candidates),
    )
    assert "worse: " in describe_change(now, next(row for row in rows if row.name == "present"))


def test_margins_of_what_is_kept(done: SessionFolder) -> None:
    gains = load_gains(done.file_path("gains.toml"))
    found = compute_margins(Gains.from_config(gains.loop), gains.plant.model, 0.02)
    assert found.stable
    assert found.ms < 1.45


def test_a_rig_on_a_hold_records_without_a_gap() -> None:
    link = TwinHold(Config(twin=TwinConfig(start_error_um=-3.0), shape=ShapeConfig(enabled=False)))
    rig = HoldRig(link, "tester")
    first = len(link.rows)
    parts = [rig.hold(1.3), rig.hold(0.7)]
    together = parts[0].followed_by(parts[1])
    read = [row.displacement_um for row in link.rows[first : first + len(together)]]
    np.testing.assert_array_equal(together.displacement_um, read)


def test_ticks_from_before_the_answer_are_not_recorded() -> None:
    link = TwinHold(Config(twin=TwinConfig(start_error_um=-3.0), shape=ShapeConfig(enabled=False)))
    rig = HoldRig(link, "tester")
    rig.hold(0.1)  # the rest of half a second waits
    rig.catch_up()
    ticks = len(link.rows)
    after = rig.hold(0.3)
    read = [row.displacement_um for row in link.rows[ticks : ticks + len(after)]]
    np.testing.assert_array_equal(after.displacement_um, read)


@pytest.mark.parametrize("name", ["experiments.png", "session.rrd"])
def test_what_cannot_be_written_ends_in_one_line(
    done: SessionFolder, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    path = done.file_path(name)
    path.unlink()
    path.mkdir()
    assert command_line(["tune", "identify", "--session", str(done.path)]) == Exit.DEVICE_FAILED
    (printed,) = (
        line for line in capsys.readouterr().err.splitlines() if line.startswith("membrane-ctrl: ")
    )
    assert "cannot be written" in printed


def test_a_picture_replaces_a_pipe_without_a_reader(done: SessionFolder) -> None:
    path = done.file_path("experiments.png")
    path.unlink()
    os.mkfifo(path)
    assert command_line(["tune", "identify", "--session", str(done.path)]) == Exit.DONE
    assert path.read_bytes().startswith(b"\x89PNG")
