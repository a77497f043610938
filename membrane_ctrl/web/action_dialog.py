"""The dialog before a command: what it does, its price, the present value and the allowed range."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from nicegui import ui

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port.status_lines import lock_lines
from membrane_ctrl.model.numbers import parse_number
from membrane_ctrl.service.access import STOP, UNLOCK
from membrane_ctrl.service.action_button import ActionButton
from membrane_ctrl.web.consequences import (
    AllowedRange,
    Consequence,
    describe_price,
    find_consequence,
    find_range,
)


@dataclass(frozen=True, slots=True)
class GivenAnswer:
    """What a viewer has confirmed."""

    text: str
    take_over: bool


def explain_input(action: ActionButton, text: str, allowed: AllowedRange | None) -> str:
    """Why an input is refused before it is sent; empty if it is not.

    The hold judges again: its limits may have changed since the page read its configuration.

    Parameters
    ----------
    action : ActionButton
        The command; `asks` states whether it needs a number, a text or nothing.
    text : str
        As the viewer has typed it; a number has a decimal point (`parse_number`).
    allowed : AllowedRange or None
        None if the hold's configuration is not known here: then any number passes.
    """
    if action.asks != "number":
        return "enter a text" if action.do == "mark" and not text.strip() else ""
    try:
        value = parse_number(text)
    except ValueError as error:
        return str(error)
    return "" if allowed is None else allowed.explain_refusal(value)


async def ask_for_confirmation(
    action: ActionButton, status: Mapping[str, Any], config: Config | None
) -> GivenAnswer | None:
    """Show the dialog; returns None if the viewer cancels, or leaves.

    Enter confirms what leaves the mirror as it is, and STOP; it does not confirm what moves gas.

    Parameters
    ----------
    action : ActionButton
        The command; whether the viewer may give it is judged by the caller, before and after.
    status : mapping
        The hold's newest status, for the present value, the price and the locks.
    config : Config or None
        The hold's configuration; None if it runs on another machine: then no range and no price is
        shown.
    """
    row = status.get("row") or {}
    allowed = find_range(action, row, config)
    enter_confirms = find_consequence(action) is Consequence.NOTHING or action is STOP
    with ui.dialog() as dialog, ui.card():
        ui.label(action.label).classes("text-h6")
        ui.label(action.does)
        price = describe_price(action, row, config)
        if price:
            ui.label(price).classes("text-bold")
        if action is UNLOCK:
            ui.label("Type the word of the lock, or nothing for your own lock:")
            for line in lock_lines(status):
                ui.label(line).classes("text-negative text-bold")
        given = None

        def confirm() -> None:
            wrong = explain_input(action, str(given.value or ""), allowed) if given else ""
            if wrong and given:
                given.props(f'error error-message="{_escape_quotes(wrong)}"')
            else:
                dialog.submit("yes")

        if action.asks:  # a hidden one would take the focus, and Enter with it
            label = f"{action.asks}, {action.unit}" if action.unit else str(action.asks)
            given = ui.input(label).classes("w-full")
            # a phone's decimal keys may lack the minus or the point
            given.props('autofocus inputmode="text"')
            if allowed is not None:
                given.props(f'hint="{_escape_quotes(allowed.words)}"')
            if enter_confirms:
                given.on("keydown.enter", confirm)
        take_over = ui.checkbox("take control from another user")
        with ui.row():
            confirm_button = ui.button("Do it", on_click=confirm).props("color=primary")
            cancel = ui.button("Cancel", on_click=lambda: dialog.submit(""), color=None)
            cancel.props("flat")
            if not action.asks:
                (confirm_button if enter_confirms else cancel).props("autofocus")
    answer = await dialog
    found = GivenAnswer(str(given.value or "") if given else "", bool(take_over.value))
    if not dialog.is_deleted:  # with the viewer
        dialog.delete()
    return found if answer else None


def _escape_quotes(text: str) -> str:
    return text.replace('"', "'")
