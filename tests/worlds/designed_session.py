"""A tuning session up to its design, on made-up data."""

from __future__ import annotations

import atexit
import shutil
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.control.experiments import experiment, operating_point
from membrane_ctrl.sessions import folder, session_json
from tests.tuning import synthetic
from tuning.identification import disturbance, noise_spectrum, plant_model, record_file
from tuning.identification.record import Record
from tuning.proposal import model_bench
from tuning.rigs.bench_rig import Rig
from tuning.steps import characterise, design, identify

PLANT = plant_model.PlantModel(0.9, 0.4, 0.3, 1.2)
CALM = noise_spectrum.Noise(1.0, 0.01, 0.01, 12.0, 0.02)
LOOP = LoopConfig(feedforward_barometer=False, feedforward_temperature=False)
WEATHER = disturbance.DisturbanceModel(CALM, None, None)


def record_quiet_hold(seed: int = 3) -> Record:
    bench = model_bench.ModelBench(PLANT, WEATHER, PumpConfig(), seed)
    rig = Rig(bench, LOOP, PumpConfig(), PLANT.holding_flow_um_per_s)
    rig.hold(30.0)
    return rig.hold(260.0)


def make_designed_session(logs: Path) -> Path:
    """Make the session in a folder of runs; returns its folder."""
    (session,) = (_designed_logs() / "tuning").iterdir()
    return Path(shutil.copytree(session, logs / "tuning" / session.name))


@cache
def _designed_logs() -> Path:
    """A folder of runs with the session, which is designed once in a process."""
    logs = Path(mkdtemp(prefix="designed-"))
    atexit.register(shutil.rmtree, logs, ignore_errors=True)
    _design_session(logs)
    return logs


def _design_session(logs: Path) -> None:
    opened = folder.create_session(logs, "made", "tester", "made up", Config(loop=LOOP), LOOP)
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
    quiet = record_quiet_hold()
    record_file.save_record(opened.file_path("quiet.npz"), quiet)
    found = identify.load_identified(opened).identified.model
    session_json.write_session_file(
        opened.file_path("disturbance.json"), disturbance.observe_disturbance(quiet, found, LOOP)
    )
    design.run_design(opened)
