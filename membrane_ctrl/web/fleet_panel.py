"""The table of the holds of a fleet."""

from collections.abc import Mapping

from nicegui import ui

from membrane_ctrl.control_port.status_lines import alarm_lines
from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.service.feed import HoldFeed

_LOOK_S = 1.0


def fleet_rows(feeds: Mapping[str, HoldFeed]) -> list[dict[str, object]]:
    """A row of the fleet's table for each hold; red is what needs a look."""
    rows: list[dict[str, object]] = []
    for name, feed in feeds.items():
        seen = feed.seen
        if seen.silent:
            is_regular = bool(seen.problem) and seen.ended is not None and seen.ended.is_regular
            rows.append(
                {
                    "hold": name,
                    "state": seen.state_name,
                    "error": None,
                    "description": seen.silent,
                    "is_red": not is_regular,
                }
            )
            continue
        error_um = (seen.status.get("row") or {}).get("error_um")
        alarms = alarm_lines(seen.status)
        description = "; ".join(alarms) or seen.status.get("why") or "as it should be"
        error = None if error_um is None else round(error_um, 2)
        rows.append(
            {
                "hold": name,
                "state": seen.status.get("state"),
                "error": error,
                "description": description,
                "is_red": bool(alarms),
            }
        )
    return rows


def fleet_panel(feeds: Mapping[str, HoldFeed]) -> None:
    """The table of all holds; a click on a name opens its page."""
    labels = {
        "hold": "mirror",
        "state": "state",
        "error": COLUMNS["error_um"].title,
        "description": "alarms, or why",
    }
    columns = [
        {"name": key, "label": label, "field": key, "align": "left"}
        for key, label in labels.items()
    ]
    table = (
        ui.table(columns=columns, rows=fleet_rows(feeds), row_key="hold")
        .classes("w-full")
        .props("dense")
    )
    link = '<a class="underline" :href="\'?hold=\' + encodeURIComponent(props.value)">{{ props.value }}</a>'  # noqa: E501
    table.add_slot("body-cell-hold", f'<q-td :props="props">{link}</q-td>')
    red = "props.row.is_red ? 'text-negative text-bold' : ''"
    for name in ("state", "description"):
        cell = f'<q-td :props="props" :class="{red}">{{{{ props.value }}}}</q-td>'
        table.add_slot(f"body-cell-{name}", cell)

    def look() -> None:
        rows = fleet_rows(feeds)
        if rows != table.rows:
            table.rows = rows
            table.update()

    ui.timer(_LOOK_S, look)
