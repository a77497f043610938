"""The first step of a session: relay until the gain is known, doublets until the dead time is, all within bounds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from membrane_ctrl.control.experiments.machine import Around, Finished
from membrane_ctrl.control.experiments.patterns import room
from membrane_ctrl.control.experiments.spec import ExperimentKind, ExperimentSpec
from tuning.identify import Identified, identify
from tuning.quality import Quality, judge, validate
from tuning.records import Record

_RELAYS_MAX, _DOUBLETS_MAX = 4, 4
_GAIN_SIGMA = 0.025  # k within 5 % at 2 sigma
_DEAD_TIME_SIGMA_S = 0.025  # within 0.05 s at 2 sigma
_SETTLE_S, _QUIET_S, _BETWEEN_S = 20.0, 40.0, 15.0
_RELAY_S, _DOUBLETS_S = 120.0, 60.0
_VALIDATE_LEAST_S = 10.0

# One relay and one round of doublets, with the holds between: what most benches take.
TYPICAL_S = _SETTLE_S + _QUIET_S + _RELAY_S + _DOUBLETS_S + 2 * _BETWEEN_S


class ExperimentRig(Protocol):
    """What characterising needs: `rig.Rig` on a bench, or `hold_rig.HoldRig` on a running hold."""

    def hold(self, duration_s: float) -> Record:
        """Hold for a time."""
        ...

    def around(self, held: Record, limit_um: float) -> Around:
        """The frame of an experiment."""
        ...

    def perform(self, spec: ExperimentSpec) -> tuple[Record, Finished]:
        """Run an experiment."""
        ...


@dataclass(frozen=True, slots=True)
class Experiments:
    """What the experiments left, raw.

    Attributes
    ----------
    around : Around
        Holding flow, laser noise, limits.
    record : Record
        Relays, the holds between, doublets, without a gap.
    relays_s : float
        How much of it is relays with the holds behind them.
    pulses_s : tuple of float
        Start and end of the longest doublets in it.
    finished : Finished
        How the last relay ended.
    """

    around: Around
    record: Record
    relays_s: float
    pulses_s: tuple[float, float]
    finished: Finished


@dataclass(frozen=True, slots=True)
class Characterised:
    """What the experiments gave.

    Attributes
    ----------
    experiments : Experiments
    identified : Identified
        Fit to all of it.
    quality : Quality
        Verdict; the doublets are predicted with a fit to the relays alone.
    """

    experiments: Experiments
    identified: Identified
    quality: Quality

    @property
    def around(self) -> Around:
        """Holding flow, laser noise, limits."""
        return self.experiments.around

    @property
    def record(self) -> Record:
        """All that was recorded."""
        return self.experiments.record

    @property
    def finished(self) -> Finished:
        """How the last relay ended."""
        return self.experiments.finished


class ExperimentError(Exception):
    """No relay could be completed; the message is the last one's reason."""


def spec_of(kind: ExperimentKind, around: Around, duration_s: float, gain: float = 1.0) -> ExperimentSpec:
    """The specification of an experiment in a frame. Raises pydantic.ValidationError outside its bounds."""
    return ExperimentSpec(
        kind=kind,
        duration_s=duration_s,
        limit_um=around.limit_um,
        holding_flow_um_per_s=around.holding_flow_um_per_s,
        laser_um=around.laser_um,
        gain=gain,
    )


def characterise(rig: ExperimentRig, limit_um: float = 10.0) -> Characterised:
    """Experiments and fit in one; see `experiment` for what is raised."""
    return fitted(experiment(rig, limit_um))


def experiment(rig: ExperimentRig, limit_um: float = 10.0) -> Experiments:
    """Hold, relay, doublets on a rig that holds its mirror.

    A relay that was stopped is thrown away and repeated: whatever stopped it is no disturbance of the kind that the
    fit knows. Doublets that were stopped are kept.

    Raises
    ------
    ExperimentError
        If no relay could be completed.
    ValueError
        If the pump has no room about the holding flow: the mirror is too tight or too leaky.
    """
    rig.hold(_SETTLE_S)
    around = rig.around(rig.hold(_QUIET_S), limit_um)
    room(around)  # a relay without it would only say that it was stopped
    relays, finished = _relays(rig, around)
    gain = identify(relays).model.gain
    whole = relays
    longest_s = (relays.duration_s, relays.duration_s)
    for _ in range(_DOUBLETS_MAX):
        latest, _ = rig.perform(spec_of("doublets", around, _DOUBLETS_S, gain))
        if latest.duration_s > longest_s[1] - longest_s[0]:
            longest_s = (whole.duration_s, whole.duration_s + latest.duration_s)
        whole = whole.followed_by(latest, rig.hold(_BETWEEN_S))
        if identify(whole).sigma.dead_time_s <= _DEAD_TIME_SIGMA_S:
            break
    return Experiments(around, whole, relays.duration_s, longest_s, finished)


def fitted(done: Experiments) -> Characterised:
    """The fit to all experiments, judged on doublets that a fit to the relays alone has to predict."""
    found = identify(done.record)
    start_s, stop_s = done.pulses_s
    checked = None
    if stop_s - start_s > _VALIDATE_LEAST_S:
        relays = done.record.part(0.0, done.relays_s)
        checked = validate(identify(relays), done.record.part(start_s, stop_s))
    return Characterised(done, found, judge(done.record, found, checked))


def _relays(rig: ExperimentRig, around: Around) -> tuple[Record, Finished]:
    """Relays until the gain is known, each followed by a hold."""
    done: Record | None = None
    finished = Finished(False, "")
    for _ in range(_RELAYS_MAX):
        relay, finished = rig.perform(spec_of("relay", around, _RELAY_S))
        between = rig.hold(_BETWEEN_S)
        if not finished.completed:
            done = None
            continue
        done = relay.followed_by(between) if done is None else done.followed_by(relay, between)
        found = identify(done)
        if found.sigma.gain <= _GAIN_SIGMA * found.model.gain:
            break
    if done is None:
        raise ExperimentError(finished.reason)
    return done, finished
