"""Snapshots of what the controller remembers, so that a bit-exact replay can start in the middle of
a run.

A snapshot is `ControllerState` as JSON. A run folder may come from anywhere: every value is checked
against its declared type, and a snapshot of another layout is refused.
"""

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller import safety
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.state import ControllerState
from membrane_ctrl.controller.tick_codec import SNAPSHOT_BYTES_MAX
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.held_weights import HeldWeights
from membrane_ctrl.model.state_tree import StateError, decode_state, encode_state


class UnknownSnapshotError(ValueError):
    """The snapshot is damaged or of another layout; the message states which."""


def take_snapshot(controller: Controller) -> bytes:
    """Encode what the controller remembers between two ticks."""
    return encode_state(controller.memory)


def decode_snapshot(snapshot: bytes) -> ControllerState:
    """Decode a snapshot, which may come from anywhere. Raises UnknownSnapshotError."""
    try:
        return decode_state(snapshot, ControllerState, SNAPSHOT_BYTES_MAX)
    except StateError as error:
        raise UnknownSnapshotError(f"the snapshot cannot be used: {error}") from None


def continue_from(
    snapshot: bytes,
    config: Config,
    sag_sensitivity: FloatArray,
    held_weights: HeldWeights | None = None,
) -> Controller:
    """Make a controller that continues from a snapshot.

    Raises
    ------
    UnknownSnapshotError
        The snapshot is damaged, of another layout, or does not fit the configuration.

    Parameters
    ----------
    snapshot : bytes
        As `take_snapshot` has made it.
    config : Config
        The configuration of the same run.
    sag_sensitivity : (terms,) array
        Zernike coefficients of a Hencky bowl per sag, in µm per µm.
    held_weights : HeldWeights or None
        Weights of the scalar that the loop holds; None for the vertex.
    """
    memory = decode_snapshot(snapshot)
    try:
        _require_fit(memory, config)
        return Controller(config, sag_sensitivity, memory, held_weights)
    except (ValueError, LookupError, ArithmeticError, TypeError) as error:
        what = f"{type(error).__name__}: {error}"
        raise UnknownSnapshotError(f"the snapshot does not fit the configuration: {what}") from None


def _require_fit(memory: ControllerState, config: Config) -> None:
    """Raise ValueError if a snapshot is of another configuration, or of another safety table."""
    rates_hz = {memory.gains.good.loop.rate_hz, memory.gains.tried.loop.rate_hz}
    if rates_hz != {config.loop.rate_hz}:
        raise ValueError(
            f"a tick rate of {max(rates_hz):g} Hz, and of {config.loop.rate_hz:g} Hz in the "
            "configuration"
        )
    codes = {*memory.safety.history, *(() if memory.fault is None else (memory.fault,))}
    if unknown := codes - safety.RULES.keys():
        raise ValueError(f"the safety table has no rule {min(unknown)}")
