"""The tab of the alarms: the faults and notices of the last runs."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from nicegui import ui

from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.web.alarm_history import PastAlarm
from membrane_ctrl.web.messages import show_message

_COLUMNS = {
    "began": "began",
    "lasted": "stood for",
    "alarm": "alarm",
    "text": "what it was",
    "run": "run",
}
_CARD = """<div class="q-pa-xs col-12"><q-card flat bordered class="q-pa-sm">
<div class="row justify-between"><b>{{ props.row.alarm }}</b>
<span>{{ props.row.began }}</span></div>
<div>{{ props.row.text }}</div>
<div class="text-caption">{{ props.row.lasted }}, {{ props.row.run }}</div></q-card></div>"""


def alarms_panel(
    list_alarms: Callable[[], Awaitable[list[PastAlarm]]], utc: Callable[[], bool]
) -> Callable[[], Awaitable[None]]:
    """Fill the tab; returns what reads the alarms again.

    Parameters
    ----------
    list_alarms : async callable
        Returns the faults and notices of the last runs, newest first; made once for all viewers.
        May raise PoolFullError, which is shown.
    utc : callable
        Whether this viewer reads times in UTC; else in the time zone of the service.
    """
    columns = [
        {"name": name, "label": label, "field": name, "sortable": True, "align": "left"}
        for name, label in _COLUMNS.items()
    ]
    table = ui.table(columns=columns, rows=[], row_key="key", pagination=20).classes("w-full")
    table.props(
        ':grid="window.innerWidth < 700" wrap-cells no-data-label="reading the alarms" '
        'aria-label="alarms"'
    )
    table.add_slot("item", _CARD)

    async def load() -> None:
        try:
            found = await list_alarms()
        except PoolFullError as error:
            show_message(str(error), good=False)
            return
        table.rows = [alarm.make_cells(utc()) for alarm in found]
        table.props('no-data-label="no fault or notice in the last runs"')
        table.update()

    ui.button("Refresh", icon="refresh", on_click=load, color=None).props("flat")
    return load
