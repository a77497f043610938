"""First step of a session: run the experiments on the mirror and keep their records."""

from dataclasses import dataclass

from membrane_ctrl.control.experiments import experiment, operating_point
from membrane_ctrl.model import errors
from membrane_ctrl.sessions import folder, session_json
from tuning.identification import experiments, record_file
from tuning.rigs.hold_rig import HoldRig

HELD_RECORD = "held.npz"  # the quiet hold of a short session, recorded before the experiments


@dataclass(frozen=True, slots=True)
class ExperimentsHead:
    """`experiments.json`: an `experiments.Experiments` without its record."""

    around: operating_point.OperatingPoint
    relays_s: float
    pulses_s: tuple[float, float]
    finished: experiment.Finished


class PumpUnknownError(errors.RejectedError):
    """The experiments fail or contradict themselves, as the pump's curve may explain."""


def run_characterise(
    session: folder.SessionFolder,
    rig: HoldRig,
    limit_um: float = 10.0,
    plan: experiments.Plan = experiments.FULL,
) -> experiments.Experiments:
    """Run the experiments on the mirror.

    Parameters
    ----------
    session : SessionFolder
        Gets the record and the results.
    rig : HoldRig
        Holds the mirror.
    limit_um : float
        How far the mirror may move from its setpoint.
    plan : Plan
        How long the parts of the experiments last.

    Raises
    ------
    RejectedError
        With a remedy if none completes; PumpUnknownError if the pump's curve may be the cause.
    """
    session.begin_step("characterise")
    try:
        done = experiments.run_experiments(rig, limit_um, plan)
    except experiments.ExperimentError as error:
        kind = PumpUnknownError if error.pump_suspected else errors.RejectedError
        raise kind(f"characterise: {error}") from None
    except ValueError as error:
        raise PumpUnknownError(f"characterise: {error}") from None
    record_file.save_record(session.file_path("experiments.npz"), done.record)
    if plan is experiments.SHORT and done.held is not None:
        record_file.save_record(session.file_path(HELD_RECORD), done.held)
    head = ExperimentsHead(done.around, done.relays_s, done.pulses_s, done.finished)
    session_json.write_session_file(session.file_path("experiments.json"), head)
    return done


def load_experiments(session: folder.SessionFolder) -> experiments.Experiments:
    """Results of the experiments."""
    head = session.read_result("characterise", "experiments.json", ExperimentsHead)
    record = record_file.load_record(session.file_path("experiments.npz"))
    return experiments.Experiments(head.around, record, head.relays_s, head.pulses_s, head.finished)


def describe_result(session: folder.SessionFolder) -> str:
    """That the experiments are done; the next step has their result."""
    return "done"
