"""A service that a hold has started ends an hour after its last viewer and its last hold."""

from __future__ import annotations

from membrane_ctrl.service.idle_end import IdleEnd


def test_viewers_and_holds_keep_it() -> None:
    idle = IdleEnd(3600.0, 100.0)
    assert not idle.is_due(3699.0)
    assert idle.is_due(3700.0)
    idle.note_use(3699.0, viewers=1, holding=False)
    assert not idle.is_due(7298.0)
    idle.note_use(7298.0, viewers=0, holding=True)
    idle.note_use(9000.0, viewers=0, holding=False)
    assert not idle.is_due(10_897.0)
    assert idle.is_due(10_898.0)
