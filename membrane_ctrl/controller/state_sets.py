"""Sets of states in which rules apply and commands are allowed."""

from membrane_ctrl.model.telemetry import State

MOVING = frozenset({State.INFLATE, State.SETTLE, State.HOLD, State.MANUAL, State.TUNE})
HOLDING = frozenset({State.HOLD})
AT_SETPOINT = HOLDING | {State.SETTLE}
ESTIMATED = MOVING - {State.INFLATE}  # laser, optics and gauge are compared
CONNECTED = MOVING | {State.CHECK}
GAS_MOVES = CONNECTED | {State.LOWER}
ALWAYS = frozenset(State)
NOT_YET_FAULT = ALWAYS - {State.FAULT}
