"""The first step of a session: relay until the gain is known, doublets until the dead time is, all within bounds."""

from __future__ import annotations

from dataclasses import dataclass

from membrane_ctrl.control.experiments.machine import Around, Finished, Patterned
from membrane_ctrl.control.experiments.patterns import doublets
from membrane_ctrl.control.experiments.relay import Relay
from tuning.identify import Identified, identify
from tuning.quality import Quality, judge, validate
from tuning.records import Record
from tuning.rig import Rig

_RELAYS_MAX, _DOUBLETS_MAX = 4, 4
_GAIN_SIGMA = 0.025  # k within 5 % at 2 sigma
_DEAD_TIME_SIGMA_S = 0.025  # within 0.05 s at 2 sigma
_QUIET_S, _BETWEEN_S = 40.0, 15.0
_DOUBLETS_S = 60.0


@dataclass(frozen=True, slots=True)
class Characterised:
    """What the experiments gave.

    Attributes
    ----------
    around : Around
        Holding flow, laser noise, limits.
    record : Record
        Relays, the holds between, doublets, without a gap.
    identified : Identified
        Fit to all of it.
    quality : Quality
        Verdict; the doublets are predicted with a fit to the relays alone.
    finished : Finished
        How the last relay ended.
    """

    around: Around
    record: Record
    identified: Identified
    quality: Quality
    finished: Finished


class ExperimentError(Exception):
    """No relay could be completed; the message is the last one's reason."""


def characterise(rig: Rig, limit_um: float = 10.0) -> Characterised:
    """Hold, relay, doublets on a rig that holds its mirror at 0.

    A relay that was stopped is thrown away and repeated: whatever stopped it is no disturbance of the kind that the
    fit knows. Doublets that were stopped are kept.

    Raises
    ------
    ExperimentError
        If no relay could be completed.
    ValueError
        If the pump has no room about the holding flow: the mirror is too tight or too leaky.
    """
    rig.hold(20.0)
    around = rig.around(rig.hold(_QUIET_S), limit_um)
    relays, finished = _relays(rig, around)
    fitted = identify(relays)
    whole, found = relays, fitted
    pulses: Record | None = None
    for _ in range(_DOUBLETS_MAX):
        pattern = doublets(around, fitted.model.gain)
        latest, _ = rig.run(Patterned(around, pattern, _DOUBLETS_S, 0.0), around, 0.0)
        pulses = latest if pulses is None or len(latest) > len(pulses) else pulses
        whole = whole.followed_by(latest, rig.hold(_BETWEEN_S))
        found = identify(whole)
        if found.sigma.dead_time_s <= _DEAD_TIME_SIGMA_S:
            break
    checked = validate(fitted, pulses) if pulses is not None and pulses.duration_s > 10.0 else None
    return Characterised(around, whole, found, judge(whole, found, checked), finished)


def _relays(rig: Rig, around: Around) -> tuple[Record, Finished]:
    """Relays until the gain is known, each followed by a hold."""
    done: Record | None = None
    finished = Finished(False, "")
    for _ in range(_RELAYS_MAX):
        relay, finished = rig.run(Relay(around, 0.0), around, 0.0)
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
