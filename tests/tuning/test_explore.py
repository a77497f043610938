"""`tune explore`: responses against another implementation, sources, saved gains, and the page in a
browser.
"""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import control
import numpy as np
import pytest
import synthetic
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.control.experiments import experiment, operating_point
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sessions import folder, session_json
from membrane_ctrl.sessions.live_hold import HoldError
from tests.support import review_runs
from tests.support.browser import browser_tab
from tests.support.machine_needs import needs
from tuning import gains_file
from tuning.explore.curves import Sliders, Workpiece, curves, of_path, responded
from tuning.explore.page import make_saver
from tuning.identification import disturbance, noise_spectrum, plant_model, record_file
from tuning.identification.closed_loop import Gains
from tuning.identification.experiments import SHORT
from tuning.identification.record import Record
from tuning.proposal import model_bench, verification
from tuning.proposal.preview import preview_loop
from tuning.proposal.verification import Stage
from tuning.rigs.bench_rig import Rig
from tuning.steps import apply, characterise, design, identify, observe, preview, verify

PLANT = plant_model.PlantModel(0.9, 0.4, 0.3, 1.2)
CALM = noise_spectrum.Noise(1.0, 0.01, 0.01, 12.0, 0.02)
LOOP = LoopConfig(feedforward_barometer=False, feedforward_temperature=False)
MADE = Workpiece("made up", PLANT, disturbance.DisturbanceModel(CALM, None, None), LOOP, None, None)
GAINS = (
    Gains(0.3, 9.0, 0.0, 0.2),
    Gains(0.5, 6.0, 0.0, 0.05),
    Gains(0.4, 6.0, 0.2, 0.1),
)


def closed_loop(gains: Gains, output: str) -> control.TransferFunction:
    """From setpoint (T) or from the leak to the centre, with the delay as a Pade approximation of
    order 8.
    """
    s = control.tf("s")
    delay = control.tf(*control.pade(PLANT.dead_time_s + CALM.dt_s / 2, 8))
    controller = (
        gains.kp_per_s * (1 + 1 / (gains.ti_s * s) + gains.td_s * s) / (1 + gains.filter_s * s)
    )
    pump = PLANT.gain * delay / (1 + PLANT.lag_s * s)
    loop = controller * pump / s
    return control.minreal((loop if output == "step" else -1 / s) / (1 + loop), verbose=False)


@pytest.mark.parametrize("gains", GAINS)
@pytest.mark.parametrize("output", ["step", "load"])
def test_the_responses_are_those_of_another_implementation(gains: Gains, output: str) -> None:
    """The D term sees the measurement alone, so for a setpoint step
    only PI loops are comparable.
    """
    if output == "step" and gains.td_s:
        gains = replace(gains, td_s=0.0)
    step = (1.0, 0.0) if output == "step" else (0.0, 1.0)
    time_s, centre_um = responded(gains, MADE, 60.0, *step)
    other = control.forced_response(closed_loop(gains, output), time_s, np.ones(time_s.size))
    assert np.abs(centre_um - other.y[0]).max() < 0.02 * np.abs(centre_um).max()


def test_the_load_peak_is_that_of_the_real_loop() -> None:
    gains = GAINS[0]
    shown = curves("yours", gains, MADE, 60.0)
    loop = gains.applied_to(LOOP)
    seen = preview_loop(loop, PumpConfig(), PLANT, MADE.weather, duration_s=40.0)
    assert np.abs(shown.load_um).max() == pytest.approx(seen.load_peak_um, rel=0.05)


def test_an_unstable_loop_has_no_response_and_is_named() -> None:
    shown = curves("yours", Gains(5.0, 1.0, 0.0, 0.0), MADE, 60.0)
    assert not shown.figures.margins.stable
    assert shown.time_s.size == shown.load_um.size == 0


def test_the_sliders_begin_where_the_gains_are() -> None:
    for gains in (*GAINS[:2], Gains(0.1, 40.0, 0.0, 0.03)):
        again = Sliders.near(gains, PLANT, CALM.dt_s).gains(PLANT, CALM.dt_s)
        assert (again.kp_per_s, again.ti_s, again.filter_s) == pytest.approx(
            (gains.kp_per_s, gains.ti_s, gains.filter_s), rel=1e-9
        )


def quiet_hold(seed: int = 3) -> Record:
    bench = model_bench.ModelBench(PLANT, MADE.weather, PumpConfig(), seed)
    rig = Rig(bench, LOOP, PumpConfig(), PLANT.holding_flow_um_per_s)
    rig.hold(30.0)
    return rig.hold(260.0)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session up to its design, on made-up data; tests work on copies."""
    opened = folder.create_session(
        tmp_path_factory.mktemp("logs"), "made", "tester", "made up", Config(loop=LOOP), LOOP
    )
    record = synthetic.record(PLANT, samples=6000)
    record_file.save_record(opened.file_path("experiments.npz"), record)
    around = operating_point.OperatingPoint(PLANT.holding_flow_um_per_s, 0.4, 5.3, 1.0)
    ends_s = record.duration_s
    head = characterise.ExperimentsHead(
        around,
        ends_s,
        (ends_s, ends_s),
        experiment.Finished(experiment.ExperimentEnd.COMPLETED, "done"),
    )
    session_json.write_session_file(opened.file_path("experiments.json"), head)
    identify.run_identify(opened)
    quiet = quiet_hold()
    record_file.save_record(opened.file_path("quiet.npz"), quiet)
    found = identify.load_identified(opened).identified.model
    session_json.write_session_file(
        opened.file_path("disturbance.json"), disturbance.observe_disturbance(quiet, found, LOOP)
    )
    design.run_design(opened)
    return opened.path


def copy_of(template: Path, into: Path) -> folder.SessionFolder:
    return folder.open_session(Path(shutil.copytree(template, into / "session")))


def test_a_session_gives_plant_weather_and_proposal(template: Path, tmp_path: Path) -> None:
    opened = copy_of(template, tmp_path)
    found = of_path(opened.path, tmp_path)
    assert found.model.gain == pytest.approx(PLANT.gain, rel=0.05)
    assert found.proposed == Gains.of(gains_file.load_gains(opened.file_path("gains.toml")).loop)
    opened.begin_step("design")
    assert of_path(opened.path, tmp_path).proposed is None


def test_a_short_session_takes_the_weather_from_before_its_experiments(
    template: Path, tmp_path: Path
) -> None:
    """The hold is not asked for more."""
    opened = copy_of(template, tmp_path)
    before = observe.load_disturbance(opened)
    shutil.copy(opened.file_path("quiet.npz"), opened.file_path("held.npz"))
    assert observe.run_observe(opened, SimpleNamespace(loop=LOOP)) == before  # type: ignore[arg-type]
    assert SHORT.typical_s == pytest.approx(300.0, abs=1.0)
    opened.begin_step("characterise")
    assert not opened.file_path("held.npz").exists()


def test_a_hold_lost_in_the_verification_is_reported(template: Path, tmp_path: Path) -> None:
    """Not that it then takes no gains; the verification is still to be done."""
    opened = copy_of(template, tmp_path)
    session_json.write_session_file(opened.file_path("applied.json"), {})

    class Lost:
        dt_s, told, pump = 0.02, 0, PumpConfig()

        def set_gains(self, *given: object) -> None:
            self.told += 1
            if self.told > 1:
                raise HoldError("refused: gains is not allowed in state lower")

        def hold(self, duration_s: float) -> None:
            raise HoldError("the mirror is not held (state lower)")

    with pytest.raises(HoldError, match="the mirror is not held"):
        verify.run_verify(opened, Lost())  # type: ignore[arg-type]
    assert not opened.is_done("verify")


@pytest.mark.parametrize(
    ("growths", "kept", "until_s"),
    [
        ((1.0,) * 4, True, 600.0),
        ((1.0, 1.0, 1.0, 1.15, 1.05), True, 1200.0),
        ((1.0, 1.6), False, 180.0),
        ((1.0, 1.0, 1.0, 1.15, 1.12), False, 1200.0),
        ((1.0, 1.0, 1.0, 1.3), False, 600.0),
    ],
)
def test_a_close_verification_continues_for_as_long_again(
    template: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    growths: tuple[float, ...],
    kept: bool,
    until_s: float,
) -> None:
    """Ten minutes tell a standard deviation to 13 %."""
    opened = copy_of(template, tmp_path)
    session_json.write_session_file(opened.file_path("applied.json"), {})
    left, told = list(growths), []
    held = SimpleNamespace(followed_by=lambda more: held)
    rig = SimpleNamespace(
        pump=PumpConfig(),
        dt_s=1.0,
        set_gains=lambda *given: None,
        keep=lambda: told.append("keep"),
        hold=lambda seconds: None,
        hold_about=lambda seconds: (held, np.zeros(round(seconds))),
    )

    def look(record: object, setpoint_um: FloatArray, trial: object, growth_max: float) -> Stage:
        growth = left.pop(0)
        reason = "grown" if growth > growth_max else ""
        return Stage(float(setpoint_um.size), growth, 1.0, growth, growth_max, 1.3, 0.0, reason)

    monkeypatch.setattr(verification, "judge_stage", look)
    monkeypatch.setattr(record_file, "save_record", lambda path, record: None)
    done = verify.run_verify(opened, rig)  # type: ignore[arg-type]
    assert (done.kept, done.stages[-1].time_s, told) == (kept, until_s, ["keep"] * kept)


def test_a_run_gives_its_weather_and_names_the_source_of_its_plant(
    template: Path, tmp_path: Path
) -> None:
    run = review_runs.written(tmp_path, 0.2)
    assumed = of_path(run, tmp_path)
    assert "as the configuration assumes" in assumed.source
    assert assumed.weather.laser_um == pytest.approx(1.0, rel=0.1)
    shutil.copytree(template, tmp_path / "tuning" / "20261122T000000Z-made")
    identified = of_path(run, tmp_path)
    assert "plant of the session 20261122T000000Z-made" in identified.source
    assert identified.model.gain == pytest.approx(PLANT.gain, rel=0.05)


def test_a_folder_that_cannot_be_explored_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no undisturbed hold of 200 s"):
        of_path(review_runs.written(tmp_path, 0.05), tmp_path)
    with pytest.raises(InputError):
        of_path(tmp_path, tmp_path)


def test_saved_gains_are_the_next_to_be_applied(template: Path, tmp_path: Path) -> None:
    opened = copy_of(template, tmp_path)
    session_json.write_session_file(opened.file_path("preview.json"), preview.Previewed((), ()))
    save = make_saver(of_path(opened.path, tmp_path), "ada")
    assert save is not None
    assert "tune apply" in save(GAINS[0])
    assert Gains.of(apply.load_checked_gains(opened)) == GAINS[0]
    assert gains_file.load_gains(opened.file_path("gains.toml")).author == "ada"
    assert not opened.is_done("preview")  # it was of other gains


@pytest.mark.parametrize("gains", [Gains(9.0, 1.0, 0.0, 0.1), Gains(1.2, 4.0, 0.0, 0.1)])
def test_gains_without_margin_are_not_saved(gains: Gains, template: Path, tmp_path: Path) -> None:
    opened = copy_of(template, tmp_path)
    before = opened.file_path("gains.toml").read_bytes()
    save = make_saver(of_path(opened.path, tmp_path), "ada")
    assert save is not None
    assert re.search("Not saved: .*(unstable|sensitivity)", save(gains))
    assert opened.file_path("gains.toml").read_bytes() == before


_ROW = "Bokeh.documents[0].get_model_by_name('table').text"
_GAINS_NEAR = (
    "(() => {{ const found = "
    "Bokeh.documents[0].get_model_by_name('command').text.match(/{{.*}}/)[0];"
    "return Math.abs(JSON.parse(found).ti_s / {} - 1) < 0.05 && found }})()"
)
_MOVE = "Bokeh.documents[0].get_model_by_name('{}').value = {}"


@pytest.mark.real_time
@needs("chromium")
async def test_the_page_in_a_browser(template: Path, tmp_path: Path) -> None:
    opened = copy_of(template, tmp_path)
    command = (sys.executable, "-m", "membrane_ctrl", "tune", "explore", str(opened.path))
    served = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    try:
        assert served.stdout is not None
        async with asyncio.timeout(60.0):
            said = (await served.stdout.readline()).decode()
        url = said.split()[2]
        async with browser_tab(url, tmp_path / "profile") as tab:
            await tab.until(_ROW)
            await tab.value(_MOVE.format("speed", 0.5))
            await tab.value(_MOVE.format("damping", 12.0))
            loop = gains_file.load_gains(opened.file_path("gains.toml")).loop
            slowed_s = 10**0.5 + PLANT.delay_s + CALM.dt_s / 2 + loop.measurement_filter_s
            shown = json.loads(await tab.until(_GAINS_NEAR.format(12.0 * slowed_s)))
            assert shown["kp_per_s"] == pytest.approx(1 / (PLANT.gain * slowed_s), rel=0.1)
            await tab.click("Save as gains.toml")
            await tab.until("Bokeh.documents[0].get_model_by_name('said').text.includes('Saved')")
            await tab.screenshot(tmp_path / "page.png")
            await tab.call("Page.navigate", url=f"{url}session")
            await tab.until(
                "Bokeh.documents[0].get_model_by_name('now').text.includes('Nothing recorded yet')"
            )
        assert (tmp_path / "page.png").stat().st_size > 30_000
        assert gains_file.load_gains(opened.file_path("gains.toml")).loop.ti_s == pytest.approx(
            shown["ti_s"], rel=1e-3
        )
        await _is_refused(url)
    finally:
        served.terminate()  # a shell that runs us in the background has SIGINT ignored
        assert await served.wait() == 0


async def _is_refused(url: str) -> None:
    """Another site's web socket."""
    socket = url.replace("http", "ws") + "ws"
    with pytest.raises(HTTPClientError, match="403"):
        await websocket_connect(
            HTTPRequest(socket, headers={"Origin": "http://evil.example"}), subprotocols=["bokeh"]
        )
